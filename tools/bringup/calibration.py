"""Calibrate the motors and encoders of a hanging robot's boards, and judge the results.

A board first restarts, which clears its errors and idles both axes. The `pre_calibrated` marks are
written and saved once all axes are done. If the calibration fails or is aborted, the board restarts
once the axis is idle, to discard partial results, which it would treat as complete
(docs/drives.md#traps).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from enum import IntFlag
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from rich.status import Status

from services.joint.differential import joint_from_motor
from shared.bus.messages import Pair
from shared.can.cansimple import AxisState, EncoderError, MotorError, OdriveError
from shared.can.drive_settings import AXES
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError
from shared.joints import MODULES
from tools.bringup import can_monitor, drive_access
from tools.bringup.boards import ABSOLUTE, AXIS_ERRORS, DIRECTION, Board, FoundBoards, Value, number
from tools.bringup.check_board import describe_flags, direction_rows, trip_levels_of
from tools.bringup.findings import FindingKind
from tools.bringup.hanging_leg import leg_of, why_resting
from tools.bringup.motion_runner import NOT_IDLE, Interrupts
from tools.terminal import Console, marked

MOTOR_S: Final = 4.25
"""Duration of the motor calibration, s: resistance 3 s, inductance 1.25 s."""
LOCK_S: Final = 1.0
"""Time before the encoder scan begins, s; the scan goes out and back."""
CURRENT_MARGIN: Final = 8.0
"""Excess over `current_lim` at which a drive with factory settings disarms, A."""
POLL_S: Final = 0.1
OVERTIME_S: Final = 3.0
IDLE_S: Final = 2.0
STILL_S: Final = 0.5
STILL_WAIT_S: Final = 20.0
STILL_TURNS: Final = 0.02
"""Maximum motion of a motor at rest in `STILL_S`, turns."""
SHARE_MIN: Final = 0.98
"""A procedure that ends before this fraction of its duration was aborted."""
POLES_WITHIN: Final = 0.04
"""Maximum relative error at which another number of pole pairs explains the response."""

_WATCHDOG: Final = "config.enable_watchdog"
MARKS: Final = ("motor.config.pre_calibrated", "encoder.config.pre_calibrated")
_READY: Final = ("motor.is_calibrated", "encoder.is_ready")
_LOOK: Final = (
    "encoder.config.mode", "encoder.config.cpr", "encoder.config.calib_scan_distance",
    "encoder.config.calib_scan_omega", "motor.config.pole_pairs",
    "motor.config.calibration_current", "motor.config.current_lim", "current_state",
)  # fmt: skip

_STOPPED: Final = (
    "the joint is blocked, at its stop or loaded: hang the leg clear of the floor; if that is not "
    "enough, raise motor.config.calibration_current (15 A turns a leg that 10 A does not)"
)
ADVICE: Final[Mapping[tuple[str, IntFlag], str]] = {
    ("motor.error", MotorError.PHASE_RESISTANCE_OUT_OF_RANGE):
        "check the three phase wires: one is loose or broken. Otherwise the motor's resistance "
        "exceeds resistance_calib_max_voltage / calibration_current: lower the current, or raise "
        "the voltage to at most half the supply voltage",
    ("motor.error", MotorError.PHASE_INDUCTANCE_OUT_OF_RANGE):
        "check the three phase wires: two touch, or one is loose",
    ("motor.error", MotorError.UNBALANCED_PHASES):
        "check the three phase wires: one is loose",
    ("motor.error", MotorError.CURRENT_LIMIT_VIOLATION):
        "motor.config.calibration_current exceeds current_lim plus its margin, or a winding has a "
        "short circuit",
    ("motor.error", MotorError.DRV_FAULT):
        "the phases have a short circuit, or the board is broken: measure between the phases",
    ("motor.error", MotorError.MODULATION_MAGNITUDE):
        "the supply voltage is too low: it must be at least twice resistance_calib_max_voltage",
    ("encoder.error", EncoderError.NO_RESPONSE):
        f"the encoder does not count while the field turns: {_STOPPED}. If the shaft turned, "
        "check the encoder's magnet and plug",
    ("encoder.error", EncoderError.ABS_SPI_COM_FAIL):
        "the encoder does not answer: check its plug, wires, encoder.config.abs_spi_cs_gpio_pin "
        "and mode",
}  # fmt: skip
"""Remedy by register and bit."""


class Found(NamedTuple):
    """Results of calibrating an axis."""

    resistance: float
    inductance: float
    direction: int


class BoardResult(NamedTuple):
    """Result of calibrating a board."""

    found: dict[str, Found]
    """Results by axis; saved only if nothing failed."""
    why: str = ""
    """Failure and remedy, or ""."""
    not_idle: bool = False
    """True if an axis does not report that it is idle."""


class Procedure(NamedTuple):
    """One calibration: the state to request, its name and its duration."""

    state: AxisState
    what: str
    seconds: float


Progress = Callable[[str, Procedure, float], None]
"""Receives the axis, its procedure, and the time since the procedure began, s."""


def uncalibrated(board: Board) -> tuple[str, ...]:
    """Return the axes of a board that are not calibrated, and therefore do not arm."""
    values = board.read([f"{axis}.{name}" for axis in AXES for name in _READY])
    return tuple(axis for axis in AXES if not all(values.get(f"{axis}.{n}") for n in _READY))


def procedures(board: Board, axis: str) -> tuple[Procedure, Procedure]:
    """Return both calibrations of an axis, with their durations."""
    names = [f"{axis}.encoder.config.calib_scan_{name}" for name in ("distance", "omega")]
    values = board.read(names)
    distance, rate = (number(values, name) for name in names)
    if not (distance > 0.0 and rate > 0.0):
        raise DriveError(
            f"{names[0]} is {distance:g} and {names[1]} is {rate:g}; both must be above 0"
        )
    scan_s = LOCK_S + 2.0 * distance / rate
    return (
        Procedure(AxisState.MOTOR_CALIBRATION, "motor", MOTOR_S),
        Procedure(AxisState.ENCODER_OFFSET_CALIBRATION, "encoder", scan_s),
    )


def _scan_turns(values: Mapping[str, Value], axis: str) -> float:
    """Return how far the encoder calibration turns the motor, out and back, turns."""
    distance = number(values, f"{axis}.encoder.config.calib_scan_distance")
    poles = number(values, f"{axis}.motor.config.pole_pairs")
    return distance / (2.0 * math.pi * poles) if poles > 0.0 else math.inf


def refuse_unfit(
    module: str, board: Board, axes: Sequence[str], pause: Callable[[float], None] = time.sleep
) -> None:
    """Raise DriveError if a board's settings or supply prevent calibration, or its joint moves."""
    names = [f"{axis}.{name}" for axis in axes for name in _LOOK]
    levels = [f"config.dc_bus_{name}voltage_trip_level" for name in ("under", "over")]
    values = board.read([*names, *levels, "vbus_voltage"])
    low, high = trip_levels_of(values)
    volts = number(values, "vbus_voltage")
    faults = []
    if not low < volts < high:
        faults.append(f"its supply is at {volts:.1f} V, outside of {low:g} to {high:g} V")
    for axis in axes:
        mode = int(number(values, f"{axis}.encoder.config.mode"))
        if not mode & ABSOLUTE:
            faults.append(
                f"{axis}.encoder.config.mode is {mode}: not an absolute encoder; set 257 for AMS "
                "over SPI (docs/bring-up.md, section 5)"
            )
        current = number(values, f"{axis}.motor.config.calibration_current")
        most = number(values, f"{axis}.motor.config.current_lim") + CURRENT_MARGIN
        if not 0.0 < current <= most:
            faults.append(
                f"{axis}.motor.config.calibration_current is {current:g} A; must be above 0 and, "
                f"with this current_lim, at most {most:g} A"
            )
        if _scan_turns(values, axis) > 2.0:
            faults.append(
                f"{axis} would turn by {_scan_turns(values, axis):.1f} turns and back; check "
                "motor.config.pole_pairs and encoder.config.calib_scan_distance"
            )
    if moves := _await_still(board, pause):
        faults.append(moves)
    if faults:
        raise DriveError(f"{module}: {'; '.join(faults)}; nothing was calibrated")


