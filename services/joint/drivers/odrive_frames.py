"""CANSimple frames for an ODrive's two axes. Pure.

They are the same for both firmware generations, except frames that write a position.
"""

from __future__ import annotations

from struct import Struct
from typing import Final

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.can_link import packed
from services.joint.drivers.firmware import Dialect
from services.joint.drivers.resend_policy import GainRow
from shared.bus.messages import Pair
from shared.can import cansimple
from shared.can.cansimple import AxisState, Command, ControlMode, InputMode
from shared.can.unix_can import FRAME_BYTES
from shared.config.sections import DriveConfig
from shared.exceptions import DriveError

Nodes = tuple[int, int]
CanCommand = tuple[Command, bytes]
"""A command with its payload, for both axes."""

_INPUT: Final = "IB3xfhh"
_pack_inputs = Struct(f"<{_INPUT}{_INPUT}").pack
_pack_gains_and_input = Struct(f"<IB3xf4xIB3xff{_INPUT}").pack
_pack_torques = Struct("<IB3xf4xIB3xf4x").pack
_MILLI: Final = 1000.0
_MILLI_MAX: Final = (1 << 15) - 1

IDLING: Final[tuple[CanCommand, ...]] = (
    (Command.SET_INPUT_TORQUE, cansimple.pack_float(0.0)),
    (Command.SET_AXIS_STATE, cansimple.pack_u32(AxisState.IDLE)),
)
CLEARING: Final[tuple[CanCommand, ...]] = ((Command.CLEAR_ERRORS, b"\0"),)
"""0.6 reads one byte (whether to blink); 0.5 ignores it."""


def packet_of(nodes: Nodes, commands: tuple[CanCommand, ...]) -> bytes:
    """Return the frames of commands to both axes."""
    return b"".join(packed(node, command, data) for command, data in commands for node in nodes)


def arming(drive: DriveConfig, *, onboard: bool) -> tuple[CanCommand, ...]:
    """Return the commands that start closed loop without torque, and without gains if onboard.

    Errors are cleared and `input_torque` is zeroed first: re-arming would otherwise bring back the
    earlier torque. In position mode the firmware itself sets input_pos to the present position; its
    factory gains have an integrator, so they are zeroed too. In torque mode they are kept, because
    the firmware limits the velocity with vel_gain, and a zero gain would suppress all torque.
    """
    no_gains = (
        (Command.SET_VEL_GAINS, cansimple.pack_two_floats(0.0, 0.0)),
        (Command.SET_POS_GAIN, cansimple.pack_float(0.0)),
    )
    return (
        *CLEARING,
        (Command.SET_CONTROLLER_MODE, _modes(onboard=onboard)),
        (Command.SET_LIMITS, cansimple.pack_two_floats(drive.vel_limit, drive.current_lim)),
        *(no_gains if onboard else ()),
        (Command.SET_INPUT_TORQUE, cansimple.pack_float(0.0)),
        (Command.SET_AXIS_STATE, cansimple.pack_u32(AxisState.CLOSED_LOOP_CONTROL)),
    )


