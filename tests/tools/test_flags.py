"""Flags as typed fields: what is read, refused and shown."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated, Literal

import pytest

from shared.exceptions import RunError
from shared.toml_file import Range
from tools.flags import (
    Arg,
    Flags,
    Seconds,
    _argument,
    add_flags,
    fields_of,
    option,
    parsed,
    positional,
    read_flags,
)
from tools.verb_table import VERBS, Verb


class Common(Flags):
    """Declared once, for several."""

    seed: Annotated[int, Range(0, 9, "")] = 0
    """of the noise"""


def word(text: str) -> str:
    if not text.isalpha():
        raise argparse.ArgumentTypeError(f"{text!r}: letters are right")
    return text.upper()


class Given(Common):
    """One of each kind."""

    place: Annotated[Path, positional("PLACE")]
    more: Annotated[tuple[str, ...], positional("MORE")] = ()
    delay: Annotated[float, Range(0.0, 1e3, "ms")] = 1.5
    """each way, 100 % of them"""
    for_s: Annotated[Seconds | None, option("--for", "-f")] = None
    mode: Literal["fast", "slow"] = "slow"
    push: Annotated[tuple[str, ...], parsed(word, "WORD")] = ()
    loud: Annotated[bool, Arg(exclusive="how")] = False
    quiet: Annotated[bool, Arg(exclusive="how")] = False

    def check(self) -> None:
        if self.loud and self.mode == "slow":
            raise RunError("--loud: --mode fast is right with it")


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="xrl")
    add_flags(made, Given)
    return made


def read(*words: str) -> Given:
    return read_flags(Given, parser().parse_args(["here", *words]))


def test_what_is_not_given_has_the_declared_default() -> None:
    assert read() == Given(place=Path("here"))


def test_each_kind_of_field_is_read() -> None:
    words = "a b --delay 3 -f 2 --mode fast --push x --push y --quiet --seed 7"
    assert read(*words.split()) == Given(
        place=Path("here"), more=("a", "b"), delay=3.0, for_s=2.0, mode="fast", push=("X", "Y"),
        quiet=True, seed=7,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("words", "right"),
    [
        ("--delay -1", "must be a number from 0 to 1000 ms"),
        ("--delay nan", "must be a number from 0 to 1000 ms"),
        ("--delay 1_0", "must be a number from 0 to 1000 ms"),
        ("--for -0.1", "must be a number of at least 0 s"),
        ("--seed 1.5", "must be a whole number from 0 to 9"),
        ("--seed 10", "must be a whole number from 0 to 9"),
        ("--mode x", "invalid choice: 'x'"),
        ("--push 1", "'1': letters are right"),
        ("--loud --quiet", "not allowed with"),
    ],
)
def test_what_does_not_fit_is_refused_with_what_is_right(
    words: str, right: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        read(*words.split())
    assert left.value.code == 2
    assert right in capsys.readouterr().err


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_no_number_of_any_verb_takes_what_is_none_or_beyond_its_range(verb: Verb) -> None:
    for field in fields_of(verb.declaration):
        if field.kind not in (int, float) or field.arg.parse is not None:
            continue
        assert field.limits is not None, field.name
        low, high = (field.kind(end) for end in (field.limits.low, field.limits.high))
        beyond = (low - 1 - abs(low), high + 1 + abs(high), 1.5 if field.kind is int else "1_0")
        for bad in ("nan", "inf", "-inf", "1e300", "one", "", *beyond):
            with pytest.raises(argparse.ArgumentTypeError, match="must be"):
                _argument(field)["type"](str(bad))


def test_crossed_flags_are_refused_by_the_declaration() -> None:
    with pytest.raises(RunError, match="--mode fast"):
        read("--loud")


def test_help_has_docstring_unit_and_default_and_a_verbs_own_flags_first() -> None:
    text = " ".join(parser().format_help().split())
    assert "--delay MS each way, 100 % of them (default: 1.5)" in text
    assert text.index("--delay") < text.index("--seed")
    assert "--quiet" in text
    assert "(default: False)" not in text
