"""Bit-for-bit comparison of recorded and recomputed outputs, and reasons for differences.

Likely reasons are differences between the run's environment and the present one.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from typing import Any, Final, TypeAlias, TypeVar

import msgspec

from shared.bus.messages import Message
from shared.exceptions import RunError
from shared.revision import UNKNOWN
from shared.rounding import FORCE, TURNS

State = TypeVar("State")

_F64: Final = struct.Struct("<d")
_I64: Final = struct.Struct("<q")
_SIGN: Final = 1 << 63
_encode: Final = msgspec.json.Encoder().encode
SHOWN: Final = 60
"""Maximum number of characters shown of a value."""


class _Difference(msgspec.Struct, frozen=True):
    """One recomputed value that differs."""

    t_ns: int
    """Time on the service's clock."""
    tick: int
    """Cycle of a joint service, or tick of the planner."""
    key: str
    """Topic below `xrl/<robot>/`."""
    field: str
    recorded: Any
    recomputed: Any

    @property
    def ulp(self) -> int | None:
        """Distance in units in the last place, or None if the values are not floats."""
        return ulp(self.recorded, self.recomputed)

    def describe(self) -> str:
        """Return the difference in one line."""
        distance = f", {self.ulp} ULP apart" if self.ulp is not None else ""
        recorded, recomputed = (_short(value) for value in (self.recorded, self.recomputed))
        return (
            f"tick {self.tick}: {self.key} {self.field}: recorded {recorded}, "
            f"recomputed {recomputed}{distance}"
        )


class Comparison:
    """Compares messages, and keeps the first and the largest differences.

    Attributes:
        compared: number of compared messages.
        differing: number of messages that differ.
        first: the first difference, or None.
        largest: the largest difference of each value that differs, by key and field.
    """

    def __init__(self, tolerance: float = 0.0) -> None:
        self._tolerance = tolerance
        self.compared = 0
        self.differing = 0
        self.first: _Difference | None = None
        self.largest: dict[tuple[str, str], _Difference] = {}

    def take(self, key: str, tick: int, recorded: Message, recomputed: Message) -> bool:
        """Compare two messages; return True if they agree."""
        self.compared += 1
        if _encode(recorded) == _encode(recomputed):
            return True
        pairs = _walk("", msgspec.to_builtins(recorded), msgspec.to_builtins(recomputed))
        rows = [
            _Difference(recorded.t_ns, tick, key, field, a, b)
            for field, a, b in pairs
            if not _near(a, b, self._tolerance)
        ]
        if not rows:
            return True
        self.differing += 1
        self.first = self.first or rows[0]
        self._keep_largest(rows)
        return False

    def add(self, later: Comparison) -> None:
        """Add the comparison of a later part of the run."""
        self.compared += later.compared
        self.differing += later.differing
        self.first = self.first or later.first
        self._keep_largest(later.largest.values())

    def _keep_largest(self, rows: Iterable[_Difference]) -> None:
        for row in rows:
            before = self.largest.get((row.key, row.field))
            if before is None or size(row) > size(before):
                self.largest[row.key, row.field] = row


class ReexecutionResult:
    """Counts of one service, filled in during its execution.

    Attributes:
        service: its name.
        exact: True if the snapshots are compared too; False if parameters or the law were changed.
        ticks: number of executed cycles or ticks.
        skipped: number of cycles or ticks before the first snapshot in the log, or after a loss.
        starts: number of starts from a recorded snapshot.
        lost_inputs: number of cycles or ticks for which the log lacks an input.
        comparison: comparison of the outputs.
    """

    def __init__(self, service: str, tolerance: float, *, exact: bool) -> None:
        self.service = service
        self.exact = exact
        self._tolerance = tolerance
        self.forget()

    def forget(self) -> None:
        """Reset the counts."""
        self.ticks = 0
        self.skipped = 0
        self.starts = 0
        self.lost_inputs = 0
        self.comparison = Comparison(self._tolerance)

    def add(self, later: ReexecutionResult) -> None:
        """Add the result of the same service in a later part of the run."""
        self.ticks += later.ticks
        self.skipped += later.skipped
        self.starts += later.starts
        self.lost_inputs += later.lost_inputs
        self.comparison.add(later.comparison)

    @property
    def differs(self) -> bool:
        """True if an output differs from the recorded one."""
        return self.comparison.first is not None

    @property
    def equal(self) -> bool:
        """True if something was executed and no output differs."""
        return self.ticks > 0 and not self.differs


