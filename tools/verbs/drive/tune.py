"""`xrl drive tune`: how a direction of the body, or a module, answers; gains for it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np

from services.simulator.physics.plant import IDEAL, PlantConfig, plant_from
from shared import places
from shared.bus.credentials import require_operator
from shared.bus.messages import Pair
from shared.bus.session import open_session
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, RunError
from shared.extras import require
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import drive_access, module_motion
from tools.bringup.hanging_leg import hanging_joint
from tools.bringup.motion_runner import Interrupts
from tools.bringup.tune import module_probe
from tools.bringup.tune.excitation import Excitation, excitation
from tools.bringup.tune.pose_probe import (
    DIRECTIONS,
    LiveProbe,
    ProbeCourse,
    in_lockstep,
    inertia_along,
)
from tools.bringup.tune.report import Probed, answer_table, draw
from tools.bringup.tune.response import ResponseFit, answer_of, propose
from tools.flags import FINITE_MAX, Arg, Folder, MotionFlags, Number, positional
from tools.fleet.supervise import SupervisedFleet
from tools.live import experiment
from tools.output import make_folder, progress_along
from tools.terminal import Console, marked

SIZE_SHARE: Final = 0.8
"""Default size of a probe, as a fraction of `law.probe_max`."""
STATUSES_MIN: Final = 1000
"""Fewer are no course: four seconds of the planner's."""
UNITS: Final = ("N/m", "N/m", "N/m", "N m/rad", "N m/rad", "N m/rad")

PLANNER_DID_NOT: Final = (
    "the planner did not offset its reference as requested: the robot moved too much for a led "
    "direction to be held, or the planner was started before law.probe_max was set"
)
JOINT_DID_NOT: Final = (
    "the joint's reference was not offset as planned, or too few of its samples came: is its bus "
    "sound? `xrl drive can test`"
)

EXAMPLES: Final = """
xrl drive tune x                                    # the running robot: step and sines
xrl drive tune y --sim                              # in virtual time, on the realistic plant
xrl drive tune y --sim --plant drivetrain.stiffness=3000
xrl drive tune x --bandwidth 7 --damping 0.6        # proposes K_p and B_p
xrl drive tune ankle_left --axis theta              # hanging, the fleet down
xrl drive tune x --dry-run
"""


class TuneFlags(MotionFlags, experiment.PlantFlags):
    """What is probed, how strongly, and which answer is wanted."""

    what: Annotated[
        str,
        positional(
            "WHAT",
            choices=(*DIRECTIONS, *MODULES),
            help=f"one of {', '.join(DIRECTIONS)}; or a module, hanging",
        ),
    ]
    size: Annotated[Number | None, Arg(metavar="S")] = None
    """size of a direction's step and sines, m or rad"""
    axis: Annotated[str | None, Arg(choices=AXES)] = None
    """of a module (theta)"""
    torque: Annotated[float | None, Range(1e-3, FINITE_MAX, "N m")] = None
    """torque of a module's step and sines (15; 60 for legs)"""
    bandwidth: Annotated[float | None, Range(0.1, 500.0, "rad/s")] = None
    """wanted natural frequency"""
    damping: Annotated[float | None, Range(0.05, 3.0, ""), Arg(metavar="RATIO")] = None
    """wanted damping ratio"""
    sim: bool = False
    """use a robot in virtual time, not the fleet"""
    out: Folder | None = None
    """for the picture (out/tune-<time>)"""

    @property
    def wanted(self) -> tuple[float, float] | None:
        """Natural frequency, rad/s, and damping ratio of the wanted answer."""
        if self.bandwidth is None or self.damping is None:
            return None
        return self.bandwidth, self.damping

    def check(self) -> None:
        """Refuse half a wish, and flags of the other kind.

        Who asks for virtual time must not move a real module.
        """
        super().check()
        if (self.bandwidth is None) != (self.damping is None):
            raise RunError("--bandwidth and --damping: both, or none")
        of_directions = {"--sim": self.sim, "--plant": self.plant, "--size": self.size is not None}
        of_modules = {"--axis": self.axis is not None, "--torque": self.torque is not None}
        is_module = self.what in MODULES
        others = of_directions if is_module else of_modules
        wrong = [name for name, given in others.items() if given]
        if wrong:
            kind = "a direction" if is_module else "a module"
            raise RunError(f"{', '.join(wrong)}: for {kind}, and {self.what} is none")
        if self.plant and not self.sim:
            raise RunError("--plant: for a robot in virtual time (--sim)")


def run(flags: TuneFlags) -> int:
    """Measure, compare with what the model predicts, and propose; 0 if it was not stopped."""
    console = Console()
    if not flags.dry_run:
        require("sim" if flags.sim else "plot")
    if flags.what in MODULES:
        return _tune_module(flags, console)
    return _tune_direction(flags, console)


