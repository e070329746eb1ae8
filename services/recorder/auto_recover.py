"""Recovers unfinished files of earlier recorders while this one records.

Recovery runs in a thread, because recovering a file of one hour takes a minute, and recording must
not wait. The thread leaves half of the time to the recorder's loop.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from pathlib import Path

from shared.exceptions import RunError
from shared.mcap_log import recover
from shared.mcap_log.files import RECOVERED, SUFFIX, locked, recovered_name
from shared.mcap_log.recover import Interrupted


class AutoRecovery(threading.Thread):
    """Thread that recovers a directory's unfinished files once.

    It copies a file only if `keep_free` bytes stay free.
    """

    def __init__(self, directory: Path, keep_free: int, logger: logging.Logger) -> None:
        super().__init__(name="auto_recovery", daemon=True)
        self._directory, self._keep_free = directory, keep_free
        self._logger = logger
        self._halt = threading.Event()
        self._resumed = time.monotonic()

    def halt(self) -> None:
        """End the thread and wait for it; an unfinished copy is deleted, the original stays."""
        self._halt.set()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        """Recover the files one after the other."""
        for path in sorted(self._directory.glob(f"*{SUFFIX}")):
            if self._halt.is_set():
                return
            if path.name.endswith(RECOVERED) or path.is_symlink():
                continue
            try:
                recover_in_place(path, self._keep_free, self._logger, self._pace)
            except Interrupted:
                self._logger.info(
                    "%s: recovery interrupted; the next recorder starts it again", path
                )
                return
            except (RunError, OSError) as error:
                self._logger.warning("not recovered: %s", error)

    def _pace(self) -> bool:
        """Sleep for as long as the last step took; return True if the thread must stop."""
        stopped = self._halt.wait(time.monotonic() - self._resumed)
        self._resumed = time.monotonic()
        return stopped


def recover_in_place(
    path: Path, keep_free: int, logger: logging.Logger, stop: recover.Stop
) -> None:
    """Recover one file, if it is unfinished, no process writes it and a copy has room.

    A file that was only cut off is replaced by its recovered copy once the copy is on the disk. If
    its middle is damaged too, the original stays, and the copy is put beside it. Raises RunError or
    OSError if the file cannot be read or the copy cannot be written; Interrupted if `stop` returned
    True.
    """
    beside = recovered_name(path)
    with locked(path) as free:
        if not free or beside.exists() or recover.is_finished(path):
            return
        size = path.stat().st_size
        if shutil.disk_usage(path.parent).free < size + keep_free:
            logger.warning(
                "%s was not finished; there is not enough space to recover it; free some space, "
                "then run `xrl log recover`",
                path,
            )
            return
        outcome = recover.recover(path, beside, stop)
        if not outcome.damage and not outcome.orphans:
            beside.replace(path)
            beside = path
    logger.info(
        "%s was not finished; recovered to %s: %s",
        path,
        beside.name,
        "; ".join(recover.describe(outcome)),
    )
