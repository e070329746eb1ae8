"""`xrl drive zero`: writes the joints' positions to their drives."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
import numpy as np
from rich import box
from rich.table import Column, Table
from rich.text import Text

from services.joint.differential import motor_from_joint
from services.joint.drivers.base import Drive
from shared.bus import topics
from shared.bus.messages import DriveStatus, JointState, Mode, Pair
from shared.bus.session import open_session
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError, FleetError, RunError
from shared.joints import MODULE_INDEX, MODULES, kind_of
from shared.robot.robot_model import stand_pose
from tools.bringup import drive_access, zero_record
from tools.bringup.hanging_leg import leg_of
from tools.bringup.whole_turns import UNMOVED, decide
from tools.bringup.zero_record import Identity, ModuleZero, ZeroRecord
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
"""Tolerance of the torso's height, m."""
ROUNDS: Final = 20
"""Maximum rounds of the search for the COM height at a torso height; three are usual."""
DEGREES_FROM: Final = 7.0
"""Angles above this, rad, are more than a turn and are assumed to be in degrees."""

HEARD_S: Final = 2.0
"""Timeout for the states of joint services that are up, s."""

EXAMPLES: Final = """
xrl drive zero knee_left --at 0,-0.5          # phi and theta by protractor, rad
xrl drive zero --all --standing 1.188         # in the jig
xrl drive zero --all --resume                 # joints that have not moved
xrl drive zero --all --resume --untouched --swing --level     # knees and hips that have moved
xrl drive zero ankle_left --resume --untouched --at 0.1,0.3   # rough angles
"""

_PAIR: Final = numbers(2, "phi and theta in rad, such as 0,-0.5")


class ZeroFlags(FleetRobotFlags):
    """Modules to zero, and the angles of their joints."""

    module: Annotated[str | None, positional("MODULE", choices=MODULES, one_of="which")] = None
    """module, such as knee_left"""
    all: Annotated[bool, Arg(one_of="which")] = False
    """all six modules"""
    at: Annotated[Pair | None, parsed(_PAIR, "PHI,THETA", exclusive="where")] = None
    """present angles of the joint, rad, such as 0,-0.5"""
    standing: Annotated[Number | None, Arg(metavar="HEIGHT", exclusive="where")] = None
    """the robot stands, or hangs in the same pose: soles flat, level and geometry.w_base apart,
    torso upright, COM over the ankles, the hip axis HEIGHT m above the ankle axis; the robot file's
    lengths give the angles"""
    resume: bool = False
    """after a loss of power, while the robot hangs: find the whole turns from the stored zero; --at
    and --standing then need only be within 0.08 rad; unclear results are refused"""
    untouched: bool = False
    """with --resume, for joints that have moved: you confirm that no encoder, magnet, motor or
    encoder cable has been touched since the last zeroing"""
    swing: bool = False
    """with --resume, for knees and hips that have moved: check by the legs' swing that they hang
    free"""
    level: bool = False
    """with --resume, without an IMU: you confirm by spirit level that the torso is level to 2
    degrees"""
    rest: bool = False
    """only store where the joints rest now, for --resume (`xrl down` also does this)"""
    yes: bool = False
    """do not ask for confirmation"""

    @property
    def modules(self) -> tuple[str, ...]:
        """The selected modules."""
        return MODULES if self.module is None else (self.module,)

    def check(self) -> None:
        """Refuse --at with --all, missing angles, and flags that contradict each other."""
        super().check()
        where = [self.at, self.standing]
        if self.rest and (self.resume or any(one is not None for one in where)):
            raise DriveError("--rest changes no zero; remove --resume, --at and --standing")
        if not self.resume and (self.untouched or self.swing or self.level):
            raise DriveError("--untouched, --swing and --level need --resume")
        if not (self.resume or self.rest or any(one is not None for one in where)):
            raise DriveError("give --at or --standing; after a loss of power, --resume")
        if self.all and self.at is not None:
            raise DriveError("--at is for one module; with --all, give --standing HEIGHT")


def run(flags: ZeroFlags) -> int:
    """Check the drives, ask, write and read back; store the zero for use after a loss of power."""
    console = Console()
    path = drive_access.robot_file(flags)
    robot = config_file.load_without_schedule(path)
    wanted = _angles_of(flags, robot, console)
    modules = flags.modules
    holders = {module: drive_access.service_on(robot, module, flags.run_dir) for module in modules}
    with drive_access.drives_to_ourselves(robot, path, flags.run_dir, console.print) as started:
        if flags.rest:
            kept = zero_record.store_rests(robot, path, flags.run_dir, modules, console.print)
            console.print(
                f"{kept} of {len(modules)} modules are at rest; their positions are stored"
            )
            return 0 if kept == len(modules) else FAULT_EXIT_CODE
        refuse_services(robot, holders)
        known = zero_record.identities(robot, flags.run_dir, modules, console.print)
        file = zero_record.path_of(robot, path, flags.run_dir)
        record = zero_record.read_zeros(file, robot)
        looked_at = leg_of(*modules) if flags.resume else modules
        with zero_record.drives_of(robot, looked_at, flags.run_dir) as drives:
            work = _Zeroing(robot, flags, holders, known, file, record, drives, console)
            code = work.run(work.resumed(wanted) if flags.resume else work.measured(wanted))
    if started:
        console.print(drive_access.GONE)
    return code


