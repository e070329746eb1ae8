"""The CANSimple frames that an ODrive's two axes are told with. Pure."""

from __future__ import annotations

from typing import Final

import can

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.can_link import message
from shared import cansimple
from shared.cansimple import AxisState, Command, ControlMode, InputMode
from shared.config_sections import DriveConfig

Nodes = tuple[int, int]
Order = tuple[Command, bytes]
"""A command with its payload, for both axes."""

IDLING: Final[tuple[Order, ...]] = (
    (Command.SET_INPUT_TORQUE, cansimple.pack_float(0.0)),
    (Command.SET_AXIS_STATE, cansimple.pack_u32(AxisState.IDLE)),
)


def arming(drive: DriveConfig, *, onboard: bool) -> tuple[Order, ...]:
    """Return what leads to closed loop with no torque, and with no gains if onboard.

    Errors are cleared, and `input_torque` zeroed first: re-arming would otherwise bring back
    the torque of before. In position mode the firmware itself sets input_pos to where it is;
    the gains it ships with have an integrator, so they are zeroed too. In torque mode they
    are left: by vel_gain the firmware limits the velocity, and with none all torque.
    """
    mode = ControlMode.POSITION if onboard else ControlMode.TORQUE
    no_gains = (
        (Command.SET_VEL_GAINS, cansimple.pack_two_floats(0.0, 0.0)),
        (Command.SET_POS_GAIN, cansimple.pack_float(0.0)),
    )
    return (
        (Command.CLEAR_ERRORS, b""),
        (Command.SET_CONTROLLER_MODE, cansimple.pack_two_ints(mode, InputMode.PASSTHROUGH)),
        (Command.SET_LIMITS, cansimple.pack_two_floats(drive.vel_limit, drive.current_lim)),
        *(no_gains if onboard else ()),
        (Command.SET_INPUT_TORQUE, cansimple.pack_float(0.0)),
        (Command.SET_AXIS_STATE, cansimple.pack_u32(AxisState.CLOSED_LOOP_CONTROL)),
    )


def modes(nodes: Nodes, control_mode: ControlMode) -> list[can.Message]:
    """Return the frames that choose the controller's mode."""
    data = cansimple.pack_two_ints(control_mode, InputMode.PASSTHROUGH)
    return [message(node, Command.SET_CONTROLLER_MODE, data) for node in nodes]


def gains(nodes: Nodes, target: MotorTarget) -> list[can.Message]:
    """Return the frames of both motors' gains, without an integrator."""
    frames = []
    for node, pos_gain, vel_gain in zip(nodes, target.pos_gain, target.vel_gain, strict=True):
        velocity = cansimple.pack_two_floats(vel_gain, 0.0)
        frames.append(message(node, Command.SET_VEL_GAINS, velocity))
        frames.append(message(node, Command.SET_POS_GAIN, cansimple.pack_float(pos_gain)))
    return frames


def fill_inputs(frames: tuple[can.Message, can.Message], target: MotorTarget) -> None:
    """Write position, velocity and torque into the two axes' frames, which are kept.

    Velocity and torque travel in thousandths: the torque to 0.035 N m at the joint.
    """
    for frame, pos, vel, torque in zip(
        frames, target.pos_turns, target.vel_turns, target.torque, strict=True
    ):
        frame.data[:] = cansimple.pack_input_pos(pos, vel, torque)
