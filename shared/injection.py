"""What is said to the injector on its socket, and what it answers: one JSON line each."""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shared.scenario import Inject

SOCKET: Final = "injector.sock"
"""Name of the socket in the run directory of the fleet."""
LINE_MAX: Final = 65536


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """Put an impairment in force, now; `at` of it is not looked at."""

    inject: Inject


class Clear(msgspec.Struct, frozen=True, tag="clear"):
    """End what is done to a link."""

    link: str = "all"


class List(msgspec.Struct, frozen=True, tag="list"):
    """Tell what is done."""


Request: TypeAlias = Begin | Clear | List


class Asked(msgspec.Struct, frozen=True):
    """One impairment that was asked for and is not over."""

    number: int
    link: str
    detail: str
    """As `Impairment.in_words`."""
    left_s: float | None
    """Until it ends, s; None: it does not by itself."""
    passed: int
    lost: int


class Reply(msgspec.Struct, frozen=True):
    """The answer to every request."""

    error: str = ""
    asked: tuple[Asked, ...] = ()
    """What is asked for after the request was carried out; the last one on a link counts."""
