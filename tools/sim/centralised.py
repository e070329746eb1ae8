"""A baseline for comparison: the planner computes every torque, the joint services none.

It runs only in virtual time: `xrl sim --control` and `xrl study latency --control` select it. The
planner runs the shipped law, and also computes the joint services' part,

    tau = D (q_ref - q) + D_B (v_ref - v) + tau_ff + tau_coupled

from the states that it has received, as one torque for each joint. The modules send this torque to
the drives unchanged until the next torque arrives. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec

from services.joint import pd_law
from services.joint.differential import limit_differential, motor_torque
from services.joint.drive_manager import ArmingInhibit, DriveAction, DriveCommand, DriveManager
from services.joint.drivers.base import DriveReading
from services.joint.neighbours import UNKNOWN, NeighbourView
from services.planner.planner import Planner
from services.planner.watch.engagement_fsm import Engagement
from shared.bus.messages import (
    DriveStatus,
    JointCommand,
    JointState,
    Mode,
    PlannerMode,
    PlannerStatus,
)
from shared.clock import NS_PER_MS
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from shared.robot.trip_table import untripped
from tools.sim.lockstep import Lockstep


class _LeadsOn(Engagement):
    """Engagement that never ends, whatever the states, because no lower tier could hold."""

    def advance(
        self,
        now_ns: int,
        fresh: list[bool],
        ready: list[bool],
        modes: list[int],
        inhibit: PlannerMode | None = None,
    ) -> bool:
        """Update from the modules, as `Engagement.advance` does."""
        if self.mode is PlannerMode.LEADING:
            return False
        return super().advance(now_ns, fresh, ready, modes, inhibit)


class _CentralPlanner(Planner):
    """The shipped planner, with whole torques as commands."""

    def __init__(self, config: RobotConfig, session: int) -> None:
        super().__init__(config, session)
        self.state.engagement = _LeadsOn()

    def tick(self, now_ns: int) -> list[JointCommand]:
        """Run the law; return six commands, whose `tau_ff` is a joint's whole torque."""
        commands = super().tick(now_ns)
        states: Sequence[JointState] = [state for state in self.state.states if state is not None]
        return [_whole(*pair) for pair in zip(commands, states, strict=True)] if commands else []

    def status(
        self, now_ns: int, tick_us: float, commands: Sequence[JointCommand] = ()
    ) -> PlannerStatus:
        """Return the status of the last tick; margins are 0, as no tier holds alone."""
        status = super().status(now_ns, tick_us, commands)
        return msgspec.structs.replace(status, margin=0.0, margin_onboard=0.0)


def _whole(command: JointCommand, state: JointState) -> JointCommand:
    """Return a command whose `tau_ff` is the whole torque at a state."""
    return msgspec.structs.replace(
        command,
        v_ref=pd_law.ZERO,
        tau_ff=pd_law.torque(pd_law.extrapolate(command, 0.0), state.q, state.v),
        dtau_ff=pd_law.ZERO,
        tau_coupled=pd_law.ZERO,
        k_p=pd_law.ZERO,
        k_d=pd_law.ZERO,
        margin=0.0,
        margin_onboard=0.0,
    )


class _PassThrough(DriveManager):
    """A joint module that forwards torques.

    It starts like the shipped module, on the hoist, through HOLD into TRACK. After the blend into
    TRACK it has no law: it sends the newest received torque to the drive, however old, within the
    torque diamond. After an emergency stop, or with a lost drive, the shipped module's law applies
    again.
    """

    def __init__(self, config: RobotConfig, name: str) -> None:
        super().__init__(config, name)
        self._blend_ns = config.joint_service.blend_ms * NS_PER_MS
        self._tau_module_max = config.joint.tau_module_max
        self._tracks_since_ns: int | None = None

    def step(
        self,
        now_ns: int,
        reading: DriveReading | None,
        command: JointCommand | None,
        estop: bool,
        near: NeighbourView = UNKNOWN,  # noqa: ARG002 - nothing here sinks
    ) -> DriveAction:
        """Run one cycle; arguments as for the shipped module."""
        problem = estop or (reading is not None and reading.status is not DriveStatus.ARMED)
        if problem or not self._passes(now_ns):
            step = super().step(now_ns, reading, command, estop)
            if step.event is not None:
                tracks = step.event.mode_after == Mode.TRACK
                self._tracks_since_ns = now_ns if tracks else None
            return step
        controller = self.state.controller
        controller.cycle += 1
        if reading is not None:
            controller.estimate.process(reading, armed=True)
        if command is not None and all(map(math.isfinite, command.tau_ff)):
            controller.failsafe.command = command  # the states report its age
            controller.tau = limit_differential(command.tau_ff, self._tau_module_max)
        torque = motor_torque(controller.tau, self._gear_ratio)
        return DriveAction(None, DriveCommand.TORQUE, torque, None, ArmingInhibit.NONE)

    def _passes(self, now_ns: int) -> bool:
        since_ns = self._tracks_since_ns
        return since_ns is not None and now_ns - since_ns >= self._blend_ns


def torques_only(config: RobotConfig) -> RobotConfig:
    """Return the robot with drives in torque mode, which cannot hold on their own.

    Its joint services check no envelope, because this planner sends gains of zero. Trips are off.
    """
    service = msgspec.structs.replace(config.joint_service, loop="service")
    return msgspec.structs.replace(untripped(believing(config)), joint_service=service)


class CentralisedLockstep(Lockstep):
    """A whole fleet in virtual time whose planner computes every torque."""

    planner_type = _CentralPlanner
    module_type = _PassThrough

    def __init__(self, config: RobotConfig, *args: Any, **how: Any) -> None:
        """Put the robot on the hoist; arguments as for `Lockstep`."""
        super().__init__(torques_only(config), *args, **how)


SHIPPED: Final = "distributed"
CONTROLS: Final[Mapping[str, type[Lockstep]]] = {
    SHIPPED: Lockstep,
    "centralised": CentralisedLockstep,
}
"""Type of fleet for each value of `--control`."""
