"""`xrl drive jog`: moves one joint a little and back, on the bench, and judges the response."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean
from typing import Annotated, Final, NamedTuple

from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus.messages import Pair
from shared.config import files as config_file
from shared.exceptions import FAULT_EXIT_CODE, DriveError
from shared.joints import AXES, MODULES, kind_of
from shared.toml_file import Range
from tools.bringup import drive_access
from tools.bringup.motion import SETTLE_S, MotionPlan, Sample, limit_drives
from tools.bringup.motion_runner import (
    Interrupts,
    Moved,
    Stopped,
    ask_and_move,
    exit_if_interrupted,
    tell_stopped,
)
from tools.flags import Arg, MotionFlags, Number, positional
from tools.terminal import Console, marked

BY: Final = 0.05
PERIOD_S: Final = 2.0
CYCLES: Final = 2
TORQUE_LIMIT: Final = 10.0
EMULATED: Final = 40.0
"""Torque that bends a leg of the emulated robot, which hangs with its soles on the floor, N m."""
BY_MAX: Final = 0.5
PERIOD_MIN_S: Final = 0.5
CYCLES_MAX: Final = 100

EXAMPLES: Final = """
xrl drive jog knee_left
xrl drive jog hip_right --axis phi --by -0.1 --period 4
xrl drive jog knee_left --torque-limit 30     # if its load needs more
"""

TRAVEL_SHARE: Final = 0.25
"""Maximum error of the travel, as a fraction of the requested travel."""
LAG_MAX: Final = 0.02
"""Maximum lag behind the reference, rad, besides the deflection under the load at rest."""
SIBLING_MAX: Final = 0.02
"""Maximum motion of the other axis, rad."""


class JogFlags(MotionFlags):
    """Joint to move, and its motion."""

    module: Annotated[str, positional("MODULE", choices=MODULES)]
    """module, such as knee_left"""
    axis: Annotated[str, Arg(choices=AXES)] = "theta"
    """axis to move"""
    by: Annotated[float, Range(-BY_MAX, BY_MAX, "rad")] = BY
    """distance one way; positive theta leans the part above forward"""
    period: Annotated[float, Range(PERIOD_MIN_S, 60.0, "s")] = PERIOD_S
    """time of one motion out and back"""
    cycles: Annotated[int, Range(1, CYCLES_MAX, "")] = CYCLES
    """number of motions"""
    torque_limit: Annotated[Number, Arg(metavar="NM")] = TORQUE_LIMIT
    """torque limit at the joint, both axes together, set as the drive's current limit"""

    def check(self) -> None:
        """Refuse a motion of zero."""
        super().check()
        if self.by == 0.0:
            raise DriveError(f"--by 0: moves nothing; use at most {BY_MAX:g} rad either way")

    @property
    def plan(self) -> JogPlan:
        """The requested motion."""
        course = ThereAndBack(self.by, self.period, self.cycles)
        return JogPlan(AXES.index(self.axis), course, self.torque_limit)


def run(flags: JogFlags) -> int:
    """Check the joint, ask the person, move the joint, idle the drive and judge the motion."""
    console = Console()
    plan = flags.plan
    path = drive_access.robot_file(flags)
    module: str = flags.module
    robot = config_file.load_without_schedule(path)
    limited = limit_drives(robot, plan)
    drive_access.refuse_service(robot, module, flags.run_dir)
    interrupts = Interrupts()

    def introduce(_q: Mapping[str, Pair]) -> JogPlan:
        by, period_s, cycles = plan.course
        console.print(
            f"{module} {flags.axis}: {by:+g} rad and back, {cycles} times, {period_s:g} s each, "
            f"with at most {plan.torque_limit:g} N m "
            f"({limited.drive.current_lim:.1f} A per motor, {limited.drive.vel_limit:.1f} turn/s)"
        )
        console.print(f"you should see: {what_to_see(module, plan.axis, by)}")
        return plan

    with drive_access.drives_to_ourselves(robot, path, flags.run_dir, console.print) as started:
        if started:
            console.print(f"the soles rest on the floor: a leg needs --torque-limit {EMULATED:g}")
        moved = ask_and_move(
            flags, robot, (module, plan.axis), introduce, interrupts, console, alone=True
        )
    if moved is None:
        return 0
    if isinstance(moved, Stopped):
        code = tell_stopped(moved, console)
    else:
        code = report(moved, module, console)
    if not isinstance(moved, Stopped) or not (moved.declined or moved.not_idle):
        console.print("both axes are idle")
    exit_if_interrupted(interrupts)
    return code


def report(moved: Moved[ThereAndBack], module: str, console: Console) -> int:
    """Print the verdict; return 0 if the joint followed."""
    plan = moved.plan
    rows = judge(moved.samples, plan)
    table = Table("", "measured", "wanted", "", box=box.SIMPLE_HEAD)
    for row in rows:
        verdict = Text("ok") if row.good else Text("not good", "bold red")
        table.add_row(row.what, row.value, row.wanted, verdict if row.wanted else "")
    console.print(table)
    code = 0 if all(row.good for row in rows) else FAULT_EXIT_CODE
    words = "[bold red]DID NOT FOLLOW[/]" if code else "[bold green]FOLLOWED[/]"
    console.print(marked(f"{words}: {{}} {{}}", module, AXES[plan.axis]))
    console.print(
        f"correct only if you saw this: {what_to_see(module, plan.axis, plan.course.by)}; "
        "an encoder on the motor cannot show it"
    )
    return code


