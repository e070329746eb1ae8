"""`xrl drive identify`: measure what the robot file assumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

from rich import box
from rich.live import Live
from rich.table import Table
from rich.text import Text

from shared import places
from shared.bus import topics
from shared.bus.credentials import require_operator
from shared.bus.messages import Pair, PlannerStatus
from shared.bus.session import open_session
from shared.config import files as config_file
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Lead, Scenario
from shared.exceptions import DECLINED_EXIT_CODE, DriveError, RunError
from shared.extras import require
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import module_motion
from tools.bringup.drive_access import confirm, drives_to_ourselves, robot_file
from tools.bringup.hanging_leg import hanging_joint
from tools.bringup.identify import report
from tools.bringup.identify.body_fit import Record, fit
from tools.bringup.identify.body_lead import BodyLead
from tools.bringup.identify.estimates import JointResult, of_body, of_joints, zero_corrections
from tools.bringup.identify.quasi_static import Moments, TimedRows, moments_of
from tools.bringup.identify.robot_file_edit import refuse_running
from tools.bringup.identify.sines import SinePlan, fit_sines, plan_for
from tools.bringup.module_motion import Stopped, exit_if_interrupted
from tools.bringup.motion_runner import Interrupts
from tools.flags import FINITE_MAX, Arg, Folder, MotionFlags, positional
from tools.fleet.supervise import SupervisedFleet
from tools.live import experiment
from tools.logs.run_log import RunLog, read_run, robot_of
from tools.output import make_folder
from tools.terminal import Console

LEVEL_SD: Final = 0.003
"""rad: a floor that a spirit level calls level."""
LEVEL_MAX: Final = 0.1
WEIGHED_SD: Final = 0.1
"""kg: a payload that was on a scale."""
MOTIONS: Final = "identify"
"""The scenario whose path is led."""


EXAMPLES: Final = """
xrl drive identify body --dry-run                      # shows the motions, moves nothing
xrl drive identify body                                # leads the running robot, then fits
xrl drive identify body out/a/run.mcap                 # from a record of slow motions
xrl drive identify body run.mcap loaded.mcap --added 0 --added 10   # 10 kg more on the torso
xrl drive identify body run.mcap --weighed --config lab.toml --apply
xrl drive identify joint ankle_left --dry-run          # hanging, the fleet down
xrl drive identify joint ankle_left ankle_right --apply
xrl drive identify joint --all --axis theta
"""


class BodyFlags(MotionFlags):
    """From which motions."""

    record: Annotated[tuple[Path, ...], positional("RUN")] = ()
    """records of this robot, standing and led slowly; without one the verb leads the running robot
    through deploy/scenarios/identify.toml"""
    added: tuple[Annotated[float, Range(0.0, 100.0, "kg")], ...] = ()
    """weighed mass on the torso beyond the robot file's; once for each record"""
    weighed: Annotated[
        bool, Arg(help=f"the robot file's payload has been weighed, within {WEIGHED_SD:g} kg")
    ] = False
    level: Annotated[float, Range(1e-6, LEVEL_MAX, "rad")] = LEVEL_SD
    """how level the floor is, as a standard deviation"""
    apply: bool = False
    """write the changes into the robot file, after a backup"""
    out: Folder | None = None
    """where the picture goes (out/identify-<time>)"""

    @property
    def masses(self) -> tuple[float, ...]:
        """The added mass of each record, kg."""
        return self.added or (0.0,) * max(1, len(self.record))

    def check(self) -> None:
        """Refuse another number of masses than of records."""
        super().check()
        if len(self.masses) != max(1, len(self.record)):
            raise RunError(
                f"--added: {len(self.added)} for {max(1, len(self.record))} records; give it once "
                "for each"
            )


class JointFlags(MotionFlags):
    """Which joints, and how hard they are moved."""

    module: Annotated[tuple[str, ...], positional("MODULE", one_of="which")] = ()
    """which; or --all"""
    all: Annotated[bool, Arg(one_of="which")] = False
    """all six, one joint after the other"""
    axis: Annotated[str | None, Arg(choices=AXES)] = None
    """only this one (default: both)"""
    torque: Annotated[float, Range(1e-3, FINITE_MAX, "N m")] = 15.0
    """amplitude of the sine motions; a bent leg's static load is added"""
    apply: bool = False
    """write what changes into the robot file, after a backup of it"""
    out: Folder | None = None
    """where the picture goes (out/identify-<time>)"""

    def check(self) -> None:
        """Refuse unknown modules."""
        super().check()
        unknown = [name for name in self.module if name not in MODULES]
        if unknown:
            raise DriveError(f"{unknown[0][:40]}: one of {', '.join(MODULES)} is right")

    @property
    def modules(self) -> tuple[str, ...]:
        """The selected modules."""
        return self.module or MODULES

    @property
    def axes(self) -> tuple[int, ...]:
        """The selected axes."""
        return (0, 1) if self.axis is None else (AXES.index(self.axis),)