class _Plan(NamedTuple):
    """Angles to write, and the question to ask first."""

    wanted: Mapping[str, Pair]
    """(phi, theta) by module, rad."""
    seen: Mapping[str, DriveLook]
    """State of the drives when the angles were determined."""
    table: Table
    question: str
    right: int = 0
    """Number of modules that are already zeroed."""


class _Zeroing(NamedTuple):
    """Zeroing from measured angles, or from the stored zero."""

    robot: RobotConfig
    flags: ZeroFlags
    holders: Mapping[str, SupervisedFleet | None]
    known: Mapping[str, Identity]
    file: Path
    record: ZeroRecord
    drives: Mapping[str, Drive]
    console: Console

    def measured(self, wanted: Mapping[str, Pair]) -> _Plan:
        """Plan from the angles that a person has measured."""
        table, seen = _table("before, rad", "after, rad", "change, rad"), self._look(wanted)
        for module, q in wanted.items():
            before = seen[module].q
            cells = ("unzeroed", _angles(q), "-")
            if seen[module].zeroed:
                cells = (_angles(before), _angles(q), _angles((q[0] - before[0], q[1] - before[1])))
            table.add_row(module, *cells)
        return _Plan(wanted, seen, table, "Are the joints at these angles now?")

    def resumed(self, about: Mapping[str, Pair]) -> _Plan:
        """Plan from the stored zeros; print which modules are refused, and why."""
        robot, flags, console = self.robot, self.flags, self.console
        if not any(module in self.record.modules for module in flags.modules):
            raise DriveError(
                f"{', '.join(flags.modules)}: no zero is stored for --resume; without it, zero "
                "with --at (angles by protractor) or --standing"
            )
        up = zero_record.upright(robot, flags.run_dir, level=flags.level)
        swings: dict[str, Swing] = {}
        if flags.swing:
            console.print(HOW)
            legs = {name: one for name, one in self.drives.items() if kind_of(name) != "ankle"}
            swings = watch(legs, robot.joint.gear_ratio, console.print)
        looks, _ = zero_record.looks_at_rest(self.drives, robot)
        faults = {module: refusal(seen) for module, seen in looks.items()}
        fit = {module: seen for module, seen in looks.items() if not faults[module]}
        evidence = zero_record.evidence_of(
            robot, self.record, fit, self.known,
            untouched=flags.untouched, about=about, swings=swings,
        )  # fmt: skip
        found = decide(robot, evidence, up)
        table = _table("found, rad", "by", "second best, rad away", "its error / allowed")
        taken, zeroed = {}, []
        for module in flags.modules:
            decision = found.get(module)
            if looks[module].zeroed and not faults[module]:
                zeroed.append(module)
            elif decision is not None and decision.q is not None:
                q = taken[module] = decision.q
                times = f"{decision.times:.1f}" if decision.by != "unmoved" else "-"
                table.add_row(module, _angles(q), decision.by, f"{decision.second:.2f}", times)
            else:
                why = decision.why if decision is not None else faults[module]
                why = why or "no zero is stored for it; zero it with --at"
                console.print(marked("[yellow]{}: refused:[/] {}", module, why))
        if zeroed:
            console.print(f"{', '.join(zeroed)}: already zeroed; left unchanged")
        return _Plan(taken, looks, table, "Does the robot hang like this?", len(zeroed))

    def run(self, plan: _Plan) -> int:
        """Ask, write, read back and store the zeros; return the exit code."""
        modules, console = self.flags.modules, self.console
        if not plan.wanted:
            console.print("nothing was changed")
            return 0 if plan.right == len(modules) else FAULT_EXIT_CODE
        console.print(plan.table)
        served = [module for module in plan.wanted if self.holders[module] is not None]
        if served:
            console.print(
                marked(
                    "[yellow]{}: the joint service is up and, unless it is read-only, "
                    "arms the drive as soon as it is zeroed[/]",
                    ", ".join(served),
                )
            )
        if not drive_access.confirm(plan.question, yes=self.flags.yes):
            console.print("nothing was changed")
            return DECLINED_EXIT_CODE
        refuse_services(self.robot, self.holders)  # a person may take minutes to answer
        for module, seen in self._look(plan.wanted).items():
            if self.flags.resume and not zero_record.same_angles(seen, plan.seen[module], UNMOVED):
                raise DriveError(f"{module}: the joint has moved; nothing was changed; try again")
        done = self._set(plan.wanted)
        if self.flags.resume:
            done = [module for module in done if self._is_its_zero(module)]
            ratio = self.robot.joint.gear_ratio
            rests = {module: motor_from_joint(plan.wanted[module], ratio) for module in done}
            self._keep(zero_record.with_rests(self.record, rests))
        elif done:
            self._keep(msgspec.structs.replace(self.record, modules=self._zeros(done)))
        return 0 if len(done) + plan.right == len(modules) else FAULT_EXIT_CODE

    def _look(self, modules: Iterable[str]) -> dict[str, DriveLook]:
        """Check drives; raise an error that names all drives that cannot be zeroed now."""
        seen = {module: look(self.drives[module], self.robot) for module in modules}
        faults = [f"{module}: {why}" for module, one in seen.items() if (why := refusal(one))]
        if faults:
            raise DriveError("; ".join(faults) + "; nothing was changed")
        return seen

    def _set(self, wanted: Mapping[str, Pair]) -> list[str]:
        """Write all positions, read them back and print both; return the modules that have them."""
        table, done = _table("written, rad", "read back, rad", ""), []
        for module, q in wanted.items():
            try:
                back = zero(self.drives[module], q, self.robot)
            except DriveError as error:  # a failed module does not stop the others
                self.console.print(marked("[bold red]{}[/]: {}", module, error))
                back = None
            good = is_right(back, q)
            done += [module] * good
            read = "nothing" if back is None else _angles(back.q)
            outcome = Text("zeroed") if good else Text("NOT zeroed", "bold red")
            table.add_row(module, _angles(q), read, outcome)
        self.console.print(table)
        if len(done) < len(wanted):
            self.console.print(
                marked("[bold red]do not arm an unzeroed drive[/]: check it, and zero it again")
            )
        return done

    def _zeros(self, done: Iterable[str]) -> dict[str, ModuleZero]:
        """Return the stored zeros, updated with the modules that were just zeroed."""
        modules = dict(self.record.modules)
        for module in done:
            seen = look(self.drives[module], self.robot)
            identity, angles = self.known.get(module), seen.angles
            modules.pop(module, None)
            why = zero_record.why_not_kept(self.robot, seen, identity)
            if why or angles is None:
                words = "[yellow]{}: zero not stored for a loss of power: {}[/]"
                self.console.print(marked(words, module, why))
                continue
            zeroed = zero_record.zeroed(self.robot, module, seen.q_there, angles, identity)
            modules[module] = zeroed
        return modules

    def _is_its_zero(self, module: str) -> bool:
        """Return True if a drive has its stored zero again; otherwise erase the zero just written.

        A joint that creeps during the write gets a different zero.
        """
        drive, offsets = self.drives[module], self.record.modules[module].offsets
        seen = look(drive, self.robot)
        why = zero_record.not_its_zero(seen, offsets, self.robot.joint.gear_ratio)
        if why:
            self.console.print(
                marked("[bold red]{}: it moved during the write; try again[/]", module)
            )
            if seen.status is not DriveStatus.ARMED:
                drive.set_position((0.0, 0.0))
        return not why

    def _keep(self, record: ZeroRecord) -> None:
        """Store the zeros; a failure is only a warning, because the drives have them."""
        try:
            zero_record.write_zeros(self.file, record)
        except DriveError as error:
            self.console.print(marked("[yellow]{}[/]", error))