class ThereAndBack(NamedTuple):
    """Repeated motion by/2 (1 - cos) about the axis."""

    by: float
    """Distance one way, rad."""
    period_s: float
    """Period of one motion there and back, s."""
    cycles: int

    @property
    def duration_s(self) -> float:
        """Duration of all cycles, s."""
        return self.cycles * self.period_s

    @property
    def span(self) -> Pair:
        """Lowest and highest offset, rad."""
        return min(0.0, self.by), max(0.0, self.by)

    @property
    def rate_max(self) -> float:
        """Maximum requested rate, rad/s."""
        return math.pi * abs(self.by) / self.period_s

    def at(self, t_s: float) -> Pair:
        """Return offset, rad, and rate, rad/s."""
        omega = 2.0 * math.pi / self.period_s
        return (
            0.5 * self.by * (1.0 - math.cos(omega * t_s)),
            0.5 * self.by * omega * math.sin(omega * t_s),
        )


JogPlan = MotionPlan[ThereAndBack]


class JogCheck(NamedTuple):
    """One line of the verdict."""

    what: str
    value: str
    wanted: str
    """Criterion; "" if the value is only shown."""
    good: bool


def what_to_see(module: str, axis: int, by: float) -> str:
    """Return a description of the correct motion, for a person who watches.

    A positive angle leans the part above the joint forward (theta) or to the right (phi)
    relative to the part below; if the torso hangs, the part below swings that way instead.
    """
    kind, positive = kind_of(module), by > 0.0
    upper = {"ankle": "shin", "knee": "thigh", "hip": "torso"}[kind]
    if axis == 1:
        way = "forward" if positive else "back"
        foot = "the toes point up" if positive else "the toes point down"
    else:
        way = "to its right" if positive else "to its left"
        foot = f"the sole turns its {'right' if positive else 'left'} edge up"
    lower = {"ankle": foot, "knee": f"the shin swings {way}", "hip": f"the thigh swings {way}"}
    return f"the {upper} leans {way}; if the torso hangs, {lower[kind]}"


def judge(samples: list[Sample], plan: JogPlan) -> list[JogCheck]:
    """Return the checks of a completed jog."""
    axis, other, by = plan.axis, 1 - plan.axis, plan.course.by
    rest = [s for s in samples if s.t_s < SETTLE_S][-20:]
    moving = [s for s in samples if SETTLE_S <= s.t_s <= plan.duration_s - SETTLE_S]
    if not rest or not moving:
        found = f"{len(rest)} at rest, {len(moving)} moving"
        return [JogCheck("samples", found, "some of both", False)]
    q_rest = fmean([s.q[axis] for s in rest])
    sag = q_rest - rest[-1].q_ref[axis]
    sign = math.copysign(1.0, by)
    travel = sign * max(sign * (s.q[axis] - q_rest) for s in moving)
    lag = max(abs(s.q[axis] - s.q_ref[axis] - sag) for s in moving)
    still = fmean([s.q[other] for s in rest])
    strayed = max(abs(s.q[other] - still) for s in moving)
    peak = max(abs(s.tau[0]) + abs(s.tau[1]) for s in samples)
    went, wanted = f"{travel:+.4f} rad", f"{by:+.4f} within {TRAVEL_SHARE:.0%}"
    at_rest = f"{fmean([s.tau[axis] for s in rest]):+.2f} N m"
    stray_max = f"<= {SIBLING_MAX:g}"
    return [
        JogCheck(f"{AXES[axis]} travel", went, wanted, abs(travel - by) <= TRAVEL_SHARE * abs(by)),
        JogCheck("largest lag", f"{lag:.4f} rad", f"<= {LAG_MAX:g}", lag <= LAG_MAX),
        JogCheck(f"{AXES[other]} moved", f"{strayed:.4f} rad", stray_max, strayed <= SIBLING_MAX),
        JogCheck("torque at rest", at_rest, "", True),
        JogCheck("largest torque, both axes", f"{peak:.2f} N m", f"< {plan.torque_limit:g}", True),
        JogCheck("friction, dry and viscous", f"{friction(moving, plan):.2f} N m", "", True),
    ]


def friction(moving: list[Sample], plan: JogPlan) -> float:
    """Return half the difference between the mean torques there and back, N m; NaN if unknown.

    Uses only the fast part of the motion; the torques of gravity and springs cancel.
    """
    omega = 2.0 * math.pi / plan.course.period_s
    sign = math.copysign(1.0, plan.course.by)
    there: list[float] = []
    back: list[float] = []
    for s in moving:
        sine = math.sin(omega * (s.t_s - SETTLE_S))
        if abs(sine) > 0.5:
            (there if sine > 0.0 else back).append(sign * s.tau[plan.axis])
    return 0.5 * (fmean(there) - fmean(back)) if there and back else math.nan
