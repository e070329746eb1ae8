"""Numbers on a command line: finite ones, counts, seeds; each with its error in one line."""

from __future__ import annotations

import argparse
import math
from typing import Final

FINITE_MAX: Final = 1e12
COUNT_MAX: Final = 1_000_000
NATURAL_MAX: Final = 2**63 - 1
RATE_MIN_HZ: Final = 1e-3
RATE_MAX_HZ: Final = 1e4


def finite(text: str) -> float:
    """Return a number.

    Raises:
        argparse.ArgumentTypeError: it is none, not finite or beyond any use.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= FINITE_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: a finite number is right")
    return number


def count(text: str) -> int:
    """Return a number of things.

    Raises:
        argparse.ArgumentTypeError: it is no whole number from 1 to a million.
    """
    return whole(text, 1, COUNT_MAX)


def natural(text: str) -> int:
    """Return a whole number from 0 on: a seed, a case.

    Raises:
        argparse.ArgumentTypeError: it is no whole number from 0 on.
    """
    return whole(text, 0, NATURAL_MAX)


def rate(text: str) -> float:
    """Return a rate, Hz.

    Raises:
        argparse.ArgumentTypeError: it is none from 0.001 to 10 000 Hz.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not RATE_MIN_HZ <= number <= RATE_MAX_HZ:
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: a rate in Hz is right, such as 100")
    return number


def degrees(text: str) -> int:
    """Return a direction, degrees.

    Raises:
        argparse.ArgumentTypeError: it is no whole number from -360 to 360.
    """
    sign = -1 if text.strip().startswith("-") else 1
    return sign * whole(text.strip().removeprefix("-"), 0, 360)


def finite_numbers(text: str, number: int, largest: float = FINITE_MAX) -> tuple[float, ...]:
    """Return so many numbers of a text, separated by commas or spaces.

    Args:
        text: what was typed, or stands in a file.
        number: how many are right.
        largest: absolute value that none may exceed.

    Raises:
        ValueError: there are more or fewer, or one is none, not finite or too large; says which.
    """
    words = text.replace(",", " ").split()
    if len(words) != number:
        raise ValueError(f"{len(words)} numbers; {number} are right")
    numbers = []
    for place, word in enumerate(words, 1):
        try:
            numbers.append(float(word))
        except ValueError:
            numbers.append(math.nan)
        if not abs(numbers[-1]) <= largest:
            raise ValueError(f"number {place}, {word[:40]!r}: one within +-{largest:.4g} is right")
    return tuple(numbers)


def whole(text: str, low: int, high: int) -> int:
    """Return a whole number within two bounds.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    digits = text.strip()
    if digits.isdecimal() and len(digits) < 20 and low <= int(digits) <= high:
        return int(digits)
    raise argparse.ArgumentTypeError(
        f"{text[:40]!r}: must be a whole number of at least {low}, at most {high}"
    )
