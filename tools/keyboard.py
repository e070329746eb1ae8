"""Single key presses from a terminal; none without a terminal."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Final, Generic, Self, TextIO, TypeVar

K = TypeVar("K")
_READ_MAX: Final = 256


class Keyboard(Generic[K]):
    """Reader of single keys, which restores the terminal at the end."""

    def __init__(self, codes: Mapping[bytes, K]) -> None:
        self._codes = codes
        self._descriptor = -1
        self._before: list[Any] = []
        self._rest = b""

    @property
    def present(self) -> bool:
        """True if keys are read."""
        return self._descriptor >= 0

    def __enter__(self) -> Self:
        """Start reading single keys, if this process is in the foreground of a terminal."""
        try:
            descriptor = sys.stdin.fileno()
            if os.isatty(descriptor) and _is_foreground(descriptor):
                self._before = termios.tcgetattr(descriptor)
                tty.setcbreak(descriptor)
                self._descriptor = descriptor
        except (OSError, ValueError, AttributeError, termios.error):
            pass  # no stdin, or stdin is not a terminal
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restore the terminal."""
        if self.present:
            with contextlib.suppress(OSError, termios.error):  # the terminal may be gone
                if _is_foreground(self._descriptor):
                    termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)
            self._descriptor = -1

    def wait(self, timeout_s: float) -> list[K]:
        """Return the pressed keys as soon as one is pressed, or none after a timeout, s."""
        if not self.present:
            time.sleep(timeout_s)
            return []
        self._set_cbreak()
        ready, _, _ = select.select([self._descriptor], [], [], timeout_s)
        if not ready:
            return []
        try:
            text = os.read(self._descriptor, _READ_MAX)
        except OSError:
            text = b""
        if not text:  # the terminal is gone
            self._descriptor = -1
        presses, self._rest = understood(self._rest + text, self._codes)
        return presses

    def _set_cbreak(self) -> None:
        """Read single keys again after a shell has reset the terminal (Ctrl-Z, then `fg`).

        Typed keys are not discarded, because one may be the stop.
        """
        with contextlib.suppress(OSError, termios.error):
            is_by_line = termios.tcgetattr(self._descriptor)[3] & termios.ICANON
            if is_by_line and _is_foreground(self._descriptor):
                tty.setcbreak(self._descriptor, termios.TCSANOW)


def _is_foreground(descriptor: int) -> bool:
    """Return True if this process may change its terminal; a background job would be stopped."""
    return os.tcgetpgrp(descriptor) == os.getpgrp()


def is_hung_up(file: int | TextIO) -> bool:
    """Return True for a terminal whose other end is closed, as by a dropped ssh session."""
    try:
        termios.tcgetattr(file)
    except (OSError, ValueError, termios.error) as error:
        return error.args[:1] == (errno.EIO,)
    return False


def understood(text: bytes, codes: Mapping[bytes, K]) -> tuple[list[K], bytes]:
    """Split a terminal's bytes into keys and the start of an incomplete key."""
    presses = []
    while text:
        for code, press in codes.items():
            if text.startswith(code):
                presses.append(press)
                text = text[len(code) :]
                break
        else:
            if any(code.startswith(text) for code in codes):
                return presses, text
            text = text[1:]
    return presses, b""


def typed_line(wait_s: float) -> str | None:
    """Return the line that a person enters within a timeout, s.

    Return None if no line is entered or there is no terminal, "" if the terminal is gone.
    """
    if not sys.stdin.isatty():
        if is_hung_up(sys.stdin):
            return ""
        time.sleep(wait_s)
        return None
    try:
        return sys.stdin.readline() if select.select([sys.stdin], [], [], wait_s)[0] else None
    except OSError:
        return ""