def calibrate_board(
    board: Board,
    axes: Sequence[str],
    interrupts: Interrupts,
    progress: Progress,
    clock: Callable[[], float] = time.monotonic,
    pause: Callable[[float], None] = time.sleep,
) -> BoardResult:
    """Calibrate axes of a board in turn, mark and save them; after a failure, save nothing.

    Args:
        board: idle board; it restarts before and, unless an axis stays active, after.
        axes: "axis0", "axis1" or both.
        interrupts: polled; a signal ends the calibration and idles the axis, and nothing is saved.
        progress: see `Progress`.
        clock: monotonic, s.
        pause: sleeps for a time, s.
    """
    board.restart()
    # nothing feeds the watchdogs over USB, so they would end the calibration
    watchdogs = board.read([f"{axis}.{_WATCHDOG}" for axis in AXES])
    board.write(dict.fromkeys(watchdogs, False))
    board.clear_errors()
    found: dict[str, Found] = {}
    for axis in axes:
        for procedure in procedures(board, axis):
            why = _await_still(board, pause)  # the previous axis made the leg swing
            why = why or _run(board, axis, procedure, interrupts, progress, clock, pause)
            if why:
                idle = _idle(board, axis, clock, pause)
                if idle:
                    board.restart()
                return BoardResult(found, f"{axis}, {procedure.what}: {why}", not_idle=not idle)
        found[axis] = _found(board, axis)
    marks: dict[str, Value] = {f"{axis}.{mark}": True for axis in axes for mark in MARKS}
    board.write(marks | watchdogs)
    board.save()
    lost = [axis for axis in uncalibrated(board) if axis in axes]
    after = board.read(list(marks))
    lost += [name for name in marks if after.get(name) is not True]
    why = f"lost in the restart: {', '.join(lost)}; try again" if lost else ""
    return BoardResult(found, why)


