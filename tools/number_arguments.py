"""Numbers of the studies' command lines, whose flags are not declared yet (`tools.flags`)."""

from __future__ import annotations

import argparse
import math
from typing import Final

FINITE_MAX: Final = 1e12
COUNT_MAX: Final = 1_000_000
NATURAL_MAX: Final = 2**63 - 1


def finite(text: str) -> float:
    """Return a number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= FINITE_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: a finite number is right")
    return number


def count(text: str) -> int:
    """Return a number of things."""
    return whole(text, 1, COUNT_MAX)


def natural(text: str) -> int:
    """Return a whole number from 0 on: a seed, a case."""
    return whole(text, 0, NATURAL_MAX)


def degrees(text: str) -> int:
    """Return a direction, degrees."""
    sign = -1 if text.strip().startswith("-") else 1
    return sign * whole(text.strip().removeprefix("-"), 0, 360)


def whole(text: str, low: int, high: int) -> int:
    """Return a whole number within two bounds."""
    digits = text.strip()
    if digits.isdecimal() and len(digits) < 20 and low <= int(digits) <= high:
        return int(digits)
    raise argparse.ArgumentTypeError(
        f"{text[:40]!r}: must be a whole number of at least {low}, at most {high}"
    )
