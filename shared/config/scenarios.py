"""Events of a run: the operator's hand, pushes, kills, restarts and drive faults.

A scenario is a TOML file (`deploy/scenarios/`); `xrl demo` adds to it from its flags.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

import msgspec
import tomli_w

from shared.config.impairment import Impairment
from shared.config.robot_config import SERVICES
from shared.exceptions import ConfigError
from shared.joints import MODULES
from shared.links import directions_of
from shared.toml_file import Range, Section, check_ranges, read_toml

Time = Annotated[float, Range(0.0, 86_400.0, "s")]
Force = Annotated[float, Range(-2000.0, 2000.0, "N")]

ShiftLength = Annotated[float, Range(-0.1, 0.1, "m")]
ShiftAngle = Annotated[float, Range(-0.3, 0.3, "rad")]
Shift = tuple[float, float, float, float]
"""A change of x, y (m), roll and yaw (rad)."""

SIGNALS = ("KILL", "STOP", "TERM", "INT")
"""Signals of a `Kill`; STOP freezes the process."""


class Keyframe(Section, frozen=True):
    """Target of the operator's hand at one time; cosine-eased to the next keyframe."""

    at: Time
    height: Annotated[float, Range(0.3, 2.0, "m")]
    pitch: Annotated[float, Range(-1.5, 1.5, "rad")] = 0.0
    assist: Annotated[float, Range(0.0, 500.0, "N")] = 0.0
    """Weight that the operator rests on the harness and asks the robot to carry, N."""
    shift: tuple[ShiftLength, ShiftLength, ShiftAngle, ShiftAngle] = (0.0, 0.0, 0.0, 0.0)
    """Requested offset of COM x and y, m, and of the torso's roll and yaw, rad."""
    side: ShiftLength | None = None
    """World y at which the person holds the harness point, m. It applies between two keyframes that
    set it, and before the first and after the last keyframe if these set it; elsewhere the point is
    free. Begin near 0, where the robot stands, because the hand grips at once."""


class Push(Section, frozen=True):
    """Force on the torso for a limited time, N, world axes."""

    at: Time
    duration: Annotated[float, Range(0.001, 60.0, "s")]
    force: tuple[Force, Force, Force]


class Act(Section, frozen=True):
    """Act of the person besides leading, without a request to the robot.

    rest: puts weight on the harness; relax: rests, and the hand has a quarter of its strength;
    limp: rests, and the hand has no strength; bump: strikes, half a sine; pull: pulls along x;
    tremor: shakes at 6 Hz; let_go: takes the hand off.
    """

    kind: Literal["rest", "relax", "limp", "bump", "pull", "tremor", "let_go"]
    at: Time
    duration: Annotated[float, Range(0.001, 3600.0, "s")]
    force: Force = 0.0
    """N; down for a weight, up for a bump, forwards for a pull."""
    ramp: Annotated[float, Range(0.0, 60.0, "s")] = 0.2
    """Rise time, s; not for a bump."""
    release: Annotated[float, Range(0.0, 60.0, "s")] | None = None
    """Fall time, s; by default equal to `ramp`."""


class Kill(Section, frozen=True):
    """Signal to a service, which stays down until a `Restart` names it."""

    service: str
    at: Time
    signal: Literal["KILL", "STOP", "TERM", "INT"] = "KILL"


class Restart(Section, frozen=True):
    """Restart of a killed service, or continuation of a stopped one."""

    service: str
    at: Time


FaultKind = Literal[
    "over_temperature",
    "over_voltage",
    "encoder",
    "watchdog",
    "link_lost",
    "disarmed",
    "overspeed",
    "brown_out",
    "encoder_zero",
    "encoder_gap",
    "no_ack",
    "bus_full",
    "bus_flap",
]


class _FaultTraits(NamedTuple):
    """Properties of a kind of fault."""

    about: str
    duration: float | None
    """Default, s; None: momentary."""
    whole: bool
    """True if it affects the whole ODrive, not one of its axes."""


