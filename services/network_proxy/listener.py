"""A UNIX socket that is listened on, and still is when the descriptors are used up."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from pathlib import Path

from shared.exceptions import BusError
from shared.run_directory import private_files


class SocketListener:
    """Accepts without ever waiting."""

    def __init__(self, path: Path) -> None:
        """Listen on a path; the file of a killed process is removed.

        Raises:
            BusError: no socket can be made there.
        """
        self.turned_away = 0
        """Connections for which there was no descriptor."""
        self._path = path
        self.socket = socket.socket(socket.AF_UNIX)
        try:
            path.unlink(missing_ok=True)
            with private_files():
                self.socket.bind(str(path))
            self.socket.listen()
        except OSError as error:
            self.socket.close()
            text = f"{path}: {error.strerror or error}; an endpoint it may use is needed"
            raise BusError(text) from None
        self.socket.setblocking(False)
        self._spare: int | None = None
        self._keep_spare()

    def accept(self) -> socket.socket | None:
        """Return the end of who has dialled; it does not block. None: nobody, or turned away."""
        try:
            end, _ = self.socket.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._turn_away()
            return None
        end.setblocking(False)
        return end

    def close(self) -> None:
        """Listen no more, and remove the path."""
        self.socket.close()
        self._path.unlink(missing_ok=True)
        self._give_spare()

    def _turn_away(self) -> None:
        """Refuse who dials: the descriptor that is kept for this is lent to it.

        Left in the queue it would be readable at once again, and the loop would never rest.
        """
        self.turned_away += 1
        self._give_spare()
        with contextlib.suppress(OSError):
            self.socket.accept()[0].close()
        self._keep_spare()

    def _keep_spare(self) -> None:
        with contextlib.suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY)

    def _give_spare(self) -> None:
        if self._spare is not None:
            os.close(self._spare)
            self._spare = None