def memory_of(text: str, kind: type[State]) -> State:
    """Decode a recorded snapshot."""
    try:
        return msgspec.json.decode(text, type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise RunError(
            f"a service's snapshot in the log is not a {kind.__name__}: {error}; use the checkout "
            "that wrote the log (`xrl log info` shows its commit)"
        ) from None


def size(row: _Difference) -> float:
    """Return the distance between the two values, infinite if they are not numbers."""
    a, b = row.recorded, row.recomputed
    return abs(b - a) if _is_number(a) and _is_number(b) else math.inf


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def ulp(a: Any, b: Any) -> int | None:
    """Return how many floats apart a and b are, or None if one is not a float."""
    if not (isinstance(a, float) and isinstance(b, float)):
        return None
    return abs(_ordered(a) - _ordered(b))


def _ordered(value: float) -> int:
    """Return a float's position in the order of all floats."""
    bits = int(_I64.unpack(_F64.pack(value))[0])
    return bits if bits >= 0 else -(bits + _SIGN)


def _near(a: Any, b: Any, tolerance: float) -> bool:
    if _is_number(a) and _is_number(b) and tolerance > 0.0:
        return bool(abs(b - a) <= max(tolerance, 1.5 * _unit(a, b)))
    if isinstance(a, float) and isinstance(b, float):
        return a == b and math.copysign(1.0, a) == math.copysign(1.0, b)
    return bool(a == b)


def _unit(a: float, b: float) -> float:
    """Return one unit of the last decimal of two rounded numbers (`shared.rounding`), else 0.

    Another machine's last bit can round a number the other way.
    """
    if isinstance(a, int) or isinstance(b, int):
        return 0.0
    exponents = [Decimal(repr(number)).as_tuple().exponent for number in (a, b)]
    most = max((-each for each in exponents if isinstance(each, int)), default=0)
    return 0.0 if most > TURNS else 10.0 ** -max(most, FORCE)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _walk(name: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield every plain value of two messages of the same type, with its name."""
    if name == "snapshot" and isinstance(a, str) and isinstance(b, str) and a and b:
        a, b = msgspec.json.decode(a), msgspec.json.decode(b)
    if isinstance(a, dict) and isinstance(b, dict):
        for field, value in a.items():
            yield from _walk(f"{name}.{field}" if name else field, value, b.get(field))
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        for index, (one, other) in enumerate(zip(a, b, strict=True)):
            yield from _walk(f"{name}[{index}]", one, other)
    else:
        yield name, a, b


Origin: TypeAlias = Mapping[str, Mapping[str, str]]
"""Metadata of a log (`shared.mcap_log.provenance`): `run` and `packages`."""

FACTS: Final = {
    "architecture": "architecture", "cpu_model": "CPU", "libc": "libc", "python": "Python",
}  # fmt: skip
"""Facts of `run` that may affect numbers, with their names in a sentence."""
NUMERIC_PACKAGES: Final = ("casadi", "msgspec", "numpy", "pin")
"""Packages with which planner and joint services compute."""
CHANGED: Final = " with changes"
"""Suffix of a commit with local changes; two checkouts with it may differ."""
BLAS_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE")


def likely_reason(recorded: Origin, here: Origin) -> str:
    """Return one line with the differences between two origins, and the unknown facts."""
    differing, untold = [], []
    for (name, one), (_, other) in zip(_facts(recorded), _facts(here), strict=True):
        if UNKNOWN in (one, other) or (one == other and one.endswith(CHANGED)):
            untold.append(name)
        elif one != other:
            differing.append(f"{name} {one}, here {other}")
    if differing:
        line = f"likely reason: recorded with {'; '.join(differing)}"
        if not all(each.startswith("code ") for each in differing):
            line += "; `--tolerance 1e-9` accepts what another machine rounds differently"
    else:
        line = f"no reason known: {'no known fact differs' if untold else 'the same environment'}"
    return f"{line} (unknown: {', '.join(untold)})" if untold else line


def _facts(origin: Origin) -> Iterator[tuple[str, str]]:
    """Yield the name and value of each fact; `UNKNOWN` if the origin lacks it."""
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