def _zeroed_angles(robot: RobotConfig, module: str, board: Board) -> Pair | None:
    """Return the angles of a board's joint, (phi, theta), rad; None if it is unzeroed."""
    values = board.read([f"{axis}.encoder.pos_estimate" for axis in AXES])
    if len(values) < len(AXES):
        return None
    mark, signs = robot.drive.zero_mark_turns, robot.module_named(module).motor_signs
    a, b = (number(values, name) * sign - mark for name, sign in zip(values, signs, strict=True))
    zeroed = mark == 0.0 or max(abs(a), abs(b)) < 0.5 * mark
    return joint_from_motor((a, b), robot.joint.gear_ratio) if zeroed else None


def _run(
    board: Board,
    axis: str,
    procedure: Procedure,
    interrupts: Interrupts,
    progress: Progress,
    clock: Callable[[], float],
    pause: Callable[[float], None],
) -> str:
    """Run one calibration; return why it failed, or ""."""
    begun_s = clock()
    progress(axis, procedure, 0.0)
    board.write({f"{axis}.requested_state": int(procedure.state)})
    while True:
        if interrupts.number:
            return interrupts.words
        pause(POLL_S)
        passed_s = clock() - begun_s
        progress(axis, procedure, passed_s)
        state = board.states()[AXES.index(axis)]
        if state == AxisState.IDLE:
            return _why_failed(board, axis, procedure, passed_s)
        if passed_s > procedure.seconds + OVERTIME_S:
            return (
                f"the axis is still in state {state} after {passed_s:.0f} s instead of "
                f"{procedure.seconds:.0f} s"
            )