def _tune_direction(flags: TuneFlags, console: Console) -> int:
    row = DIRECTIONS.index(flags.what)
    fleet = None if flags.sim or flags.dry_run else SupervisedFleet.attach(flags.run_dir)
    path = places.robot_file(flags.config) if fleet is None else Path(fleet.manifest.config)
    robot = experiment.load_robot(path)
    plan = excitation(_size(flags, robot, row))
    sines = ", ".join(f"{sine.frequency_hz:g}" for sine in plan.sines)
    unit = "m" if row < 3 else "rad"
    console.print(
        f"{flags.what}: a step of {plan.size:g} {unit} there and back, then sines of it at {sines} "
        f"Hz: {plan.duration_s:.0f} s. The planner limits it (law.probe_max), and all trips stay "
        "active"
    )
    if flags.dry_run:
        return 0
    if fleet is None:
        with progress_along("simulated", plan.duration_s) as progress:
            course = in_lockstep(robot, row, plan, plant_from(flags.plant), progress)
    else:
        live = _live(flags, robot, fleet, row, plan, console)
        if live is None:
            console.print("nothing was moved")
            return DECLINED_EXIT_CODE
        course = live
    if course.ended:
        console.print(marked("[bold red]STOPPED[/]: {}", course.ended))
        return FAULT_EXIT_CODE
    probed = {"measured": _answer(course, plan)}
    _simulate("predicted", robot, row, plan, IDEAL, probed, console)
    closed = not robot.law.S[row]
    if flags.wanted is not None and closed:
        proposed = _proposed(flags.wanted, robot, row, probed["measured"].fit, console)
        if proposed is not None:
            # on the plant that was measured, where it is known
            plant = plant_from(flags.plant) if flags.sim else IDEAL
            _simulate("proposed", proposed, row, plan, plant, probed, console)
    _tell(flags, probed, console, closed=closed)
    if not closed:
        console.print(
            "the person leads this direction: it was held on local gains while it was probed, with "
            "the hand as it is; `xrl gains` chooses them (certificate.K_required)"
        )
    return 0


def _simulate(
    name: str,
    robot: RobotConfig,
    row: int,
    plan: Excitation,
    plant: PlantConfig,
    probed: dict[str, Probed],
    console: Console,
) -> None:
    """Add a simulation; if it fails say so, the measured one stays."""
    try:
        with progress_along(f"simulated: {name}", plan.duration_s) as progress:
            course = in_lockstep(robot, row, plan, plant, progress)
        probed[name] = _answer(course, plan)
    except RunError as error:
        console.print(marked("[yellow]{}: {}[/]", name, error))


def _live(
    flags: TuneFlags,
    robot: RobotConfig,
    fleet: SupervisedFleet,
    row: int,
    plan: Excitation,
    console: Console,
) -> ProbeCourse | None:
    """Return what the robot that is up does; None if the person does not want it."""
    require_operator(robot, "tune")
    console.print("touch the robot only with the hand that holds its height")
    question = "Does it stand with room around it, and is the stop at hand?"
    simulated = "simulator" in fleet.manifest.services
    if not simulated and not drive_access.confirm(question, yes=flags.yes):
        return None
    interrupts = Interrupts()
    with open_session(robot, "tune", fleet.run.path) as session:
        probe = LiveProbe(session)
        with interrupts.kept(), progress_along("probing", plan.duration_s) as progress:
            course = probe.go(row, plan, progress, lambda: bool(interrupts.number))
    if interrupts.number:
        console.print("stopped: the probe ends by itself")
    module_motion.exit_if_interrupted(interrupts)
    return course


def _size(flags: TuneFlags, robot: RobotConfig, row: int) -> float:
    """Return the size of step and sines, m or rad.

    Raises:
        RunError: it is none, or beyond what the robot file accepts.
    """
    most = robot.law.probe_max[row]
    if most == 0.0:
        raise RunError(
            f"{flags.what}: law.probe_max of the robot file forbids it; set it there, and start "
            "the planner again"
        )
    size: float = SIZE_SHARE * most if flags.size is None else flags.size
    if not 0.0 < size <= most:
        raise RunError(f"--size {size:g}: more than 0 and at most {most:g} (law.probe_max)")
    return size


def _answer(course: ProbeCourse, plan: Excitation, why_not: str = PLANNER_DID_NOT) -> Probed:
    """Return a course with how its reference was answered.

    Raises:
        RunError: it was not offset (`why_not`), or hardly answered.
    """
    if len(course.t_s) < STATUSES_MIN or float(np.ptp(course.r)) < plan.size:
        raise RunError(why_not)
    answer = answer_of(course.t_s, course.r, course.y, plan)
    if answer is None:
        raise RunError("the response to the offset is hardly measurable; try a larger one (--size)")
    return Probed(course, answer)