FAULT_KINDS: Final[Mapping[str, _FaultTraits]] = {
    "over_temperature": _FaultTraits("an output stage is too hot", 5.0, whole=False),
    "over_voltage": _FaultTraits("the supply voltage is too high", 0.1, whole=True),
    "encoder": _FaultTraits("an encoder stops sending words", 5.0, whole=False),
    "watchdog": _FaultTraits("an axis's watchdog fires", None, whole=False),
    "link_lost": _FaultTraits(
        "the cable is disconnected: nothing is sent or received", 0.5, whole=True
    ),
    "disarmed": _FaultTraits("an axis goes idle without an error", None, whole=False),
    "overspeed": _FaultTraits("an axis disarms because it is too fast", None, whole=False),
    "brown_out": _FaultTraits("the drive loses power, then restarts", 0.2, whole=True),
    "encoder_zero": _FaultTraits("an encoder reads 0, which is a valid word", 5.0, whole=False),
    "encoder_gap": _FaultTraits(
        "an encoder's words have a gap, too short for an error", 0.045, whole=False
    ),
    "no_ack": _FaultTraits(
        "the drive sends, but receives and acknowledges nothing", 0.5, whole=True
    ),
    "bus_full": _FaultTraits(
        "the bus's send queue is full for 40 ms of each 100 ms (ENOBUFS)", 2.0, whole=True
    ),
    "bus_flap": _FaultTraits("the bus is dead for 60 ms of each 150 ms", 2.0, whole=True),
}
"""Faults by name. An axis that disarms floats; its sibling keeps its torque until the service
idles it."""


class Fault(Section, frozen=True):
    """Fault of a module's ODrive."""

    module: str
    kind: FaultKind
    at: Time
    axis: int | None = None
    """Axis 0 or 1 of the ODrive; by default 0. Not for a fault of the whole ODrive."""
    duration: float | None = None
    """s; by default from `FAULT_KINDS`. Not for a momentary fault."""

    @property
    def lasts_s(self) -> float:
        """Duration, s; 0 for a momentary fault."""
        return self.duration or FAULT_KINDS[self.kind].duration or 0.0


class Inject(Impairment, frozen=True, kw_only=True):
    """Impairment of a link for a limited time."""

    link: str
    """One or several directions (`shared.links`), such as `planner->joints`."""
    at: Time
    duration: Annotated[float, Range(0.001, 86_400.0, "s")] | None = None
    """s; None: to the end of the run."""

    @property
    def until(self) -> float:
        """End, s; infinite if it does not end."""
        return math.inf if self.duration is None else self.at + self.duration


class Scenario(Section, frozen=True):
    """The whole scenario file."""

    name: str
    about: str
    duration: Annotated[float, Range(0.1, 86_400.0, "s")]
    keyframe: tuple[Keyframe, ...]
    hand: bool = True
    """False: the operator's hand is off the harness, so nothing leads."""
    push: tuple[Push, ...] = ()
    act: tuple[Act, ...] = ()
    kill: tuple[Kill, ...] = ()
    restart: tuple[Restart, ...] = ()
    fault: tuple[Fault, ...] = ()
    inject: tuple[Inject, ...] = ()


SCENARIO: Final = "the scenario"
"""Source of a scenario's intents."""


class Lead(NamedTuple):
    """Operator's request at one time."""

    height: float
    """m, torso origin above the ankles."""
    height_rate: float
    pitch: float
    pitch_rate: float
    assist: float
    """N"""
    shift: Shift = (0.0, 0.0, 0.0, 0.0)
    """x, y, m; roll, yaw, rad."""
    side: float | None = None
    """m, world y of the harness point; None: free sideways."""
    side_rate: float = 0.0


def lead(scenario: Scenario, t: float) -> Lead:
    """Return the hand's target at scenario time t, s.

    Before the first keyframe and after the last, this is that keyframe's target.
    """
    frames = scenario.keyframe
    for a, b in pairwise(frames):
        if frames[0].at < t < b.at:
            span = b.at - a.at
            phase = math.pi * (t - a.at) / span
            s = 0.5 - 0.5 * math.cos(phase)
            s_rate = 0.5 * math.pi / span * math.sin(phase)
            return Lead(
                a.height + (b.height - a.height) * s,
                (b.height - a.height) * s_rate,
                a.pitch + (b.pitch - a.pitch) * s,
                (b.pitch - a.pitch) * s_rate,
                a.assist + (b.assist - a.assist) * s,
                _eased(a.shift, b.shift, s),
                *_across(a.side, b.side, s, s_rate),
            )
    rest = frames[0] if t <= frames[0].at else frames[-1]
    return Lead(rest.height, 0.0, rest.pitch, 0.0, rest.assist, rest.shift, rest.side)


