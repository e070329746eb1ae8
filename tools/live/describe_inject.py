"""Impairments of the network as a person writes them: `LINK key=value ...`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Mapping
from decimal import Decimal
from difflib import get_close_matches
from typing import Any, Final, NamedTuple, get_args

import msgspec

from shared.config.impairment import Distribution
from shared.config.scenarios import Inject
from shared.exceptions import ConfigError
from shared.links import DIRECTIONS, GROUPS, directions_of
from shared.toml_file import check_ranges


class Number(NamedTuple):
    """A word with a number as its value."""

    field: str
    """Field of `Inject`."""
    units: Mapping[str, str]
    """Units that may follow the number, each with its factor to the field's unit."""
    like: str
    """Hint with valid values."""


_MS: Final = {"": "1", "us": "0.001", "ms": "1", "s": "1000"}
_S: Final = {"": "1", "us": "0.000001", "ms": "0.001", "s": "1"}
_SHARE: Final = {"": "1", "%": "0.01"}
_PLAIN: Final = {"": "1"}
_AS_MS: Final = "write 30 (ms), 0.03s or 500us"
_AS_S: Final = "write 4 (s) or 500ms"
_AS_SHARE: Final = "write 0.2 or 20%"
_AS_RATE: Final = "write bytes per second, 10000 (tc-netem uses bits)"

NUMBERS: Final[Mapping[str, Number]] = {
    "delay": Number("delay_ms", _MS, _AS_MS),
    "jitter": Number("jitter_ms", _MS, _AS_MS),
    "loss": Number("loss", _SHARE, _AS_SHARE),
    "burst": Number("burst", _PLAIN, "write a number of messages, 5"),
    "duplicate": Number("duplicate", _SHARE, _AS_SHARE),
    "reorder": Number("reorder", _SHARE, _AS_SHARE),
    "rate": Number("rate", _PLAIN, _AS_RATE),
    "at": Number("at", _S, _AS_S),
    "for": Number("duration", _S, _AS_S),
}
SWITCHES: Final = ("partition", "ordered")
DISTRIBUTION: Final = "distribution"
GRAMMAR: Final = (
    "LINK KEY=VALUE ...; LINK is "
    f"{', '.join(GROUPS)}, or one direction such as planner->knee_left; KEYs: delay, jitter (30, "
    "30ms, 0.03s, 500us), distribution (uniform, normal, pareto), loss, duplicate, reorder (0.2, "
    "20%), burst, rate (bytes/s), at, for (s); words: partition, ordered"
)
_FILE: Final = "--inject"


def parse_inject(text: str) -> Inject:
    """Parse `LINK key=value ...` for argparse; `at` is 0 s unless given."""
    link, *words = text.replace(",", " ").split() or [""]
    try:
        return _made(link, _split(words))
    except ConfigError as error:
        said = f"{text!r}: {error.key}: {error.found}; {error.expected}"
        raise argparse.ArgumentTypeError(said) from None


def _made(link: str, words: Mapping[str, str]) -> Inject:
    """Return an impairment from its words and their values as written; errors name the word."""
    check_link(link)
    fields: dict[str, Any] = {"link": link, "at": 0.0}
    for word, text in words.items():
        if word in NUMBERS:
            fields[NUMBERS[word].field] = _number(word, text)
        elif word == DISTRIBUTION:
            fields[word] = _distribution(text)
        else:
            fields[word] = True
    inject = msgspec.convert(fields, Inject)
    try:
        check_ranges(_FILE, inject)
    except ConfigError as error:
        word = next(word for word, number in NUMBERS.items() if number.field == error.key)
        found, right = f"{words[word]!r} is out of range", f"{error.expected}; {NUMBERS[word].like}"
        raise ConfigError(_FILE, word, found, right) from None
    problem = inject.fault()
    if not problem and inject.describe() == "nothing":
        problem = "it has no impairment; add a delay, a loss or another word"
    if problem:
        found, _, right = problem.partition("; ")
        raise ConfigError(_FILE, link, found, right)
    return inject


def check_link(link: str) -> None:
    """Refuse an unknown link, and name the closest one."""
    try:
        directions_of(link, _FILE, "link")
    except ConfigError as error:
        near = _near(link, (*GROUPS, *DIRECTIONS))
        if link.endswith("-"):
            near = "the shell used the rest as a file name: put the argument in quotes; "
        raise ConfigError(_FILE, error.key, error.found, near + error.expected) from None


def _split(words: Iterable[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if key not in (SWITCHES if not equals else (*NUMBERS, DISTRIBUTION)):
            near = _near(key, (*NUMBERS, DISTRIBUTION, *SWITCHES))
            raise ConfigError(_FILE, word, "not understood", near + GRAMMAR)
        if key in found:
            raise ConfigError(_FILE, word, f"a second {key}", "remove one of them")
        found[key] = value
    return found


def _near(word: str, known: Iterable[str]) -> str:
    """Return the beginning of a hint, empty if no known word is similar."""
    near = get_close_matches(word, known, n=1)
    return f"perhaps {near[0]!r}; " if near and near[0] != word else ""


def _number(word: str, text: str) -> float:
    _, units, like = NUMBERS[word]
    match = re.fullmatch(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d{1,3})?)([a-z%]*)", text)
    if match is None or match[2] not in units:
        raise ConfigError(_FILE, word, f"{text!r} is not valid", like)
    return float(Decimal(match[1]) * Decimal(units[match[2]]))


def _distribution(text: str) -> str:
    known = get_args(Distribution)
    if text not in known:
        right = f"{_near(text, known)}one of {', '.join(known)}"
        raise ConfigError(_FILE, DISTRIBUTION, repr(text), right)
    return text


def in_words_of(inject: Inject) -> str:
    """Return an impairment as text: link, impairment, time."""
    lasts = "" if inject.duration is None else f" for {inject.duration:g} s"
    return f"{inject.link} {inject.describe()} at {inject.at:g} s{lasts}"
