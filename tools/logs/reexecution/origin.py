"""Why a run may come out otherwise: what it was made with, beside what executes it again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, TypeAlias

import msgspec

from shared.revision import UNKNOWN

Origin: TypeAlias = Mapping[str, Mapping[str, str]]
"""Metadata of a log (`shared.mcap_log.provenance`): `run` and `packages`."""

FACTS: Final = {
    "architecture": "architecture", "cpu_model": "CPU", "libc": "libc", "python": "Python",
}  # fmt: skip
"""Facts of `run` by which numbers may differ, with their names in a sentence."""
NUMERIC_PACKAGES: Final = ("casadi", "msgspec", "numpy", "pin", "scipy")
"""Packages with which planner and joint services compute."""
CHANGED: Final = " with changes"
"""After a commit: the checkout has it and more, so two of them may differ."""
BLAS_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE")


def likely_reason(recorded: Origin, here: Origin) -> str:
    """Return one line: what differs between a log's origin and this one, and what is not told."""
    differing, untold = [], []
    for (name, one), (_, other) in zip(_facts(recorded), _facts(here), strict=True):
        if UNKNOWN in (one, other) or (one == other and one.endswith(CHANGED)):
            untold.append(name)
        elif one != other:
            differing.append(f"{name} {one}, here {other}")
    if differing:
        line = f"likely reason, recorded with {'; '.join(differing)}"
    else:
        line = "no reason known: it was recorded with the same as here"
    return f"{line} (not told: {', '.join(untold)})" if untold else line


def _facts(origin: Origin) -> Iterator[tuple[str, str]]:
    """Yield the name and value of each fact; `UNKNOWN` where the origin does not tell it."""
    run, versions = origin.get("run", {}), origin.get("packages", {})
    commit, changed = run.get("git_commit") or UNKNOWN, run.get("git_dirty") == "true"
    yield "code", commit if commit == UNKNOWN else commit[:12] + CHANGED * changed
    for key, name in FACTS.items():
        yield name, run.get(key) or UNKNOWN
    for name in NUMERIC_PACKAGES:
        yield name, versions.get(name) or UNKNOWN
    threads = _thread_variables(run.get("thread_env", ""))
    for name in BLAS_VARIABLES:
        yield name, UNKNOWN if threads is None else threads.get(name, "unset")


def _thread_variables(text: str) -> dict[str, str] | None:
    try:
        return msgspec.json.decode(text, type=dict[str, str])
    except msgspec.MsgspecError:
        return None
