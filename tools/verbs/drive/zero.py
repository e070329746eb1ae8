"""`xrl drive zero`: tell drives where their joints are."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
import numpy as np
from rich import box
from rich.table import Column, Table
from rich.text import Text

from services.joint.differential import motor_from_joint
from services.joint.drivers.base import Drive, DriveStatus
from shared.bus import topics
from shared.bus.messages import JointState, Mode, Pair
from shared.bus.session import open_session
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError, FleetError, RunError
from shared.joints import MODULE_INDEX, MODULES, kind_of
from shared.robot.robot_model import stand_pose
from tools.bringup import drive_access, zero_record
from tools.bringup.hanging_leg import leg_of
from tools.bringup.whole_turns import UNMOVED, Decision, decide
from tools.bringup.zero_record import Identity, ZeroRecord
from tools.bringup.zeroing import (
    HOW,
    DriveLook,
    Swing,
    is_right,
    look,
    refusal,
    watch,
    why_outside,
    zero,
)
from tools.flags import Arg, FleetRobotFlags, Number, numbers, parsed, positional
from tools.fleet.supervise import SupervisedFleet
from tools.terminal import Console, marked

HEIGHT_TOLERANCE: Final = 1e-7
"""m of torso height"""
ROUNDS: Final = 20
"""Most rounds of the search for the COM height of a torso height; three are usual."""
DEGREES_FROM: Final = 7.0
"""No joint has an angle of so many rad: more than a turn."""

HEARD_S: Final = 2.0
"""Longest wait for the states of joint services that are up."""


EXAMPLES: Final = """
xrl drive zero knee_left --at 0,-0.5          # by a protractor: phi, theta in rad
xrl drive zero ankle_right --at -0.02,0.14
xrl drive zero --all --standing 1.188         # in the jig: soles flat, hips 1.188 m above ankles
xrl drive zero --all --resume                 # after a loss of power, hanging: what has not moved
xrl drive zero --all --resume --untouched --swing --level     # knees and hips that have moved
xrl drive zero ankle_left --resume --untouched --at 0.1,0.3   # roughly, to 0.08 rad
"""


_PAIR: Final = numbers(2, "phi and theta in rad, such as 0,-0.5")


class ZeroFlags(FleetRobotFlags):
    """Which modules, and where their joints are."""

    module: Annotated[str | None, positional("MODULE", choices=MODULES, exclusive="which!")] = None
    """one module"""
    all: Annotated[bool, Arg(exclusive="which!")] = False
    """all six"""
    at: Annotated[Pair | None, parsed(_PAIR, "PHI,THETA", exclusive="where")] = None
    """the joint is at these angles now, rad, as 0,-0.5"""
    standing: Annotated[Number | None, Arg(metavar="HEIGHT", exclusive="where")] = None
    """the robot stands or hangs as if it stood: both soles flat and level, at their distance
    (geometry.w_base), torso upright, COM over the ankles, the hips' axis HEIGHT m above the
    ankles'; the angles then follow from the lengths in the robot file"""
    resume: bool = False
    """after a loss of power, the robot hanging: find the whole turns by what was stored with the
    zero, and say how clear that is; what is not clear is refused. --at and --standing are then
    rough, within 0.08 rad"""
    untouched: bool = False
    """with --resume: you say that no encoder, magnet, motor or encoder cable was touched since the
    zero; needed for joints that have moved"""
    swing: bool = False
    """with --resume: watch the legs swing, which shows that they hang free; for knees and hips that
    have moved"""
    level: bool = False
    """with --resume, where no IMU is fitted: the torso is level to 2 degrees by a spirit level"""
    rest: bool = False
    """change no zero; store where the joints rest now, for --resume (`xrl down` does it)"""
    yes: bool = False
    """do not ask"""

    @property
    def modules(self) -> tuple[str, ...]:
        """The selected modules."""
        return MODULES if self.module is None else (self.module,)

    def check(self) -> None:
        """Refuse one module's angles for all, and flags that do not fit each other."""
        super().check()
        where = [self.at, self.standing]
        if self.rest and (self.resume or any(one is not None for one in where)):
            raise DriveError("--rest changes no zero; give it alone")
        if not self.resume and (self.untouched or self.swing or self.level):
            raise DriveError("--untouched, --swing and --level are for --resume")
        if not (self.resume or self.rest or any(one is not None for one in where)):
            raise DriveError("give --at or --standing; after a loss of power --resume")
        if self.all and self.at is not None:
            raise DriveError("--at is for one module; for all give --standing HEIGHT")