def _angles_of(flags: ZeroFlags, robot: RobotConfig, console: Console) -> dict[str, Pair]:
    """Return the given (phi, theta), rad, of each selected module; raise if outside its limits."""
    wanted: dict[str, Pair] = {}
    if flags.at is not None:
        wanted = dict.fromkeys(flags.modules, flags.at)
    elif flags.standing is not None:
        stand = stand_angles(robot, flags.standing)
        console.print(
            f"a stand with the hips {flags.standing:g} m above the ankles and "
            f"{abs(stand.hips_forward):.3f} m {'ahead of' if stand.hips_forward > 0 else 'behind'} "
            "them, torso upright, soles flat"
        )
        wanted = {module: stand.q[module] for module in flags.modules}
    for module, q in wanted.items():
        if fault := why_outside(robot, module, q):
            degrees = ""
            if max(map(abs, q)) > DEGREES_FROM:
                phi, theta = map(math.radians, q)
                degrees = f"; if these are degrees: --at {phi:.4g},{theta:.4g}"
            raise DriveError(f"{module}: {fault}{degrees}")
    return wanted


def refuse_services(robot: RobotConfig, holders: Mapping[str, SupervisedFleet | None]) -> None:
    """Raise FleetError if a joint service uses a drive's USB, is silent, or is not DISARMED."""
    up = {module: fleet for module, fleet in holders.items() if fleet is not None}
    for module, fleet in up.items():
        if robot.joint_service.driver == "odrive_usb":
            raise FleetError(
                f"{module}: its joint service in {fleet.run.path} holds the drive's USB; run "
                "`xrl down` first"
            )
    for fleet in {fleet.run.path: fleet for fleet in up.values()}.values():
        served = [module for module, other in up.items() if other.run.path == fleet.run.path]
        states = _states(robot, fleet, served)
        for module in served:
            state = states.get(module)
            if state is None:
                raise FleetError(
                    f"{module}: its joint service in {fleet.run.path} is up but sends no state; "
                    "see `xrl status`, or run `xrl down` first"
                )
            if state.mode in (Mode.HOLD, Mode.TRACK):
                raise FleetError(
                    f"{module}: its joint service holds it ({Mode(state.mode).name}); hang the "
                    "robot and run `xrl down` first"
                )
            if state.mode != Mode.DISARMED:
                raise FleetError(
                    f"{module}: its joint service is in {Mode(state.mode).name}; hang the robot "
                    f"and run `xrl kill {module}` (a restart ends this mode) or `xrl down` first"
                )


