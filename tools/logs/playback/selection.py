"""Which topics of a log are played, and onto which keys; names as in `tools.topic_keys`. Pure."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Sequence
from typing import Final

from shared.bus.topics import TOPICS
from shared.exceptions import RunError
from tools.topic_keys import LIVE, match, row_of, short

CLOCK: Final = "clock"

_SECTION: Final = re.compile(r"[^/*$?#\s]+")


def choose(
    present: Sequence[str], wanted: Iterable[str], unwanted: Iterable[str]
) -> tuple[str, ...]:
    """Return the keys to play, in the order given; `wanted` none: all."""
    wanted, unwanted = tuple(wanted), tuple(unwanted)
    for flag, names in (("--topics", wanted), ("--exclude", unwanted)):
        for name in names:
            _check_known(flag, name, present)
    chosen = tuple(
        key
        for key in present
        if (not wanted or any(match(name, key) for name in wanted))
        and not any(match(name, key) for name in unwanted)
    )
    if not chosen:
        recorded = ", ".join(sorted({row_of(short(key)) for key in present})) or "nothing"
        raise RunError(f"nothing is left to play; the log holds {recorded}")
    return chosen


def check_prefix(prefix: str) -> str:
    """Return a prefix of keys without slashes at its ends; refuse one that makes live keys."""
    stripped = prefix.strip("/")
    sections = stripped.split("/") if stripped else []
    if not all(_SECTION.fullmatch(section) for section in sections):
        right = "letters and digits, with slashes between, are right"
        raise RunError(f"--prefix {prefix!r}: cannot stand before a key; {right}")
    if sections and (sections[0] == LIVE or sections[0].startswith("@")):
        raise RunError(
            f"--prefix {prefix!r}: keys that begin with {sections[0]}/ are not a player's; take "
            'another word, or --prefix "" for the live keys themselves'
        )
    return stripped


def targets(
    chosen: Sequence[str], prefix: str, remaps: Iterable[str], robot: str
) -> dict[str, str]:
    """Return the key onto which each key is played; `prefix` empty: the live key.

    Remaps are as `harness/wrench=harness/before` or `joint/*/state=was/*/state`.
    """
    done: dict[str, str] = {}
    for remap in remaps:
        old, equals, new = remap.partition("=")
        if not (old and equals and new):
            raise RunError(f"--remap {remap!r}: OLD=NEW is right, as harness/wrench=harness/was")
        _check_known("--remap", old, chosen)
        fitting = [key for key in chosen if match(old, key)]
        if not fitting:
            raise RunError(f"--remap {remap!r}: {old} is not among what is played")
        for key in fitting:
            if key in done:
                raise RunError(
                    f"--remap {remap!r}: {short(key)} has been given another name before"
                )
            done[key] = _renamed(remap, old, new, key)
    lead = f"{prefix}/" if prefix else ""
    names = {key: f"{LIVE}/{robot}/{name}" for key, name in done.items()}
    found = {key: lead + names.get(key, key) for key in chosen}
    _check_apart(found)
    return found


def clock_key(prefix: str) -> str:
    """Return the key of the recorded time."""
    return f"{prefix}/{CLOCK}" if prefix else CLOCK


def _renamed(remap: str, old: str, new: str, key: str) -> str:
    new = short(new)
    found = match(old, key)
    parts = list(found.groups()) if found else []
    if new.count("*") not in (0, len(parts)) or "**" in new:
        raise RunError(f"--remap {remap!r}: as many * on the right as on the left are right")
    if new.count("*"):
        for part in parts:
            new = new.replace("*", part, 1)
    if not all(_SECTION.fullmatch(section) for section in new.split("/")):
        raise RunError(f"--remap {remap!r}: {new!r} is no name; as harness/was is right")
    return new


def _check_apart(found: dict[str, str]) -> None:
    sources: dict[str, str] = {}
    for key, target in found.items():
        if target in sources:
            both = f"{short(sources[target])} and {short(key)}"
            raise RunError(f"{both} would both become {target}; --remap one, or --exclude it")
        sources[target] = key


def _check_known(flag: str, name: str, present: Collection[str]) -> None:
    """Refuse a name that is neither in the log nor in the table of topics."""
    tables = [topic.name for topic in TOPICS]
    if any(match(name, key) for key in present):
        return
    if any(match(short(name), row) or match(row, short(name)) for row in tables):
        return
    known = sorted({*tables, *(short(key) for key in present)})
    near = difflib.get_close_matches(short(name), known, n=1, cutoff=0.0)
    raise RunError(f"{flag} {name}: no such topic; the nearest is {near[0]}")