def run(flags: ZeroFlags) -> int:
    """Look, ask, set, read back; keep the zero for a loss of power."""
    console = Console()
    path = drive_access.robot_file(flags)
    robot = config_file.load_without_schedule(path)
    wanted = angles_of(flags, robot, console)
    modules = flags.modules
    holders = {module: drive_access.service_on(robot, module, flags.run_dir) for module in modules}
    with drive_access.drives_to_ourselves(robot, path, flags.run_dir, console.print) as started:
        if flags.rest:
            kept = zero_record.store_rests(robot, path, flags.run_dir, modules, console.print)
            console.print(f"{kept} of {len(modules)} modules rest, and that is stored")
            return 0 if kept == len(modules) else FAULT_EXIT_CODE
        refuse_services(robot, holders)
        known = zero_record.identities(robot, flags.run_dir, modules, console.print)
        record = zero_record.read_zeros(zero_record.path_of(robot, path, flags.run_dir), robot)
        work = _Work(robot, path, flags, holders, known, record, console)
        if flags.resume:
            code = _resume(work, wanted)
        else:
            with zero_record.drives_of(robot, modules, flags.run_dir) as drives:
                code = _zero(work, drives, wanted)
    if started:
        console.print(drive_access.GONE)
    return code


class _Work(NamedTuple):
    """What zeroing and resuming have in common."""

    robot: RobotConfig
    path: Path
    flags: ZeroFlags
    holders: Mapping[str, SupervisedFleet | None]
    known: Mapping[str, Identity]
    record: ZeroRecord
    console: Console

    def keep(self, record: ZeroRecord) -> None:
        """Write the zeros; that fails with a warning, because the drives have them."""
        try:
            zero_record.write_zeros(
                zero_record.path_of(self.robot, self.path, self.flags.run_dir), record
            )
        except DriveError as error:
            self.console.print(marked("[yellow]{}[/]", error))


def _zero(work: _Work, drives: Mapping[str, Drive], wanted: Mapping[str, Pair]) -> int:
    """Zero by measured angles; return the exit code."""
    robot, console = work.robot, work.console
    before = _look_all(robot, drives)
    console.print(plan_table(wanted, before))
    _warn(wanted, work.holders, console)
    if not drive_access.confirm("Are the joints at these angles now?", yes=work.flags.yes):
        console.print("nothing was changed")
        return DECLINED_EXIT_CODE
    refuse_services(robot, work.holders)  # a person may take minutes to answer
    _look_all(robot, drives)
    done = _set_all(robot, drives, wanted, console)
    modules = dict(work.record.modules)
    for module in done:
        seen = look(drives[module], robot)
        identity, angles = work.known.get(module), seen.angles
        modules.pop(module, None)
        why = zero_record.why_not_kept(robot, seen, identity)
        if why or angles is None:
            console.print(marked("[yellow]{}: not kept over a loss of power: {}[/]", module, why))
            continue
        modules[module] = zero_record.zeroed(robot, module, seen.q_there, angles, identity)
    if done:
        work.keep(msgspec.structs.replace(work.record, modules=modules))
    return 0 if len(done) == len(wanted) else FAULT_EXIT_CODE


