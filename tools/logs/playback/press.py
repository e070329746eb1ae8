"""Keys of a terminal that mean something during playback."""

from __future__ import annotations

from enum import Enum
from typing import Final


class Press(Enum):
    """A key that means something."""

    PAUSE = "space"
    STEP = "right"
    FASTER = "up"
    SLOWER = "down"
    QUIT = "q"


PRESSES: Final = {
    b" ": Press.PAUSE,
    b"q": Press.QUIT,
    b"\x1b[C": Press.STEP,
    b"\x1bOC": Press.STEP,
    b"\x1b[A": Press.FASTER,
    b"\x1bOA": Press.FASTER,
    b"\x1b[B": Press.SLOWER,
    b"\x1bOB": Press.SLOWER,
}
"""By the bytes that a terminal sends."""