def _proposed(
    wanted: tuple[float, float],
    robot: RobotConfig,
    row: int,
    answer: ResponseFit,
    console: Console,
) -> RobotConfig | None:
    """Tell gains for the wanted answer; return the robot with them, None if there are none."""
    if not answer.is_second_order:
        console.print("no second-order response was measured, so no gains follow from it")
        return None
    law = robot.law
    k, b = propose(
        answer.model, (law.K_p[row], law.B_p[row]), inertia_along(robot, row),
        bandwidth=wanted[0], damping_ratio=wanted[1],
    )  # fmt: skip
    if k <= 0.0 or b <= 0.0:
        console.print(
            marked(
                "[yellow]no gains: they would be K_p = {:.3g} and B_p = {:.3g}; "
                "local gains and joints give more stiffness or damping than was wanted[/]",
                k,
                b,
            )
        )
        return None
    K_p, B_p = list(law.K_p), list(law.B_p)
    K_p[row], B_p[row] = float(f"{k:.3g}"), float(f"{b:.3g}")
    console.print(f"for {wanted[0]:g} rad/s and a damping ratio of {wanted[1]:g}, in {UNITS[row]}:")
    console.print(f"K_p = {K_p}\nB_p = {B_p}", highlight=False)
    console.print(
        "to try them: set the law's rows in a copy of the robot file, then `xrl gains`, which says "
        "if a loop with them is stable, then `xrl drive tune` again"
    )
    changed = msgspec.structs.replace(law, K_p=tuple(K_p), B_p=tuple(B_p))
    return with_local_gains_kept(msgspec.structs.replace(robot, law=changed))


def with_local_gains_kept(robot: RobotConfig) -> RobotConfig:
    """Return a changed robot on the local gains of before: for a look in lockstep, nowhere else."""
    schedule = robot.gain_schedule
    if schedule is None:
        return robot
    inputs = gain_schedule.inputs_of(robot)
    kept = msgspec.structs.replace(schedule, inputs=inputs, digest=gain_schedule.digest_of(inputs))
    return msgspec.structs.replace(robot, gain_schedule=kept)


def _tune_module(flags: TuneFlags, console: Console) -> int:
    module, axis = joint = flags.what, AXES.index(flags.axis or "theta")
    path = drive_access.robot_file(flags)
    robot = config_file.load_without_schedule(path)
    module_motion.refuse_services(robot, [module], flags.run_dir)
    interrupts = Interrupts()
    k_p, k_d = module_probe.axis_gains(robot, module, axis)

    def plan_of(q: Mapping[str, Pair]) -> module_probe.ProbePlan:
        hung = hanging_joint(robot, q, module, axis)
        plan = module_probe.probe_plan(robot, module, axis, flags.torque, hung)
        console.print(
            f"{module} {AXES[axis]}: a step of {1e3 * plan.course.size:.1f} mrad there and "
            f"back, then sines of it, {plan.duration_s:.0f} s, at most {plan.torque_limit:.0f} N "
            f"m, on the stand gains ({k_p:g} N m/rad, {k_d:g} N m s/rad)"
        )
        return plan

    with drive_access.drives_to_ourselves(
        robot, path, flags.run_dir, console.print, lifted=module_motion.LIFTED
    ):
        moved = module_motion.ask_and_move(flags, robot, joint, plan_of, interrupts, console)
    if moved is None:
        return 0
    if isinstance(moved, module_motion.Stopped):
        code = module_motion.tell_stopped(moved, console)
        module_motion.exit_if_interrupted(interrupts)
        return code
    plan, hung = moved.plan, hanging_joint(robot, moved.q, module, axis)
    course = module_probe.course_of_samples(moved.samples, plan)
    measured = _answer(course, plan.course, JOINT_DID_NOT)
    model = module_probe.predicted(robot, module, axis, hung)
    _tell(flags, {"measured": measured}, console, closed=False)
    console.print(
        f"predicted, rotor and leg rigid: natural frequency {model.natural_frequency:.1f} rad/s, "
        f"damping ratio {model.damping_ratio:.2f}"
    )
    if not measured.fit.is_second_order:
        console.print(
            "the encoder is at the motor: behind play and a soft drivetrain this leg is no "
            "second-order system; compare step and picture with another leg's"
        )
    elif flags.wanted is not None:
        bandwidth, damping = flags.wanted
        # k_p below 0: gravity alone is stiffer than what is wanted
        inertia = k_p / measured.fit.model.b_0
        k_p = inertia * bandwidth**2 - hung.gravity
        k_d = 2.0 * damping * bandwidth * inertia
        console.print(
            f"for {bandwidth:g} rad/s and a damping ratio of {damping:g}: k_p = "
            f"{k_p:.0f} N m/rad, k_d = {k_d:.1f} N m s/rad (stand.*, then `xrl gains`)"
        )
    return 0


def _tell(flags: TuneFlags, probed: dict[str, Probed], console: Console, *, closed: bool) -> None:
    out = make_folder(flags.out, "tune")
    console.print(answer_table(probed, closed=closed))
    title = flags.what if flags.what in DIRECTIONS else f"{flags.what} {flags.axis or 'theta'}"
    draw(title, probed, out / "tune.png")
    console.print(f"{out}/tune.png", style="dim")
