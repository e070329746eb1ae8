"""Work spread over processes: spawned, one per core by default, none of them left behind.

Workers leave Ctrl-C to the process that started them, and end when it does, whatever
ended it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from threading import Thread
from typing import TypeVar

from shared.exceptions import FAULT_EXIT_CODE, RunError, os_error_in_words

T = TypeVar("T")
R = TypeVar("R")


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def results(
    work: Callable[[T], R], tasks: Sequence[T], workers: int, name: Callable[[T], str]
) -> Iterator[tuple[T, R]]:
    """Yield each task with its result as it is done, in no order.

    Leaving the loop early, by an exception or by `close`, ends the workers at once.

    Args:
        work: a function of a module; it runs in the workers.
        tasks: its arguments, one after the other.
        workers: processes, at least 1.
        name: returns a task's name for an error.

    Raises:
        RunError: no worker can be started, the work failed on a task, or a worker died.
    """
    if not tasks:
        return
    before = set(multiprocessing.active_children())
    executor = _pool(min(workers, len(tasks)))
    try:
        futures = {executor.submit(work, task): task for task in tasks}
        for future in as_completed(futures):
            task = futures.pop(future)
            yield task, _result(future.result, name(task))
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _pool(workers: int) -> ProcessPoolExecutor:
    try:
        return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin)
    except OSError as error:  # their locks are files in shared memory
        words = os_error_in_words(error)
        raise RunError(f"no worker process can be started: {words}; is /dev/shm there?") from None


def _result(get: Callable[[], R], name: str) -> R:
    try:
        return get()
    except BrokenProcessPool:
        raise RunError(
            "a worker process was killed (out of memory?); it may need fewer --workers"
        ) from None
    except Exception as error:
        raise RunError(f"{name}: {type(error).__name__}: {error}") from error


def _begin() -> None:
    """Prepare a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(FAULT_EXIT_CODE)