def _why_failed(board: Board, axis: str, procedure: Procedure, passed_s: float) -> str:
    """Return why an axis that is idle again failed its calibration, or ""."""
    flag = _READY[0] if procedure.what == "motor" else _READY[1]
    names = [*(f"{axis}.{register}" for register in AXIS_ERRORS), f"{axis}.{flag}"]
    values = board.read(["error", *names])
    errors, advice = [], []
    if bits := int(number(values, "error")):
        errors.append(f"error {describe_flags(OdriveError, bits)}")
    for register, kind in AXIS_ERRORS.items():
        bits = int(number(values, f"{axis}.{register}"))
        if bits:
            errors.append(f"{register} {describe_flags(kind, bits)}")
        advice += [text for (name, bit), text in ADVICE.items() if name == register and bits & bit]
        if kind is EncoderError and bits & EncoderError.CPR_POLEPAIRS_MISMATCH:
            advice.append(_mismatch(board, axis))
    if errors:
        return "; ".join([", ".join(errors), *advice])
    if passed_s < SHARE_MIN * procedure.seconds:
        return (
            f"it ended after {passed_s:.1f} s instead of {procedure.seconds:.1f} s, without an "
            "error: another program commands the axis"
        )
    return "" if values.get(f"{axis}.{flag}") else f"it ended without an error, but {flag} is False"


def _mismatch(board: Board, axis: str) -> str:
    """Return how far the shaft turned, the pole pairs that would explain it, and remedies."""
    name = f"{axis}.encoder.calib_scan_response"
    values = board.read([name, *(f"{axis}.{each}" for each in _LOOK)])
    if not values.get(name):
        return _STOPPED
    turned = number(values, name) / number(values, f"{axis}.encoder.config.cpr")
    expected, poles = _scan_turns(values, axis), number(values, f"{axis}.motor.config.pole_pairs")
    words = f"its encoder counted {turned:.3f} turns instead of {expected:.3f}"
    other = round(expected * poles / turned)
    if other not in (0, poles) and abs(turned * other / (expected * poles) - 1.0) < POLES_WITHIN:
        words += f", as with a motor of {other} pole pairs"
    if turned > expected:
        return f"{words}: check motor.config.pole_pairs and encoder.config.cpr"
    return f"{words}: {_STOPPED}. Or motor.config.pole_pairs or encoder.config.cpr is wrong"


def _found(board: Board, axis: str) -> Found:
    below = ("motor.config.phase_resistance", "motor.config.phase_inductance", DIRECTION)
    names = [f"{axis}.{name}" for name in below]
    values = board.read(names)
    ohm, henry, direction = (number(values, name) for name in names)
    return Found(ohm, henry, int(direction))


def _idle(
    board: Board, axis: str, clock: Callable[[], float], pause: Callable[[float], None]
) -> bool:
    """Idle an axis; return False if it does not report that it is idle."""
    until_s = clock() + IDLE_S
    board.write({f"{axis}.requested_state": int(AxisState.IDLE)})
    while board.states()[AXES.index(axis)] != AxisState.IDLE:
        if clock() > until_s:
            return False
        pause(POLL_S)
    return True


def _await_still(board: Board, pause: Callable[[float], None]) -> str:
    """Wait until a board's motors are at rest; return a fault if they keep moving, or ""."""
    names = [f"{axis}.encoder.pos_estimate" for axis in AXES]
    moved = math.inf
    for _ in range(round(STILL_WAIT_S / STILL_S)):
        first, moved = board.read(names), 0.0
        for _ in range(round(STILL_S / POLL_S)):
            pause(POLL_S)
            now = board.read(names)
            moved = max(moved, *(abs(number(now, n) - number(first, n)) for n in names))
        if moved <= STILL_TURNS:
            return ""
    return f"its motors move on their own, {moved:.2f} turns in {STILL_S:g} s: hold them still"


def to_calibrate(boards: Mapping[str, Board], *, again: bool) -> dict[str, tuple[str, ...]]:
    """Return the axes to calibrate, by module: the uncalibrated ones, or all with `again`."""
    axes = {m: AXES if again else uncalibrated(board) for m, board in boards.items()}
    return {module: those for module, those in axes.items() if those}


