"""Work spread over the workers of a Dask cluster that is there already.

Dask is not among the packages of the runtime: the extra `cluster` brings it. The workers run
this project's own code, so each compares it with the study's before its first task.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import lru_cache
from threading import Lock
from typing import Any, Final, TypeVar

from shared.exceptions import RunError
from shared.extras import require
from tools.lab.studies.sweeps.table import code_digest

T = TypeVar("T")
R = TypeVar("R")

CONNECT_S: Final = 10.0
"""The scheduler has so long to answer."""
WORKERS_S: Final = 60.0
"""The first worker has so long to be there, once there is work."""

_one_at_a_time: Final = Lock()
"""A worker with several threads runs one case after the other: CasADi builds its graphs in one
thread only."""


def results(
    work: Callable[[T], R],
    tasks: Sequence[T],
    address: str,
    name: Callable[[T], str],
    code: tuple[str, ...],
) -> Iterator[tuple[T, R]]:
    """Yield each task with its result as it is done, in no order.

    Leaving the loop early cancels the rest.

    Args:
        work: a function of a module that the workers can import.
        tasks: its arguments, one after the other.
        address: of the scheduler: tcp://HOST:PORT, or dask://HOST:PORT.
        name: returns a task's name for an error.
        code: files that decide a result, as for `code_digest`.

    Raises:
        RunError: Dask is not installed, no scheduler or worker is there, the connection is lost,
            a worker's code is another, or the work failed on a task.
    """
    if not tasks:
        return
    place = _checked_address(address)
    dask = _dask()
    with _silent():
        client = _client(dask, place)
        yield from _results(dask, client, work, tasks, place, name, code)


def _results(
    dask: Any,
    client: Any,
    work: Callable[[T], R],
    tasks: Sequence[T],
    place: str,
    name: Callable[[T], str],
    code: tuple[str, ...],
) -> Iterator[tuple[T, R]]:
    """Yield as `results`, and close the client."""
    try:
        digest = code_digest(code)
        futures = client.map(checked, tasks, work=work, code=code, digest=digest, pure=False)
        task_of = {future.key: task for future, task in zip(futures, tasks, strict=True)}
        try:
            _wait_for_a_worker(client, place)
            for future in dask.as_completed(futures, loop=client.loop):
                task = task_of[future.key]
                yield task, _result(future, name(task), place)
        finally:
            client.cancel(futures)
    finally:
        client.close()


def checked(task: T, work: Callable[[T], R], code: tuple[str, ...], digest: str) -> R:
    """Do the work; runs in a worker.

    Raises:
        RunError: this worker's code is not the study's.
    """
    if _digest_here(code) != digest:
        raise RunError("a worker of the cluster has other code than this study; install the same")
    with _one_at_a_time:
        return work(task)


@lru_cache
def _digest_here(code: tuple[str, ...]) -> str:
    return code_digest(code)


def _dask() -> Any:
    require("cluster", "leave --cluster")
    return importlib.import_module("distributed")


def _checked_address(address: str) -> str:
    """Return the address as Dask writes it."""
    scheme, _, place = address.partition("://")
    if scheme not in ("tcp", "tls", "dask") or ":" not in place:
        raise RunError(f"--cluster {address}: write tcp://HOST:PORT of a Dask scheduler")
    return f"tcp://{place}" if scheme == "dask" else address


def _client(dask: Any, address: str) -> Any:
    """Return a client of the scheduler."""
    try:
        return dask.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError):
        raise RunError(
            f"--cluster {address}: no Dask scheduler answers there; start one with "
            "`dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
        ) from None


def _wait_for_a_worker(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        raise RunError(
            f"--cluster {address}: the scheduler has no workers; start some with "
            f"`dask worker {address} --nthreads 1`"
        ) from None


def _result(future: Any, name: str, address: str) -> Any:
    try:
        return future.result()
    except RunError:
        raise
    except CancelledError:
        raise RunError(f"--cluster {address}: connection to the scheduler lost") from None
    except Exception as error:
        words = " ".join(str(error).split())
        raise RunError(f"{name}: {type(error).__name__}: {words}") from error


@contextmanager
def _silent() -> Iterator[None]:
    """Keep Dask from logging: what goes wrong is an error here, and said in one line."""
    logger = logging.getLogger("distributed")
    children = [
        child
        for child in logging.root.manager.loggerDict.values()
        if isinstance(child, logging.Logger) and child.name.startswith("distributed.")
    ]
    before = [(each, each.level) for each in (logger, *children)]
    for each, _ in before:
        each.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for each, level in before:
            each.setLevel(level)
