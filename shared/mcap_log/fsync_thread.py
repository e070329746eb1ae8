"""Syncs files to the disk in a thread beside the loop that empties the queue.

A disk under load answers an fsync late: 0.1 s was measured on a machine with four busy processes,
and memory cards take seconds. In the loop, that wait would make the reception times of messages
late.
"""

from __future__ import annotations

import os
import threading


class FsyncThread:
    """One thread, started by the first request, that makes files last."""

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._wake = threading.Condition()
        self._waiting: list[int] = []
        """Duplicated descriptors, so that their files may be closed before the sync."""
        self._busy = False
        self._closed = False
        self._error: OSError | None = None

    def request(self, descriptor: int, *, last: bool = False) -> None:
        """Request the sync of a file and return at once.

        Args:
            descriptor: of the file; it may be closed after this.
            last: nothing more is written to this file. Another request is skipped while one waits:
                that one covers both.

        Raises:
            OSError: an earlier sync failed: written data may not be on the disk.
        """
        with self._wake:
            self._raise()
            if self._waiting and not last:
                return
            self._waiting.append(os.dup(descriptor))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="fsync", daemon=True)
                self._thread.start()
            self._wake.notify_all()

    def settle(self) -> None:
        """Wait until nothing is left to sync.

        Raises:
            OSError: a sync failed.
        """
        with self._wake:
            self._wake.wait_for(lambda: not self._waiting and not self._busy)
            self._raise()

    def close(self) -> None:
        """Finish the requested syncs and end the thread; never raises."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                descriptor = self._waiting.pop(0)
                self._busy = True
            error = None
            try:
                os.fsync(descriptor)
            except OSError as failed:
                error = failed
            finally:
                os.close(descriptor)
            with self._wake:
                self._busy = False
                self._error = self._error or error
                self._wake.notify_all()
