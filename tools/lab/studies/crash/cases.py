"""The crash matrix as data: the parts that fail, the expected outcome, and its reason.

In every case the operator leads a squat. The crash comes on the way down, with the torso at about
1.0 m. Two pushes follow. Then the lost services are restarted on request, and the operator leads
again.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Final

import msgspec

from shared.config.robot_config import OPTIONAL, SERVICES
from shared.config.scenarios import (
    FAULT_KINDS,
    Fault,
    FaultKind,
    Keyframe,
    Kill,
    Push,
    Restart,
    Scenario,
)
from shared.joints import MODULES, kind_of
from shared.robot.fault_table import DRIVE_FAULTS
from tools.live.scenario_runner import TriggeredKill

CRASH_S: Final = 2.4
REQUEST_S: Final = 5.0
"""Time at which a person ends the service of a module in FAULT, s."""
BACK_S: Final = 5.2
"""Time at which that service, and every killed or stopped one, is restarted, s."""
FAULT_LASTS_S: Final = 2.0
"""Duration of the faults in `_LASTING`, s; they end before `REQUEST_S`."""
DURATION_S: Final = 8.0

HAND: Final = (
    Keyframe(at=0.0, height=1.188),
    Keyframe(at=3.5, height=0.948),
    Keyframe(at=7.0, height=1.188),
)
PUSHES: Final = (
    Push(at=3.4, duration=0.3, force=(30.0, 0.0, 0.0)),
    Push(at=4.2, duration=0.3, force=(0.0, 30.0, 0.0)),
)

CRASHED: Final = tuple(name for name in SERVICES if name not in ("simulator", *OPTIONAL))
"""Services to kill; a robot has no simulator, and may have no IMU."""


class CrashVerdict(StrEnum):
    """Outcome of a case, best first."""

    STOOD = "stood"
    SANK = "sank"
    """Not fallen, but lower than the hand led it."""
    FELL = "fell"
    UNJUDGED = "unjudged"
    """The run did not get far enough to be judged."""


class CrashCase(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the matrix."""

    name: str
    kind: str
    """Kind of crash; `--quick` runs one case of each kind."""
    crash: tuple[Kill | Fault, ...]
    expected: CrashVerdict = CrashVerdict.STOOD
    """Worst allowed verdict."""
    why: str
    """Reason for that expectation."""
    before: tuple[Kill | Restart, ...] = ()
    """Actions before the crash."""
    triggered_kill: TriggeredKill | None = None
    """A crash that a change of the modules' modes triggers."""
    holds: bool = True
    """True if the other modules go to HOLD, False if they continue to track."""
    leads_again: bool = True
    """True if the request brings the module back, False if it would have to be zeroed first."""
    quick: bool = False

    @property
    def hit(self) -> frozenset[str]:
        """Services and modules that the crash hits."""
        names = {row.service if isinstance(row, Kill) else row.module for row in self.crash}
        return frozenset(names | ({self.triggered_kill.service} if self.triggered_kill else set()))

    @property
    def others(self) -> tuple[str, ...]:
        """Modules that are not hit, which must stay safe."""
        return tuple(module for module in MODULES if module not in self.hit)


def scenario_of(case: CrashCase) -> Scenario:
    """Return the case as a scenario, with the requests that restart the lost services."""
    kills = [row for row in (*case.before, *case.crash) if isinstance(row, Kill)]
    down = [row.service for row in case.crash if isinstance(row, Kill)]
    down += [case.triggered_kill.service] if case.triggered_kill else []
    faulted = [row.module for row in case.crash if isinstance(row, Fault)]
    kills += [Kill(service=name, at=REQUEST_S) for name in faulted if name not in down]
    back = dict.fromkeys((*down, *faulted))
    return Scenario(
        name=case.name,
        about=case.why,
        duration=DURATION_S,
        keyframe=HAND,
        push=PUSHES,
        kill=tuple(kills),
        restart=(
            *(row for row in case.before if isinstance(row, Restart)),
            *(Restart(service=name, at=BACK_S) for name in back),
        ),
        fault=tuple(row for row in case.crash if isinstance(row, Fault)),
    )


