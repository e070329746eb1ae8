"""Calibrates the boards of a robot that hangs: refuse, ask, lead through, say what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from shared.bus.messages import Pair
from shared.can.cansimple import AxisState
from shared.can.drive_settings import AXES
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError
from shared.joints import MODULES
from tools.bringup import calibration, can_monitor, drive_access
from tools.bringup.boards import Board, FoundBoards
from tools.bringup.calibration import BoardResult, Procedure
from tools.bringup.check_board import direction_rows
from tools.bringup.findings import FindingKind
from tools.bringup.hanging_leg import leg_of, why_resting
from tools.bringup.motion_runner import NOT_IDLE, Interrupts
from tools.terminal import Console, marked


def to_calibrate(boards: Mapping[str, Board], *, again: bool) -> dict[str, tuple[str, ...]]:
    """Return the axes to calibrate, by module: those that are not, or all."""
    axes = {m: AXES if again else calibration.uncalibrated(board) for m, board in boards.items()}
    return {module: those for module, those in axes.items() if those}


def refuse_standing(
    robot: RobotConfig, run_dir: Path, found: FoundBoards, axes: Mapping[str, Sequence[str]]
) -> None:
    """Refuse a robot that may bear weight: a drive is armed, or a limp leg rests on something.

    Drives that are not on USB are listened to on CAN. A leg is judged where it has its zeros.

    Raises:
        DriveError: naming the first.
    """
    q: dict[str, Pair] = {}
    for module in MODULES:
        board = found.boards.get(robot.module_named(module).serial_number.upper())
        if board is not None:
            states: tuple[int, ...] = board.states()
            angles = calibration.zeroed_angles(robot, module, board)
            q |= {} if angles is None else {module: angles}
        else:
            states = can_states(robot, module, run_dir)
        if AxisState.CLOSED_LOOP_CONTROL in states:
            raise DriveError(
                f"the drive of {module} is armed: the robot may stand on it. Hang the robot; "
                "`xrl down`, or switch its supply off"
            )
    for module in axes:
        leg = leg_of(module)
        if all(each in q for each in leg) and (
            why := why_resting(robot, {each: q[each] for each in leg})
        ):
            raise DriveError(f"{why}. Hang the robot with its feet clear of the floor")


def can_states(robot: RobotConfig, module: str, run_dir: Path) -> tuple[int, ...]:
    """Return the states of a module's axes by their heartbeats on CAN; none if nobody speaks."""
    wiring = robot.module_named(module)
    seconds = can_monitor.long_enough(robot.drive.heartbeat_period_ms)
    bus = can_monitor.bus_config(robot, wiring.bus, run_dir)
    nodes = can_monitor.listen(bus, wiring.node_ids, poll_nodes=False, seconds=seconds).nodes
    beats = (nodes[node].heartbeat for node in wiring.node_ids)
    return tuple(beat.axis_state for beat in beats if beat is not None)


def calibrate(
    console: Console,
    robot: RobotConfig,
    boards: Mapping[str, tuple[Board, Sequence[str]]],
    interrupts: Interrupts,
    *,
    yes: bool,
    check: Callable[[], None],
) -> int:
    """Ask and calibrate, one module after the other; return the exit code.

    One that fails does not stop the others, unless it does not become idle.

    Args:
        console: to speak on.
        robot: its file.
        boards: by module, with the axes to calibrate.
        interrupts: kept while an axis calibrates.
        yes: do not ask.
        check: raises where somebody else has the drives by now.
    """
    code, done = 0, list[str]()
    for module, (board, those) in boards.items():
        try:
            calibration.refuse_unfit(module, board, those)
            seconds = sum(p.seconds for axis in those for p in calibration.procedures(board, axis))
            console.print(
                f"\n{module}: {' and '.join(those)}, {seconds:.0f} s; each turns its motor by "
                "about a turn and back, which moves phi and theta by 0.2 rad"
            )
            if not drive_access.confirm(
                "Does its leg hang free, all hands off, the power switch at hand?", yes=yes
            ):
                console.print(f"{module} and what comes after it were not calibrated")
                return DECLINED_EXIT_CODE
            check()  # a person may take minutes to answer
            with interrupts.kept(), console.status(module) as status:
                told = _Course(console, module, status.update)
                result = calibration.calibrate_board(board, those, interrupts, told)
        except DriveError as error:
            console.print(marked("[bold red]{}[/]: {}", module, error))
            console.print("what it was at ends by itself; switch its supply off and on after that")
            code = FAULT_EXIT_CODE
            continue
        good = tell(console, robot, module, result)
        code = code if good else FAULT_EXIT_CODE
        done += [] if result.why else [module]
        if interrupts.number or result.not_idle:
            break
    rest = [module for module in boards if module not in done]
    if done:
        console.print(
            f"calibrated, and so without a zero: {', '.join(done)}; next `xrl drive zero`, "
            "for each: MODULE --at PHI,THETA"
        )
    if rest:
        console.print(f"not calibrated: {', '.join(rest)}")
    return code


def tell(console: Console, robot: RobotConfig, module: str, result: BoardResult) -> bool:
    """Print what came of a board's calibrations; return False if something is to be done."""
    for axis, found in result.found.items():
        console.print(
            f"{module}.{axis}: {found.resistance:.3g} ohm, {1e6 * found.inductance:.3g} uH, "
            f"direction {found.direction}"
        )
    if result.why:
        console.print(marked("[bold red]{} was not calibrated[/]: {}", module, result.why))
        if result.not_idle:
            console.print(marked("[bold red]{}: {}[/]", module, NOT_IDLE))
        else:
            console.print(
                "nothing of it was saved; the board has restarted with what it had, without a zero"
            )
        return False
    values = {f"{axis}.encoder.is_ready": True for axis in result.found} | {
        f"{axis}.encoder.config.direction": each.direction for axis, each in result.found.items()
    }
    wrong = [
        row for row in direction_rows(module, values, robot) if row.verdict is FindingKind.WRONG
    ]
    for row in wrong:
        console.print(
            marked("[bold red]{}[/]: direction is {}: {}", row.subject, row.found, row.fix)
        )
    return not wrong


class _Course:
    """Says what an axis is at: a line for each calibration, and the seconds in place."""

    def __init__(self, console: Console, module: str, show: Callable[[str], None]) -> None:
        self._console, self._module, self._show = console, module, show
        self._begun: tuple[str, str] | None = None

    def __call__(self, axis: str, procedure: Procedure, passed_s: float) -> None:
        """See `calibration.Progress`."""
        what = f"{self._module}.{axis}: {procedure.what}"
        if self._begun != (axis, procedure.what):
            self._begun = (axis, procedure.what)
            self._console.print(f"{what}, {procedure.seconds:.3g} s")
        self._show(f"{what}, {passed_s:.1f} of {procedure.seconds:.1f} s")