def _resume(work: _Work, about: Mapping[str, Pair]) -> int:
    """Find the whole turns again, ask, set; return the exit code."""
    robot, flags, console = work.robot, work.flags, work.console
    gear_ratio = robot.joint.gear_ratio
    unknown = [module for module in flags.modules if module not in work.record.modules]
    if len(unknown) == len(flags.modules):
        raise DriveError(
            f"{', '.join(unknown)}: no zero is stored; zero by a protractor (--at, --standing), "
            "as on the first day: from then on it can be resumed"
        )
    up = zero_record.upright(robot, flags.run_dir, level=flags.level)
    with zero_record.drives_of(robot, leg_of(*flags.modules), flags.run_dir) as drives:
        swings: dict[str, Swing] = {}
        if flags.swing:
            console.print(HOW)
            legs = {name: one for name, one in drives.items() if kind_of(name) != "ankle"}
            swings = watch(legs, gear_ratio, console.print)
        looks, _ = zero_record.looks_at_rest(drives, robot)
        faults = {module: refusal(seen) for module, seen in looks.items()}
        fit = {module: seen for module, seen in looks.items() if not faults[module]}
        found = decide(
            robot,
            zero_record.evidence_of(
                robot, work.record, fit, work.known,
                untouched=flags.untouched, about=about, swings=swings,
            ),
            up,
        )  # fmt: skip
        taken, zeroed = {}, []
        for module in flags.modules:
            decision = found.get(module) or Decision(None, "", math.inf, math.inf, "")
            if looks[module].zeroed and not faults[module]:
                zeroed.append(module)
            elif decision.q is not None:
                taken[module] = decision.q
            else:
                why = decision.why or faults[module] or "no zero of it is stored: zero it by --at"
                console.print(marked("[yellow]{}: refused:[/] {}", module, why))
        if zeroed:
            console.print(f"{', '.join(zeroed)}: zeroed already; left as they are")
        if not taken:
            console.print("nothing was changed")
            return 0 if len(zeroed) == len(flags.modules) else FAULT_EXIT_CODE
        console.print(resumed_table({module: found[module] for module in taken}))
        _warn(taken, work.holders, console)
        if not drive_access.confirm("Does the robot hang so?", yes=flags.yes):
            console.print("nothing was changed")
            return DECLINED_EXIT_CODE
        refuse_services(robot, work.holders)
        now = {module: look(drives[module], robot) for module in taken}
        for module, seen in now.items():
            if refusal(seen) or not zero_record.same_angles(seen, looks[module], UNMOVED):
                raise DriveError(f"{module}: it has moved meanwhile; nothing was changed; again")
        done = [
            module
            for module in _set_all(robot, drives, taken, console)
            if _is_its_zero(work, module, drives[module])
        ]
        rests = {module: motor_from_joint(taken[module], gear_ratio) for module in done}
        work.keep(zero_record.with_rests(work.record, rests))
    return 0 if len(done) + len(zeroed) == len(flags.modules) else FAULT_EXIT_CODE


def _is_its_zero(work: _Work, module: str, drive: Drive) -> bool:
    """Return True if a drive has its stored zero again, or else forgets the one it was given.

    A joint that creeps while it is written has another.
    """
    seen, offsets = look(drive, work.robot), work.record.modules[module].offsets
    why = zero_record.not_its_zero(seen, offsets, work.robot.joint.gear_ratio)
    if why:
        work.console.print(marked("[bold red]{}: it moved as it was written; again[/]", module))
        if seen.status is not DriveStatus.ARMED:
            drive.set_position((0.0, 0.0))
    return not why


def resumed_table(found: Mapping[str, Decision]) -> Table:
    """Return what was found as a table for the terminal."""
    table = _table("found, rad", "by", "second best, rad away", "it takes, of what is allowed")
    for module, decision in found.items():
        if decision.q is not None:
            times = f"{decision.times:.1f} times" if decision.by != "unmoved" else "-"
            table.add_row(module, _angles(decision.q), decision.by, f"{decision.second:.2f}", times)
    return table