def describe(case: CrashCase) -> str:
    """Return the actions of a case as text."""
    scenario = scenario_of(case)
    words = [
        f"{row.service} {row.signal} at {row.at:g} s" for row in scenario.kill if row.at <= CRASH_S
    ]
    words += [f"{row.service} back at {row.at:g} s" for row in scenario.restart if row.at < CRASH_S]
    if case.triggered_kill is not None:
        when = f"{case.triggered_kill.after_s:g} s after" if case.triggered_kill.after_s else "as"
        many = "all modules track" if case.triggered_kill.modules > 1 else "the first module tracks"
        words.append(f"{case.triggered_kill.service} KILL {when} {many} again")
    words += [f"{row.module} {row.kind} at {row.at:g} s" for row in scenario.fault]
    return f"{', '.join(words)}; requested back at {BACK_S:g} s"


LIMP: Final = {
    "ankle": (
        CrashVerdict.FELL,
        "its sole carries no moment: a push to its side tips the robot",
    ),
    "knee": (
        CrashVerdict.STOOD,
        "the other five stiffen, and its leg acts as a strut on a stiff hip",
    ),
    "hip": (CrashVerdict.STOOD, "the other hip carries the torso's pitch alone"),
}
"""Allowed outcome and its reason for a robot with one limp module, by the kind of module."""

_LEFT: Final = ("hip_left", "knee_left", "ankle_left")
FAULTED: Final[tuple[tuple[FaultKind, Sequence[str], str, str], ...]] = (
    ("link_lost", MODULES, "knee_left", "unplugged"),
    ("disarmed", MODULES, "hip_left", "disarmed"),
    ("encoder", MODULES, "ankle_left", "encoder"),
    ("brown_out", _LEFT, "hip_left", "brown_out"),
    ("over_voltage", _LEFT, "hip_left", "drive trips"),
    ("over_temperature", ("hip_left",), "", "drive trips"),
    ("watchdog", ("hip_left",), "", "drive trips"),
    ("overspeed", ("hip_left",), "", "drive trips"),
    ("encoder_zero", ("knee_left",), "", "encoder"),
    ("encoder_gap", ("knee_left", "hip_left"), "", "encoder"),
    ("no_ack", ("knee_left",), "knee_left", "dead bus"),
    ("bus_full", ("knee_left",), "", "dead bus"),
    ("bus_flap", ("knee_left",), "", "dead bus"),
)
"""Fault, modules, the module in `--quick`, and kind of crash.

Left and right are symmetric. One module is enough where the fault leaves it as limp as `disarmed`
does, and only the error's name differs. On a dead bus a drive holds its last target."""
_DEAD_BUS: Final = ("no_ack", "bus_full", "bus_flap")
_LASTING: Final = ("encoder", "encoder_zero", "link_lost", "over_temperature", *_DEAD_BUS)
_FREE: Final = "each drive holds with its own loop, and needs neither its service nor the others'"
_NEITHER: Final = "HOLD needs neither"


def killed(*services: str, signal: str = "KILL") -> tuple[Kill, ...]:
    """Return simultaneous crashes of these services."""
    row = {"at": CRASH_S, "signal": signal}
    return tuple(msgspec.convert({**row, "service": name}, Kill) for name in services)


def fault(module: str, kind: FaultKind) -> Fault:
    """Return a drive's fault at the time of the crash."""
    lasts = FAULT_LASTS_S if kind in _LASTING else None
    return Fault(module=module, kind=kind, at=CRASH_S, duration=lasts)


def _lost(service: str, signal: str) -> CrashCase:
    """Return the case of one service that dies or is suspended."""
    is_joint, is_planner = service in MODULES, service == "planner"
    if is_joint:
        why = "its drive holds the module with its own loop; the planner makes the others hold"
    elif is_planner:
        why = "commands become stale, and all six modules hold on their own gains"
    else:
        why = "balance does not need it"
    how = "kill" if signal == "KILL" else "stop"
    vital = is_joint or is_planner
    return CrashCase(
        name=f"{how}-{service}",
        kind=f"{how} {'joint service' if is_joint else service}" if vital else f"{service} lost",
        crash=killed(service, signal=signal),
        why=why,
        holds=vital,
        quick=service in ("knee_left", "planner") or (signal == "KILL" and not vital),
    )


