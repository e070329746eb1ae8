"""Work spread over processes of this machine, or over the workers of a Dask cluster that is there.

Processes are spawned, one per core by default, and none is left behind: they leave Ctrl-C to the
process that started them, and end when it does, whatever ended it. Dask is not among the packages
of the runtime: the extra `cluster` brings it. Its workers run this project's own code, so each
compares it with the study's before its first task.
"""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache, partial
from threading import Lock, Thread
from typing import Final, NamedTuple, TypeVar

from shared.exceptions import FAULT_EXIT_CODE, RunError, os_error_in_words
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


class Cluster(NamedTuple):
    """A Dask cluster."""

    address: str
    """The scheduler's: tcp://HOST:PORT, or dask://HOST:PORT."""
    code: tuple[str, ...]
    """Files that decide a result (`code_digest`): the workers must have the same."""


class _Opened(NamedTuple):
    """Who works."""

    executor: Executor
    wait_for_a_worker: Callable[[], None]
    lost: str
    """What it means when a result is lost."""


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def results(
    work: Callable[[T], R], tasks: Sequence[T], workers: int | Cluster, name: Callable[[T], str]
) -> Iterator[tuple[T, R]]:
    """Yield each task with its result as it is done, in no order.

    Leaving the loop early, by an exception or by `close`, ends the rest at once.

    Args:
        work: a function of a module; it runs in the workers.
        tasks: its arguments, one after the other.
        workers: processes, at least 1; or the cluster.
        name: returns a task's name for an error.

    Raises:
        RunError: no worker can be started or reached, the work failed on a task, a worker died, or
            a cluster's worker has other code.
    """
    if not tasks:
        return
    if isinstance(workers, Cluster):
        digest = code_digest(workers.code)
        work = partial(checked, work=work, code=workers.code, digest=digest)
        opened = _cluster(workers.address)
    else:
        opened = _processes(min(workers, len(tasks)))
    with opened as (executor, wait_for_a_worker, lost):
        task_of = {executor.submit(work, task): task for task in tasks}
        wait_for_a_worker()
        for future in as_completed(task_of):
            task = task_of.pop(future)
            try:
                result = future.result()
            except (BrokenProcessPool, CancelledError):
                raise RunError(lost) from None
            except Exception as error:
                words = " ".join(str(error).split())
                raise RunError(f"{name(task)}: {type(error).__name__}: {words}") from error
            yield task, result


@contextmanager
def _processes(workers: int) -> Iterator[_Opened]:
    before = set(multiprocessing.active_children())
    try:
        executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin)
    except OSError as error:  # their locks are files in shared memory
        words = os_error_in_words(error)
        raise RunError(f"no worker process can be started: {words}; is /dev/shm there?") from None
    try:
        lost = "a worker process was killed (out of memory?); it may need fewer --workers"
        yield _Opened(executor, lambda: None, lost)
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _begin() -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(FAULT_EXIT_CODE)


@contextmanager
def _cluster(address: str) -> Iterator[_Opened]:
    scheme, _, place = address.partition("://")
    if scheme not in ("tcp", "tls", "dask") or ":" not in place:
        raise RunError(f"--cluster {address}: write tcp://HOST:PORT of a Dask scheduler")
    place = f"tcp://{place}" if scheme == "dask" else address
    require("cluster", "leave --cluster")
    dask = importlib.import_module("distributed")
    with _silent():
        try:
            client = dask.Client(place, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError):
            raise RunError(
                f"--cluster {place}: no Dask scheduler answers there; start one with "
                "`dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
            ) from None
        executor = client.get_executor(pure=False)  # what is asked for again is run again

        def wait_for_a_worker() -> None:
            try:
                client.wait_for_workers(1, timeout=WORKERS_S)
            except TimeoutError:
                raise RunError(
                    f"--cluster {place}: the scheduler has no workers; start some with "
                    f"`dask worker {place} --nthreads 1`"
                ) from None

        try:
            lost = f"--cluster {place}: connection to the scheduler lost"
            yield _Opened(executor, wait_for_a_worker, lost)
        finally:
            executor.shutdown(wait=False)  # cancels what is left
            client.close()


def checked(task: T, work: Callable[[T], R], code: tuple[str, ...], digest: str) -> R:
    """Do the work in a cluster's worker.

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


@contextmanager
def _silent() -> Iterator[None]:
    """Keep Dask from logging: what goes wrong is an error here, and said in one line."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed.")]
    loggers = [logging.getLogger(name) for name in ("distributed", *names)]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