def angles_of(flags: ZeroFlags, robot: RobotConfig, console: Console) -> dict[str, Pair]:
    """Return the position (phi, theta), rad, of each selected module.

    Raises:
        DriveError: an angle is outside the limits.
        RunError: there is no such stand.
    """
    wanted: dict[str, Pair] = {}
    if flags.at is not None:
        wanted = dict.fromkeys(flags.modules, flags.at)
    elif flags.standing is not None:
        stand = stand_angles(robot, flags.standing)
        console.print(
            f"a stand with the hips {flags.standing:g} m above the ankles and "
            f"{abs(stand.hips_forward):.3f} m {'before' if stand.hips_forward > 0 else 'behind'} "
            "them, torso upright, soles flat"
        )
        wanted = {module: stand.q[module] for module in flags.modules}
    for module, q in wanted.items():
        if fault := why_outside(robot, module, q):
            raise DriveError(f"{module}: {fault}{_if_degrees(q)}")
    return wanted


def _if_degrees(q: Pair) -> str:
    """Return what to write instead of angles that can only be degrees; "" if they cannot."""
    if not max(map(abs, q)) > DEGREES_FROM:
        return ""
    phi, theta = map(math.radians, q)
    return f"; if these are degrees: --at {phi:.4g},{theta:.4g}"


def refuse_services(robot: RobotConfig, holders: Mapping[str, SupervisedFleet | None]) -> None:
    """Refuse where a joint service has the drive's USB, or is not DISARMED.

    Raises:
        FleetError: naming the first such module, and what to do.
    """
    up = {module: fleet for module, fleet in holders.items() if fleet is not None}
    for module, fleet in up.items():
        if robot.joint_service.driver == "odrive_usb":
            raise FleetError(
                f"{module}: its joint service in {fleet.run.path} has the drive's USB; "
                "`xrl down` first"
            )
    for fleet in {fleet.run.path: fleet for fleet in up.values()}.values():
        served = [module for module, other in up.items() if other.run.path == fleet.run.path]
        states = _states(robot, fleet, served)
        for module in served:
            state = states.get(module)
            if state is None:
                raise FleetError(
                    f"{module}: its joint service in {fleet.run.path} is up, but sends no state; "
                    "see `xrl status`, or `xrl down` first"
                )
            if state.mode != Mode.DISARMED:
                raise FleetError(f"{module}: {_way_out(module, Mode(state.mode))}")


def plan_table(wanted: Mapping[str, Pair], before: Mapping[str, DriveLook]) -> Table:
    """Return the changes as a table for the terminal."""
    table = _table("before, rad", "after, rad", "change, rad")
    for module, q in wanted.items():
        seen = before[module]
        if seen.zeroed:
            change = (q[0] - seen.q[0], q[1] - seen.q[1])
            table.add_row(module, _angles(seen.q), _angles(q), _angles(change))
        else:
            table.add_row(module, "unzeroed", _angles(q), "-")
    return table


def _set_all(
    robot: RobotConfig, drives: Mapping[str, Drive], wanted: Mapping[str, Pair], console: Console
) -> list[str]:
    """Set all, read all back, show it; return which read back right."""
    table = _table("written, rad", "read back, rad", "")
    done = []
    for module, q in wanted.items():
        try:
            back = zero(drives[module], q, robot)
        except DriveError as error:  # one that fails does not stop the others
            console.print(marked("[bold red]{}[/]: {}", module, error))
            back = None
        good = is_right(back, q)
        done += [module] * good
        read = "nothing" if back is None else _angles(back.q)
        outcome = Text("zeroed") if good else Text("NOT zeroed", "bold red")
        table.add_row(module, _angles(q), read, outcome)
    console.print(table)
    if len(done) < len(wanted):
        console.print(
            marked("[bold red]do not arm an unzeroed drive[/]: check it, and zero it again")
        )
    return done


def _look_all(robot: RobotConfig, drives: Mapping[str, Drive]) -> dict[str, DriveLook]:
    """Look at every drive.

    Raises:
        DriveError: one cannot be zeroed now; names all that cannot.
    """
    seen = {module: look(drive, robot) for module, drive in drives.items()}
    faults = [f"{module}: {why}" for module, one in seen.items() if (why := refusal(one))]
    if faults:
        raise DriveError("; ".join(faults) + "; nothing was changed")
    return seen