class Rows:
    """Packs the frames that are sent often.

    An axis's gains are sent right before its target. The stiffness is the product of both gains. In
    DAMP, where they change a lot, pos_gain falls and is sent first; otherwise the stiffness would
    double in between. Setting a mode moves a 0.5 drive's input_pos to the motor's position, so the
    axis's own target follows at once.
    """

    def __init__(self, nodes: Nodes, drive: DriveConfig) -> None:
        self._torque_max = drive.current_lim * drive.torque_constant
        limits = cansimple.pack_two_floats(drive.vel_limit, drive.current_lim)
        self._limits = packet_of(nodes, ((Command.SET_LIMITS, limits),))
        mode = Command.SET_CONTROLLER_MODE
        self._torque_mode = packet_of(nodes, ((mode, _modes(onboard=False)),))
        self._position_modes = [packed(node, mode, _modes(onboard=True)) for node in nodes]
        self._torque_ids, self._input_ids, self._vel_gain_ids, self._pos_gain_ids = (
            [cansimple.arbitration_id(node, command) for node in nodes]
            for command in (
                Command.SET_INPUT_TORQUE, Command.SET_INPUT_POS,
                Command.SET_VEL_GAINS, Command.SET_POS_GAIN,
            )
        )  # fmt: skip

    def torques(self, torque: Pair, *, settles: bool) -> bytes:
        """Pack torques, N m, clipped to `current_lim`; NaN becomes zero.

        `settles`: True to include the limits and modes that arming has sent.
        """
        most, (id_0, id_1) = self._torque_max, self._torque_ids
        first, second = (
            value
            if -most <= value <= most
            else most
            if value > most
            else -most
            if value < 0
            else 0.0
            for value in torque
        )
        packet = _pack_torques(id_0, 4, first, id_1, 4, second)
        return self._limits + self._torque_mode + packet if settles else packet

    def target(self, row: GainRow, target: MotorTarget, first: int) -> bytes:
        """Pack a target, and the frames that are sent with it.

        After a full queue has cut off one axis, that axis is `first`, so it is not cut off again.
        Velocity and torque are sent in thousandths: torque steps are 0.035 N m at the joint.
        """
        second = 1 - first
        pos, vel, torque, ids = target.pos_turns, target.vel_turns, target.torque, self._input_ids
        if row is GainRow.INPUTS:
            return _pack_inputs(
                ids[first], 8, pos[first], _milli(vel[first]), _milli(torque[first]),
                ids[second], 8, pos[second], _milli(vel[second]), _milli(torque[second]),
            )  # fmt: skip
        packet = self._limits if row is GainRow.ALL else b""
        for axis in (first, second):
            frames = _pack_gains_and_input(
                self._pos_gain_ids[axis], 4, target.pos_gain[axis],
                self._vel_gain_ids[axis], 8, target.vel_gain[axis], 0.0,
                ids[axis], 8, pos[axis], _milli(vel[axis]), _milli(torque[axis]),
            )  # fmt: skip
            if row is GainRow.ALL:
                at = len(frames) - FRAME_BYTES
                frames = frames[:at] + self._position_modes[axis] + frames[at:]
            packet += frames
        return packet


def _milli(value: float) -> int:
    """Return thousandths as the nearest int16."""
    return round(max(-_MILLI_MAX, min(_MILLI_MAX, value * _MILLI)))


def positions(nodes: Nodes, turns: Pair, dialect: Dialect, counts_per_turn: int | None) -> bytes:
    """Return the frames that write both motors' positions: turns for 0.6, counts for 0.5.

    Raises:
        DriveError: the firmware or the counts per turn are unknown, or the position is invalid.
    """
    who = f"CAN nodes {nodes[0]} and {nodes[1]}"
    if dialect == "":
        raise DriveError(
            f"{who}: no heartbeat has shown the firmware yet; wait until the drive reports a state"
        )
    if dialect == "0.5" and counts_per_turn is None:
        raise DriveError(
            f"{who}: firmware 0.5 takes counts; set joint.encoder_counts_per_turn in the robot file"
        )
    scale = counts_per_turn if dialect == "0.5" and counts_per_turn is not None else 1
    if not all(abs(turn * scale) < (1 << 31) - 1 for turn in turns):
        raise DriveError(
            f"{who}: {turns[0]:g} and {turns[1]:g} turns do not fit into 32 bits; give smaller ones"
        )
    if dialect == "0.5":
        payloads = [cansimple.pack_i32(round(turn * scale)) for turn in turns]
    else:
        payloads = [cansimple.pack_float(turn) for turn in turns]
    return b"".join(
        packed(node, Command.SET_LINEAR_COUNT, data)
        for node, data in zip(nodes, payloads, strict=True)
    )


def _modes(*, onboard: bool) -> bytes:
    mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
    return cansimple.pack_two_ints(mode, InputMode.PASSTHROUGH)