def body(flags: BodyFlags) -> int:
    """Measure, fit, tell, and write if it is asked for."""
    console = Console()
    scenario = scenarios.load(experiment.scenario_file(MOTIONS))
    if flags.dry_run:
        _show_motions(
            scenario, config_file.load_without_schedule(places.robot_file(flags.config)), console
        )
        return 0
    require("plot")
    if flags.record:
        logs = [read_run(path) for path in flags.record]
        robot, path = _same_robot(logs), places.robot_file(flags.config)
        if flags.apply:
            refuse_running(path)
        moments = [_moments_in(log) for log in logs]
    else:
        fleet = SupervisedFleet.attach(flags.run_dir)
        path = Path(fleet.manifest.config)
        if flags.apply:
            refuse_running(path)
        robot = config_file.load(path)
        led = _led(robot, fleet, scenario, flags, console)
        if led is None:
            console.print("nothing was moved")
            return DECLINED_EXIT_CODE
        moments = [led]
    records = [Record(part, kg) for part, kg in zip(moments, flags.masses, strict=True)]
    payload_sd = WEIGHED_SD if flags.weighed else None
    result = fit(robot, records, level_sd=flags.level, payload_sd=payload_sd)
    estimates = of_body(result, robot)
    picture = make_folder(flags.out, "identify") / "identify.png"
    report.draw_body(estimates, result, picture)
    report.tell(estimates, robot, path if flags.apply else None, console)
    corrections = zero_corrections(estimates)
    if corrections:
        console.print("zeros, with the robot hung and its services DISARMED or down:")
    for module, (phi, theta) in corrections.items():
        console.print(f"  xrl drive zero {module} --by {phi:.4f},{theta:.4f}", highlight=False)
    console.print(f"{picture}", style="dim")
    return 0


def _same_robot(logs: Sequence[RunLog]) -> RobotConfig:
    """Return the robot of all records.

    Raises:
        RunError: they are of different ones.
    """
    robots = [robot_of(log) for log in logs]
    first = robots[0]
    for log, other in zip(logs, robots, strict=True):
        for part in ("name", "mass", "geometry", "joint", "drive"):
            if getattr(other, part) != getattr(first, part):
                raise RunError(
                    f"{log.path}: its robot differs in {part} from that of {logs[0].path}; give "
                    "records of one robot file"
                )
    return first


def _moments_in(log: RunLog) -> Moments:
    states = [
        TimedRows(log.received_ns(topics.JOINT_STATE, name), log.messages(topics.JOINT_STATE, name))
        for name in MODULES
    ]
    wrenches = TimedRows(log.received_ns(topics.WRENCH), log.messages(topics.WRENCH))
    return moments_of(states, wrenches)


def _led(
    robot: RobotConfig,
    fleet: SupervisedFleet,
    scenario: Scenario,
    flags: BodyFlags,
    console: Console,
) -> Moments | None:
    """Lead the robot that is up; return its moments, None if the person does not want it.

    Raises:
        FleetError: it is silent or does not lead.
        RunError: it ended before its time.
    """
    require_operator(robot, "identify")
    simulated = "simulator" in fleet.manifest.services
    if not simulated:
        console.print(
            "the robot leans and turns by itself. Lead the torso by hand to the height and pitch "
            "shown, and rest on the harness with the assist shown; nobody else may touch it"
        )
        if not confirm(
            "Does it stand with room around it, and is the stop at hand?", yes=flags.yes
        ):
            return None
    interrupts = Interrupts()
    with open_session(robot, "identify", fleet.run.path) as session:
        body = BodyLead(robot, session, simulated=simulated)
        with (
            interrupts.kept(),
            Live(console=console, refresh_per_second=4, transient=True) as shown,
        ):
            heard = body.go(
                scenario,
                lambda t_s, wanted, status: shown.update(_line(t_s, scenario, wanted, status)),
                lambda: bool(interrupts.number),
            )
    if interrupts.number:
        console.print("stopped: nothing was fitted; requests fade out by themselves")
    exit_if_interrupted(interrupts)
    if heard.ended:
        raise RunError(f"{heard.ended}: nothing was fitted; requests fade out by themselves")
    return moments_of(heard.states, heard.wrenches)