def _warn(
    wanted: Mapping[str, Pair], holders: Mapping[str, SupervisedFleet | None], console: Console
) -> None:
    """Say what comes by itself once a drive is zeroed."""
    armed = [module for module in wanted if holders[module] is not None]
    if armed:
        console.print(
            marked(
                "[yellow]{}: the joint service is up and, unless it is read-only, "
                "arms the drive as soon as it is zeroed[/]",
                ", ".join(armed),
            )
        )


def _states(
    robot: RobotConfig, fleet: SupervisedFleet, modules: list[str]
) -> dict[str, JointState]:
    """Return one state of each module of a fleet that sends any."""
    states: dict[str, JointState] = {}
    with open_session(robot, "zero", fleet.run.path) as session:
        ends = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in modules}
        deadline = time.monotonic() + HEARD_S
        while time.monotonic() < deadline and len(states) < len(modules):
            for module, latest in ends.items():
                state = latest.take()
                if state is not None:  # its stamp is the drive's, which may be silent
                    states[module] = state
            time.sleep(0.01)
    return states


def _way_out(module: str, mode: Mode) -> str:
    """Return why a joint service in this mode is in the way, and what to do."""
    if mode in (Mode.HOLD, Mode.TRACK):
        return f"its joint service holds it ({mode.name}); hang the robot and `xrl down` first"
    return (
        f"its joint service is in {mode.name}; hang the robot and `xrl kill {module}` "
        "(a restart leaves it), or `xrl down` first"
    )


def _angles(q: Pair) -> str:
    return f"{q[0]:+.4f} {q[1]:+.4f}"


def _table(*columns: str) -> Table:
    headings = [Column(heading, no_wrap=True) for heading in ("module", *columns)]
    return Table(*headings, box=box.SIMPLE_HEAD, caption="phi, theta", caption_justify="left")


class StandAngles(NamedTuple):
    """An upright stand, soles flat, COM over the ankles."""

    q: dict[str, Pair]
    """(phi, theta) of each module, rad."""
    hips_forward: float
    """Position of the hips ahead of the ankles with the COM over the ankles, m."""


def stand_angles(robot: RobotConfig, height: float) -> StandAngles:
    """Return the stand with the torso level and its origin (between the hips) at a height, m."""
    from services.planner.law.inverse_kinematics import (  # noqa: PLC0415 - takes a second
        InverseKinematics,
        describe,
    )
    from services.planner.law.kinematics import Kinematics  # noqa: PLC0415

    longest = robot.geometry.l1 + robot.geometry.l2
    if not 0.0 < height < longest:
        text = f"--standing {height:g}: the hips are between 0 and {longest:g} m above the ankles"
        in_mm = f"; if these are mm: --standing {height / 1e3:g}" if height > 100.0 else ""
        raise RunError(text + in_mm)
    limits = np.array(robot.joint_limits())
    kinematics = Kinematics(robot)
    ik = InverseKinematics(kinematics, limits)
    ik.q[:] = stand_pose(robot, height)
    kinematics.update(ik.q)
    p_ref = np.array([0.0, 0.0, kinematics.p[2], 0.0, 0.0, 0.0])
    slope, before = 1.0, None  # d COM height / d torso height, by the last two rounds
    for _ in range(ROUNDS):
        reach = ik.solve_from_anywhere(p_ref)
        if not reach.converged:
            raise RunError(f"--standing {height:g}: {describe(reach, p_ref, limits)}")
        z, z_com = float(kinematics.r_torso[2]), float(p_ref[2])
        if abs(height - z) <= HEIGHT_TOLERANCE:
            angles = ik.q.reshape(len(MODULES), 2).tolist()
            q = {module: (angles[i][0], angles[i][1]) for module, i in MODULE_INDEX.items()}
            return StandAngles(q, float(kinematics.r_torso[0]))
        if before is not None and z != before[0]:
            slope = (z_com - before[1]) / (z - before[0])
        before = (z, z_com)
        p_ref[2] += slope * (height - z)
    raise RunError(f"--standing {height:g}: no stand found at this height")