def refuse_standing(
    robot: RobotConfig, run_dir: Path, found: FoundBoards, axes: Mapping[str, Sequence[str]]
) -> None:
    """Raise DriveError if the robot may stand: a drive is armed, or a limp leg rests on something.

    States of drives that are not on USB are read from CAN. A leg is judged only if it is zeroed.
    """
    q: dict[str, Pair] = {}
    for module in MODULES:
        board = found.boards.get(robot.module_named(module).serial_number.upper())
        if board is not None:
            states: tuple[int, ...] = board.states()
            angles = _zeroed_angles(robot, module, board)
            q |= {} if angles is None else {module: angles}
        else:
            states = _can_states(robot, module, run_dir)
        if AxisState.CLOSED_LOOP_CONTROL in states:
            raise DriveError(
                f"the drive of {module} is armed: the robot may be standing on it. Hang the robot, "
                "then run `xrl down` or switch its supply off"
            )
    for module in axes:
        leg = leg_of(module)
        if all(each in q for each in leg) and (
            why := why_resting(robot, {each: q[each] for each in leg})
        ):
            raise DriveError(f"{why}. Hang the robot with its feet clear of the floor")


def _can_states(robot: RobotConfig, module: str, run_dir: Path) -> tuple[int, ...]:
    """Return the states in the heartbeats of a module's axes on CAN, without silent axes."""
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
    """Ask the person, and calibrate one module after another; return the exit code.

    After a failed module the next one is calibrated, unless the failed one is not idle or a signal
    arrived.

    Args:
        console: for questions and results.
        robot: robot file.
        boards: board and axes to calibrate, by module.
        interrupts: deferred while an axis calibrates.
        yes: do not ask.
        check: raises an error if another program holds the drives.
    """
    code, done = 0, list[str]()
    for module, (board, those) in boards.items():
        try:
            refuse_unfit(module, board, those)
            seconds = sum(p.seconds for axis in those for p in procedures(board, axis))
            console.print(
                f"\n{module}: {' and '.join(those)}, {seconds:.0f} s; each motor makes about a "
                "turn and back, which moves phi and theta by 0.2 rad"
            )
            if not drive_access.confirm(
                "Does its leg hang free, with hands off and the power switch in reach?", yes=yes
            ):
                console.print(f"{module} and the modules after it were not calibrated")
                return DECLINED_EXIT_CODE
            check()  # a person may take minutes to answer
            with interrupts.kept(), console.status(module) as status:
                result = calibrate_board(board, those, interrupts, partial(_show, status, module))
        except DriveError as error:
            console.print(marked("[bold red]{}[/]: {}", module, error))
            console.print(
                f"if a calibration of {module} had begun, wait until it ends, then switch its "
                "supply off and on"
            )
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
            f"calibrated, and therefore unzeroed: {', '.join(done)}; next, run `xrl drive zero "
            "MODULE --at PHI,THETA` for each module"
        )
    if rest:
        console.print(f"not calibrated: {', '.join(rest)}")
    return code


def tell(console: Console, robot: RobotConfig, module: str, result: BoardResult) -> bool:
    """Print the result of calibrating a board; return False if a person must act."""
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
            console.print("the board has restarted with its stored settings, without a zero")
        return False
    values = {f"{axis}.encoder.is_ready": True for axis in result.found} | {
        f"{axis}.{DIRECTION}": each.direction for axis, each in result.found.items()
    }
    rows = direction_rows(module, values, robot)
    wrong = [row for row in rows if row.verdict is FindingKind.WRONG]
    for row in wrong:
        words = "[bold red]{}[/]: direction is {}: {}"
        console.print(marked(words, row.subject, row.found, row.fix))
    return not wrong


def _show(status: Status, module: str, axis: str, procedure: Procedure, passed_s: float) -> None:
    what = f"{module}.{axis}: {procedure.what}"
    if passed_s == 0.0:
        status.console.print(f"{what}, {procedure.seconds:.3g} s")
    status.update(f"{what}, {passed_s:.1f} of {procedure.seconds:.1f} s")
