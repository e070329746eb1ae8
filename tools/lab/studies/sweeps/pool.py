"""Runs work with joblib in processes of this machine, or on the workers of a Dask cluster.

With a single worker in the cluster, joblib runs the cases here instead. No process is left behind:
a worker ignores Ctrl-C, and ends when the process that started it ends. A cluster's workers run
their own copies of this project's code, so each worker compares its copy with the study's code.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import logging
import os
import select
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from functools import cache
from threading import Lock, Thread
from typing import TYPE_CHECKING, Final, TypeVar

from shared.exceptions import FAULT_EXIT_CODE, RunError, os_error_in_words
from shared.extras import late, require
from shared.places import CHECKOUT

if TYPE_CHECKING:
    import joblib
else:
    joblib = late("joblib")

T = TypeVar("T")
R = TypeVar("R")

CONNECT_S: Final = 10.0
"""Timeout for the scheduler's first answer, s."""
WORKERS_S: Final = 60
"""Timeout for the first worker of a cluster, s."""
CODE: Final = ("services", "shared", "tools/lab", "tools/sim")
"""Folders whose code affects the outcome of a case."""

_one_at_a_time: Final = Lock()
"""Makes a worker with several threads run one case at a time: CasADi builds its graphs in one
thread only."""


def cores() -> int:
    """Return the number of worker processes to use: one per core, or one without joblib."""
    count = len(os.sched_getaffinity(0))
    return min(count, 1) if importlib.util.find_spec("joblib") is None else count


@cache
def code_digest() -> str:
    """Return the SHA-256 of the code that affects the outcome of a case."""
    digest = hashlib.sha256()
    for folder in CODE:
        for path in sorted((CHECKOUT / folder).rglob("*.py")):
            digest.update(path.relative_to(CHECKOUT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def results(
    work: Callable[[T], R],
    tasks: Sequence[T],
    workers: int,
    name: Callable[[T], str],
    cluster: str | None = None,
) -> Iterator[tuple[T, R]]:
    """Yield each task with its result when it is done, in any order.

    Leaving the loop early, by an exception or by `close`, ends the rest at once. `work` is a
    module-level function. `name` returns a task's name for an error. With one worker, the tasks run
    in this process. If `cluster` is the address of a Dask scheduler, its workers run them.

    Raises:
        RunError: no worker can be started or reached, the work failed on a task, a worker died, or
            a cluster's worker has different code.
    """
    digest = "" if cluster is None else code_digest()
    calls = [(work, digest, number, task, name(task)) for number, task in enumerate(tasks)]
    if workers == 1 and cluster is None:
        yield from ((task, _run(*call)[1]) for task, call in zip(tasks, calls, strict=True))
        return
    lost = "a worker process was killed (out of memory?); try fewer --workers"
    if cluster is not None:
        lost = f"--cluster {cluster}: connection to the scheduler lost"
    with _processes(workers) if cluster is None else _cluster(cluster):
        parallel = joblib.Parallel(n_jobs=-1 if cluster else min(workers, len(tasks)),
                                   batch_size=1, return_as="generator_unordered")  # fmt: skip
        try:
            warnings.filterwarnings("ignore", module="joblib")  # about lost, cancelled tasks
            with closing(parallel(joblib.delayed(_run)(*call) for call in calls)) as outputs:
                for number, result in outputs:
                    yield tasks[number], result
        except (BrokenProcessPool, CancelledError):
            raise RunError(lost) from None
        except TimeoutError:
            raise RunError(
                f"--cluster {cluster}: the scheduler has no workers; start some with "
                f"`dask worker {cluster} --nthreads 1`"
            ) from None


def _run(work: Callable[[T], R], digest: str, number: int, task: T, name: str) -> tuple[int, R]:
    """Do the work in a worker; `digest` is that of the study's code, or empty if it is the same."""
    if digest not in ("", code_digest()):
        raise RunError(
            f"{name}: a worker of the cluster has different code; install the same code on every "
            "worker"
        )
    try:
        with _one_at_a_time:
            return number, work(task)
    except Exception as error:  # noqa: BLE001 - the study reports it with the task's name
        words = " ".join(str(error).split())
        raise RunError(f"{name}: {type(error).__name__}: {words}") from None


@contextmanager
def _processes(workers: int) -> Iterator[None]:
    """Run tasks in processes of this machine; end them afterwards."""
    loky = importlib.import_module("joblib.externals.loky")
    try:
        with joblib.parallel_config("loky", n_jobs=workers, inner_max_num_threads=1,
                                    initializer=_begin, initargs=(os.getpid(),)):  # fmt: skip
            yield
    except OSError as error:  # loky's locks are files in shared memory
        words = os_error_in_words(error)
        raise RunError(f"cannot start worker processes: {words}; does /dev/shm exist?") from None
    finally:
        loky.get_reusable_executor().shutdown(wait=True, kill_workers=True)


def _begin(parent: int) -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when its parent ends for any reason."""
    with suppress(ProcessLookupError):  # the parent has already ended
        select.select([os.pidfd_open(parent)], [], [])
    os._exit(FAULT_EXIT_CODE)


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    """Run tasks on a Dask cluster; Dask's log lines are suppressed, errors are raised here."""
    scheme, _, place = address.partition("://")
    if scheme not in ("tcp", "tls") or ":" not in place:
        raise RunError(
            f"--cluster {address}: must be tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler"
        )
    require("cluster", "remove --cluster")
    dask = importlib.import_module("distributed")
    logging.disable(logging.CRITICAL)
    try:
        client = dask.Client(address, timeout=CONNECT_S, set_as_default=False)
        try:
            with joblib.parallel_config("dask", client=client, wait_for_workers_timeout=WORKERS_S):
                yield
        finally:
            client.close()
    except (OSError, TimeoutError):
        raise RunError(
            f"--cluster {address}: no Dask scheduler answers at this address; start one with "
            "`dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`"
        ) from None
    finally:
        logging.disable(logging.NOTSET)
