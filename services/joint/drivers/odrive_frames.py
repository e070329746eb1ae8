"""CANSimple frames for an ODrive's two axes. Pure.

They are the same for both firmwares except those that write a position.
"""

from __future__ import annotations

from struct import Struct
from typing import Final

import can

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.can_link import message
from services.joint.drivers.firmware import Dialect
from shared.bus.messages import Pair
from shared.can import cansimple
from shared.can.cansimple import AxisState, Command, ControlMode, InputMode
from shared.config.sections import DriveConfig
from shared.exceptions import DriveError

Nodes = tuple[int, int]
CanCommand = tuple[Command, bytes]
"""A command with its payload, for both axes."""

_pack_float = Struct("<f").pack
_pack_two_floats = Struct("<ff").pack

IDLING: Final[tuple[CanCommand, ...]] = (
    (Command.SET_INPUT_TORQUE, cansimple.pack_float(0.0)),
    (Command.SET_AXIS_STATE, cansimple.pack_u32(AxisState.IDLE)),
)
CLEARING: Final[tuple[CanCommand, ...]] = ((Command.CLEAR_ERRORS, b"\0"),)
"""0.6 takes a byte (whether to blink), 0.5 looks at none."""


def messages_of(nodes: Nodes, commands: tuple[CanCommand, ...]) -> list[can.Message]:
    """Return the frames of commands to both axes."""
    return [message(node, command, data) for command, data in commands for node in nodes]


def arming(drive: DriveConfig, *, onboard: bool) -> tuple[CanCommand, ...]:
    """Return what leads to closed loop with no torque, and with no gains if onboard.

    Errors are cleared, and `input_torque` zeroed first: re-arming would otherwise bring back
    the torque of before. In position mode the firmware itself sets input_pos to where it is;
    the gains it ships with have an integrator, so they are zeroed too. In torque mode they
    are left: by vel_gain the firmware limits the velocity, and with none all torque.
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


class Frames:
    """The frames that are sent in every cycle or often: made once, filled each time.

    Attributes:
        torques: both input torques.
        first_torques: with the limits and modes that arming has sent.
        rows: what goes out with a target, by `resend_policy.GainRow`, with axis0 first and with
            axis1 first. After a full queue cut one axis off, the other is not cut off next.
            An axis's gains come right before the target that they belong to. Its stiffness is
            the product of both, and where they change by much (DAMP) pos_gain falls: it goes
            first, or the stiffness doubles in between. A mode that is set puts a 0.5 drive's
            input_pos to where the motor is: the axis's own target follows at once.
    """

    def __init__(self, nodes: Nodes, drive: DriveConfig) -> None:
        self._torque_max = drive.current_lim * drive.torque_constant
        limits = cansimple.pack_two_floats(drive.vel_limit, drive.current_lim)
        limit_frames = [message(n, Command.SET_LIMITS, limits) for n in nodes]
        torque_mode, position_mode = (
            [message(n, Command.SET_CONTROLLER_MODE, _modes(onboard=onboard)) for n in nodes]
            for onboard in (False, True)
        )
        self.torques = [message(n, Command.SET_INPUT_TORQUE, bytes(4)) for n in nodes]
        self._inputs = [message(n, Command.SET_INPUT_POS, bytes(8)) for n in nodes]
        self._vel_gains = [message(n, Command.SET_VEL_GAINS, bytes(8)) for n in nodes]
        self._pos_gains = [message(n, Command.SET_POS_GAIN, bytes(4)) for n in nodes]
        self.first_torques = [*limit_frames, *torque_mode, *self.torques]
        lone = [[target] for target in self._inputs]
        gains = [list(both) for both in zip(self._pos_gains, self._vel_gains, strict=True)]
        with_gains = [own + target for own, target in zip(gains, lone, strict=True)]
        first = [
            [*own, mode, *target]
            for own, mode, target in zip(gains, position_mode, lone, strict=True)
        ]
        self.rows = (
            _either_first([], lone),
            _either_first([], with_gains),
            _either_first(limit_frames, first),
        )

    def fill_torques(self, torque: Pair) -> None:
        """Write torques, N m, within `current_lim`; one that is not finite becomes zero."""
        limit = self._torque_max
        for frame, value in zip(self.torques, torque, strict=True):
            if not -limit <= value <= limit:
                value = limit if value > limit else -limit if value < -limit else 0.0  # noqa: PLW2901
            frame.data[:] = _pack_float(value)

    def fill_inputs(self, target: MotorTarget) -> None:
        """Write position, velocity and torque.

        Velocity and torque travel in thousandths: the torque to 0.035 N m at the joint.
        """
        for frame, pos, vel, torque in zip(
            self._inputs, target.pos_turns, target.vel_turns, target.torque, strict=True
        ):
            frame.data[:] = cansimple.pack_input_pos(pos, vel, torque)

    def fill_gains(self, target: MotorTarget) -> None:
        """Write the gains, without an integrator."""
        for frame, gain in zip(self._vel_gains, target.vel_gain, strict=True):
            frame.data[:] = _pack_two_floats(gain, 0.0)
        for frame, gain in zip(self._pos_gains, target.pos_gain, strict=True):
            frame.data[:] = _pack_float(gain)


def positions(
    nodes: Nodes, turns: Pair, dialect: Dialect, counts_per_turn: int | None
) -> list[can.Message]:
    """Return the frames that write both motors' position: turns for 0.6, counts for 0.5.

    Raises:
        DriveError: the firmware or the counts per turn are unknown, or the position is invalid.
    """
    who = f"CAN nodes {nodes[0]} and {nodes[1]}"
    if dialect == "":
        raise DriveError(
            f"{who}: no heartbeat has shown yet which firmware they have; "
            "wait until the drive reports a state"
        )
    if dialect == "0.5" and counts_per_turn is None:
        raise DriveError(f"{who}: firmware 0.5 takes counts; give the encoder's to a turn")
    scale = counts_per_turn if dialect == "0.5" and counts_per_turn is not None else 1
    if not all(abs(turn * scale) < (1 << 31) - 1 for turn in turns):
        raise DriveError(f"{who}: {turns[0]:g} and {turns[1]:g} turns are more than 32 bits hold")
    if dialect == "0.5":
        payloads = [cansimple.pack_i32(round(turn * scale)) for turn in turns]
    else:
        payloads = [cansimple.pack_float(turn) for turn in turns]
    return [
        message(node, Command.SET_LINEAR_COUNT, data)
        for node, data in zip(nodes, payloads, strict=True)
    ]


def _either_first(
    before: list[can.Message], axes: list[list[can.Message]]
) -> tuple[list[can.Message], list[can.Message]]:
    """Return a row with axis0's frames before axis1's, and one the other way round."""
    first, second = axes
    return [*before, *first, *second], [*before, *second, *first]


def _modes(*, onboard: bool) -> bytes:
    mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
    return cansimple.pack_two_ints(mode, InputMode.PASSTHROUGH)