def _states(
    robot: RobotConfig, fleet: SupervisedFleet, modules: list[str]
) -> dict[str, JointState]:
    """Return a state of each of these modules that sends one within `HEARD_S`."""
    states: dict[str, JointState] = {}
    with open_session(robot, "zero", fleet.run.path) as session:
        ends = {m: session.latest(topics.JOINT_STATE, JointState, m) for m in modules}
        deadline = time.monotonic() + HEARD_S
        while time.monotonic() < deadline and len(states) < len(modules):
            for module, latest in ends.items():
                state = latest.take()
                if state is not None:  # whatever its stamp: the drive may be silent
                    states[module] = state
            time.sleep(0.01)
    return states


def _angles(q: Pair) -> str:
    return f"{q[0]:+.4f} {q[1]:+.4f}"


def _table(*columns: str) -> Table:
    headings = [Column(heading, no_wrap=True) for heading in ("module", *columns)]
    return Table(*headings, box=box.SIMPLE_HEAD, caption="phi, theta", caption_justify="left")


class _StandAngles(NamedTuple):
    """An upright stand, soles flat, COM over the ankles."""

    q: dict[str, Pair]
    """(phi, theta) of each module, rad."""
    hips_forward: float
    """Distance of the hips ahead of the ankles, m; negative if behind."""


def stand_angles(robot: RobotConfig, height: float) -> _StandAngles:
    """Return the level stand whose torso origin (between the hips) is at a height, m."""
    from services.planner.law.kinematics import Kinematics  # noqa: PLC0415 - takes a second
    from tools.reach import ReachSolver, describe  # noqa: PLC0415

    longest = robot.geometry.l1 + robot.geometry.l2
    if not 0.0 < height < longest:
        text = f"--standing {height:g}: must be between 0 and {longest:g} m (a straight leg)"
        in_mm = f"; if this is in mm: --standing {height / 1e3:g}" if height > 100.0 else ""
        raise RunError(text + in_mm)
    limits = np.array(robot.joint_limits())
    kinematics = Kinematics(robot)
    ik = ReachSolver(kinematics, limits)
    ik.q[:] = stand_pose(robot, height)
    kinematics.update(ik.q)
    p_ref = np.array([0.0, 0.0, kinematics.p[2], 0.0, 0.0, 0.0])
    slope, before = 1.0, None  # d COM height / d torso height, from the last two rounds
    for _ in range(ROUNDS):
        reach = ik.solve_from_anywhere(p_ref)
        if not reach.converged:
            raise RunError(f"--standing {height:g}: {describe(reach, p_ref, limits)}")
        z, z_com = float(kinematics.r_torso[2]), float(p_ref[2])
        if abs(height - z) <= HEIGHT_TOLERANCE:
            angles = ik.q.reshape(len(MODULES), 2).tolist()
            q = {module: (angles[i][0], angles[i][1]) for module, i in MODULE_INDEX.items()}
            return _StandAngles(q, float(kinematics.r_torso[0]))
        if before is not None and z != before[0]:
            slope = (z_com - before[1]) / (z - before[0])
        before = (z, z_com)
        p_ref[2] += slope * (height - z)
    raise RunError(f"--standing {height:g}: no pose stands with its hips there; measure it again")