def _eased(a: Shift, b: Shift, s: float) -> Shift:
    if a == b:
        return a
    x, y, roll, yaw = (start + (end - start) * s for start, end in zip(a, b, strict=True))
    return x, y, roll, yaw


def _across(
    a: float | None, b: float | None, s: float, s_rate: float
) -> tuple[float | None, float]:
    """Return the y at which the harness point is held, None if it is free, and its rate."""
    if a is None or b is None:
        return None, 0.0
    return a + (b - a) * s, (b - a) * s_rate


def push_at(scenario: Scenario, t: float) -> tuple[float, float, float]:
    """Return the sum of the pushes acting at scenario time t, N, world."""
    x = y = z = 0.0
    for push in scenario.push:
        if push.at <= t < push.at + push.duration:
            x, y, z = x + push.force[0], y + push.force[1], z + push.force[2]
    return x, y, z


def load(path: Path) -> Scenario:
    """Read and check a scenario file; raise ConfigError if it is invalid."""
    scenario = read_toml(path, Scenario)
    check(str(path), scenario)
    return scenario


def check(file: str, scenario: Scenario) -> None:
    """Check values against each other: order, services, times inside the run."""
    check_ranges(file, scenario)
    for index, inject in enumerate(scenario.inject):
        directions_of(inject.link, file, f"inject[{index}].link")
    for problem in _problems(scenario):
        raise ConfigError(file, *problem)


def _problems(scenario: Scenario) -> Iterator[tuple[str, str, str]]:
    """Yield the key, the found value and the right value of each problem."""
    if not scenario.keyframe:
        yield "keyframe", "missing", "add at least one [[keyframe]]"
    for index, (a, b) in enumerate(pairwise(frame.at for frame in scenario.keyframe)):
        if b <= a:
            found = f"{b:g} s is not later than {a:g} s"
            yield f"keyframe[{index + 1}].at", found, "times must increase"
    for kind in ("kill", "restart", "push", "act", "fault", "inject"):
        rows: Sequence[Kill | Restart | Push | Act | Fault | Inject] = getattr(scenario, kind)
        for index, row in enumerate(rows):
            where = f"{kind}[{index}]"
            if isinstance(row, Kill | Restart) and row.service not in SERVICES:
                yield (
                    f"{where}.service",
                    f"{row.service!r} is not valid",
                    f"use one of {', '.join(SERVICES)}",
                )
            if isinstance(row, Fault):
                yield from _fault_problems(where, row)
            if isinstance(row, Inject) and (problem := row.fault()):
                found, _, right = problem.partition("; ")
                yield where, found, right
            if row.at >= scenario.duration:
                found = f"{row.at:g} s is not before the end of the run, {scenario.duration:g} s"
                yield f"{where}.at", found, "use an earlier time or a longer duration"
    for index, restart in enumerate(scenario.restart):
        if not any(k.service == restart.service and k.at < restart.at for k in scenario.kill):
            found = f"{restart.service} is not killed before {restart.at:g} s"
            yield f"restart[{index}]", found, "kill it first"


def _fault_problems(where: str, fault: Fault) -> Iterator[tuple[str, str, str]]:
    if fault.module not in MODULES:
        yield (
            f"{where}.module",
            f"{fault.module!r} is not valid",
            f"use one of {', '.join(MODULES)}",
        )
    traits = FAULT_KINDS[fault.kind]
    if fault.axis not in (None, 0, 1):
        yield f"{where}.axis", f"{fault.axis} is not an axis", "must be 0 or 1"
    if fault.axis is not None and traits.whole:
        found = f"{fault.axis}, but {fault.kind} affects the whole ODrive"
        yield f"{where}.axis", found, "remove it"
    if fault.duration is not None and traits.duration is None:
        found = f"{fault.duration:g} s, but {fault.kind} is momentary"
        yield f"{where}.duration", found, "remove it"
    if fault.duration is not None and not 0.001 <= fault.duration <= 600.0:
        found = f"{fault.duration!r} is out of range"
        yield f"{where}.duration", found, "must be from 0.001 to 600 s"


def to_toml(scenario: Scenario) -> str:
    """Return the scenario as TOML that `load` reads back."""
    table = msgspec.to_builtins(scenario)
    for row in (*table["keyframe"], *table["act"], *table["fault"], *table["inject"]):
        for key in [key for key, value in row.items() if value is None]:
            del row[key]  # TOML has no null
    return tomli_w.dumps(table)