def _line(t_s: float, scenario: Scenario, wanted: Lead, status: PlannerStatus) -> Text:
    """Return where the robot is led, and where it is, as one line."""
    x, y, roll, yaw = wanted.shift
    return Text(
        f"{t_s:5.1f} of {scenario.duration:g} s  height {wanted.height:.2f} m, pitch "
        f"{wanted.pitch:+.2f} (is {status.p[4]:+.2f}) rad, assist {wanted.assist:.0f} (is "
        f"{status.assist_n:.0f}) N, shift {1e3 * x:+.0f} {1e3 * y:+.0f} mm {roll:+.2f} {yaw:+.2f}"
    )


def _show_motions(scenario: Scenario, robot: RobotConfig, console: Console) -> None:
    """Print where the robot would be led, and the limits that stay in force."""
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("s", "height, m", "pitch, rad", "assist, N", "x, y, mm", "roll, yaw, rad"):
        table.add_column(heading, justify="right")
    for row in scenario.keyframe:
        x, y, roll, yaw = row.shift
        table.add_row(
            f"{row.at:g}", f"{row.height:.3f}", f"{row.pitch:g}", f"{row.assist:g}",
            f"{1e3 * x:g}, {1e3 * y:g}", f"{roll:g}, {yaw:g}",
        )  # fmt: skip
    console.print(table)
    console.print(
        f"at most law.shift_max {list(robot.law.shift_max)} and {robot.assist.force_max:g} N; all "
        "limits and trips stay in force; it ends when the planner stops leading"
    )


def joint(flags: JointFlags) -> int:
    """Measure the joints that are asked for; 0 if no motion was stopped."""
    console = Console()
    if not flags.dry_run:
        require("plot")
    path = robot_file(flags)
    robot = config_file.load_without_schedule(path)
    if flags.apply:
        refuse_running(path)
    results: list[JointResult] = []
    stopped: Stopped | None = None
    interrupts = Interrupts()
    module_motion.refuse_services(robot, flags.modules, flags.run_dir)
    with drives_to_ourselves(
        robot, path, flags.run_dir, console.print, lifted=module_motion.LIFTED
    ):
        for joint in ((module, axis) for module in flags.modules for axis in flags.axes):
            try:
                found = _measure(flags, robot, joint, interrupts, console)
            except DriveError as error:
                if not results:
                    raise
                found = Stopped(str(error))  # what is measured by now is told
            if isinstance(found, Stopped):
                stopped = found
                break
            if found is not None:
                results.append(found)
    if results:
        estimates = of_joints(results, robot)
        picture = make_folder(flags.out, "identify") / "joints.png"
        report.draw_joints(estimates, results, picture)
        report.tell(estimates, robot, path if flags.apply else None, console)
        console.print(f"{picture}", style="dim")
    code = 0 if stopped is None else module_motion.tell_stopped(stopped, console)
    exit_if_interrupted(interrupts)
    return code


def _measure(
    flags: JointFlags,
    robot: RobotConfig,
    joint: tuple[str, int],
    interrupts: Interrupts,
    console: Console,
) -> JointResult | Stopped | None:
    """Measure one joint; return its result, how it was stopped, or None for a dry run."""
    name = f"{joint[0]}_{AXES[joint[1]]}"

    def plan_of(q: Mapping[str, Pair]) -> SinePlan:
        plan = plan_for(
            joint[1], flags.torque, robot.joint.armature, hanging_joint(robot, q, *joint)
        )
        console.print(_described(name, plan))
        return plan

    moved = module_motion.ask_and_move(flags, robot, joint, plan_of, interrupts, console)
    if not isinstance(moved, module_motion.Moved):
        return moved
    fit = fit_sines(moved.samples, moved.plan)
    if fit is None:
        return Stopped(f"{name}: too few samples for a fit; see its bus (`xrl drive can test`)")
    return JointResult(name, fit, hanging_joint(robot, moved.q, *joint).inertia)


def _described(joint: str, plan: SinePlan) -> str:
    tones = ", ".join(
        f"{1e3 * t.amplitude:.0f} mrad at {t.frequency_hz:g} Hz" for t in plan.course.tones
    )
    phi, theta = plan.bias
    led = f"; led by {phi:+.2f}, {theta:+.2f} rad first" if any(plan.bias) else ""
    return (
        f"{joint}: {tones}, {plan.duration_s:.0f} s, at most {plan.torque_limit:.0f} N m{led}; the "
        "leg's other modules hold"
    )