def _faulted(module: str, kind: FaultKind, *, quick: bool, sort: str) -> CrashCase:
    """Return the case of one drive's fault."""
    name: str = kind
    expected = CrashVerdict.STOOD
    # a knee moves on the way down, so its count jumps when the gap ends (OVERSPEED)
    hardly_moves = kind == "encoder_gap" and kind_of(module) != "knee"
    if hardly_moves:
        why = "the joint hardly moves in the gap, so the drive holds through it"
    elif not DRIVE_FAULTS[kind].limp and kind != "encoder_gap":
        name = "unplugged" if kind == "link_lost" else kind
        why = "the drive holds its last target; its service has lost contact"
    else:
        expected, reason = LIMP[kind_of(module)]
        why = f"limp ({FAULT_KINDS[kind].about}): {reason}"
    return CrashCase(
        name=f"{name}-{module}",
        kind=sort,
        crash=(fault(module, kind),),
        expected=expected,
        why=why,
        holds=kind != "bus_full" and not hardly_moves,
        leads_again=not DRIVE_FAULTS[kind].zero_lost,
        quick=quick,
    )


def _reengaging(name: str, why: str, modules: int, after_s: float) -> CrashCase:
    """Return the case of a planner that is killed again while it re-engages."""
    return CrashCase(
        name=f"reengaging-{name}",
        kind="planner killed during re-engagement",
        crash=(),
        before=(Kill(service="planner", at=0.8), Restart(service="planner", at=0.9)),
        triggered_kill=TriggeredKill("planner", modules=modules, after_s=after_s),
        why=why,
        quick=name == "blend",
    )


def _all_joints(name: str, *crash: Kill | Fault, quick: bool = False) -> CrashCase:
    return CrashCase(name=name, kind="all joint services", crash=crash, why=_FREE, quick=quick)


def _pair(name: str, *crash: Kill | Fault, why: str = _FREE, **changes: Any) -> CrashCase:
    """Return the case of two losses at once."""
    return CrashCase(name=f"pair-{name}", kind="pair", crash=crash, why=why, **changes)


_KNEES: Final = ("knee_right", "knee_left")
_HIP: Final = fault("hip_left", "disarmed")

CASES: Final[Sequence[CrashCase]] = (
    *(_lost(service, "KILL") for service in CRASHED),
    *(_lost(service, "STOP") for service in CRASHED),
    *(
        _faulted(module, kind, quick=module == quick, sort=sort)
        for kind, modules, quick, sort in FAULTED
        for module in modules
    ),
    _reengaging("first", "the first module tracks, and others may hold: all hold again", 1, 0.0),
    _reengaging("blend", "halfway from HOLD to TRACK: the blend freezes where it is", 6, 0.15),
    _all_joints("kill-all-joints", *killed(*MODULES), quick=True),
    _all_joints("stop-all-joints", *killed(*MODULES, signal="STOP")),
    _all_joints("kill-all-and-planner", *killed("planner", *MODULES)),
    _all_joints("unplugged-all", *(fault(module, "link_lost") for module in MODULES)),
    _pair("knees", *killed(*_KNEES)),
    _pair("ankles", *killed("ankle_right", "ankle_left")),
    _pair("hips", *killed("hip_right", "hip_left")),
    _pair("ankle-knee", *killed("ankle_left", "knee_left")),
    _pair("planner-knee", *killed("planner", "knee_left"), quick=True),
    _pair("planner-harness", *killed("planner", "harness"), why=_NEITHER),
    _pair("planner-recorder", *killed("planner", "recorder"), why=_NEITHER),
    _pair(
        "harness-recorder", *killed("harness", "recorder"), why="balance needs neither", holds=False
    ),
    _pair("stopped-planner-knee", *killed("planner", signal="STOP"), *killed("knee_left")),
    _pair("knee-unplugged-hip", *killed("knee_left"), fault("hip_right", "link_lost")),
    _pair("knee-and-its-link", *killed("knee_left"), fault("knee_left", "link_lost")),
    _pair("unplugged-knees", *(fault(module, "link_lost") for module in _KNEES)),
    _pair("planner-limp-hip", *killed("planner"), _HIP, why=LIMP["hip"][1]),
    _pair(
        "limp-hips",
        fault("hip_right", "disarmed"),
        _HIP,
        expected=CrashVerdict.FELL,
        why="only the hand still holds the torso's pitch",
    ),
    _pair(
        "limp-knees",
        *(fault(module, "disarmed") for module in _KNEES),
        expected=CrashVerdict.FELL,
        why="both legs fold",
    ),
)
"""The whole matrix, in running order."""
