"""Impairments of the network as a person writes them: `LINK key=value ...`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from shared.exceptions import ConfigError
from shared.impairment import Impairment
from shared.links import GROUPS, directions_of
from shared.scenario import Inject
from shared.toml_file import check_ranges

NUMBERS: Final[Mapping[str, str]] = {
    "delay": "delay_ms",
    "jitter": "jitter_ms",
    "loss": "loss",
    "burst": "burst",
    "duplicate": "duplicate",
    "reorder": "reorder",
    "rate": "rate",
    "at": "at",
    "for": "duration",
}
"""Words that take a number, and the field each is."""
SWITCHES: Final = ("partition", "ordered")
GRAMMAR: Final = (
    "LINK KEY=VALUE ...; LINK is "
    f"{', '.join(GROUPS)}, or one direction such as planner->knee_left; KEYs: delay, jitter (ms), "
    "distribution (uniform, normal, pareto), loss, burst, duplicate, reorder, rate (bytes/s), "
    "at, for (s); words: partition, ordered"
)


def parse_inject(text: str) -> Inject:
    """Read `LINK key=value ...`, for argparse; without `at` from the beginning.

    Raises:
        argparse.ArgumentTypeError: it is none; the message says what is.
    """
    link, words = "", text.replace(",", " ").split()
    if words:
        link = words.pop(0)
    try:
        return make(link, words)
    except ConfigError as error:
        said = f"{text!r}: {error.key}: {error.found}; {error.expected}"
        raise argparse.ArgumentTypeError(said) from None


def make(link: str, words: list[str]) -> Inject:
    """Return an impairment from its words, checked.

    Raises:
        ConfigError: a word is unknown or out of its range, or they do not go together.
    """
    fields: dict[str, Any] = {"link": link, "at": 0.0}
    for word in words:
        fields |= _field(word)
    try:
        inject = msgspec.convert(fields, Inject)
    except msgspec.ValidationError as error:
        raise ConfigError("--inject", link, str(error), GRAMMAR) from None
    check_ranges("--inject", inject)
    directions_of(link, "--inject", "link")
    amiss = inject.fault()
    if not amiss and inject.in_words() == "nothing":
        amiss = "nothing is done to it; give a delay, a loss or another word"
    if amiss:
        found, _, right = amiss.partition("; ")
        raise ConfigError("--inject", link, found, right)
    return inject


def _field(word: str) -> dict[str, Any]:
    key, equals, value = word.partition("=")
    if not equals and key in SWITCHES:
        return {key: True}
    if key == "distribution":
        return {key: value}
    if key in NUMBERS and re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", value):
        return {NUMBERS[key]: float(value)}
    raise ConfigError("--inject", word or "(nothing)", "not understood", GRAMMAR)


def in_words_of(inject: Inject) -> str:
    """Return what is done, where and when."""
    lasts = "" if inject.duration is None else f" for {inject.duration:g} s"
    return f"{inject.link} {inject.in_words()} at {inject.at:g} s{lasts}"


def impairment_of(inject: Inject) -> Impairment:
    """Return what is done, without where and when."""
    fields = {name: getattr(inject, name) for name in Impairment.__struct_fields__}
    return Impairment(**fields)
