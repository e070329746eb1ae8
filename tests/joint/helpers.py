"""A module's controller, and its manager with a drive, on a bench: virtual time and commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import msgspec

from services.joint.controller import ControllerState, CycleResult, JointController
from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_manager import DriveAction, DriveCommand, DriveManager
from services.joint.drivers.base import DriveReading, MotorTarget
from services.joint.failsafe import timing_of
from services.joint.neighbours import UNKNOWN, NeighbourView
from services.joint.pd_law import Setpoint
from services.joint.rearm_guard import LastState
from shared.bus.messages import DriveStatus, JointCommand, Mode, Pair
from shared.can.cansimple import AxisError
from shared.clock import NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.robots import ROBOT as SHIPPED

_KNEE = msgspec.structs.replace(SHIPPED.stand.knee, k_p=(900.0, 1500.0), k_d=(45.0, 25.0))
ROBOT = msgspec.structs.replace(
    believing(SHIPPED),
    stand=msgspec.structs.replace(SHIPPED.stand, knee=_KNEE),
    joint_service=msgspec.structs.replace(SHIPPED.joint_service, hold_stiffens_theta=("ankle",)),
)
"""A robot with a soft knee, whose theta HOLD does not stiffen: no test here is about tuning. Its
joint services believe any command within their limits; `envelope` is tested by itself."""
TIMING = timing_of(ROBOT)
T0 = 1_000 * NS_PER_S
SESSION = 7
LoopName = Literal["onboard", "service"]
T = TypeVar("T")
FULL = Setpoint(
    (0.1, -1.0), (0.2, -0.4), (3.0, -20.0), (5.0, -6.0), (100.0, 800.0), (10.0, 50.0)
)  # fmt: skip
"""A setpoint of which no part is nought or like another."""


def command(**changes: Any) -> JointCommand:
    """Return a command within every limit, with some fields changed."""
    fields: dict[str, Any] = {
        "t_ns": T0, "seq": 1, "session": SESSION, "echo_t_ns": T0, "hold": False,
        "q_ref": (0.02, -1.0), "v_ref": (0.0, 0.0),
        "tau_ff": (3.0, -25.0), "dtau_ff": (0.0, 0.0), "tau_coupled": (0.0, 0.0),
        "k_p": (600.0, 800.0), "k_d": (40.0, 50.0), "margin": 1.0, "margin_onboard": 0.5,
    }  # fmt: skip
    return JointCommand(**(fields | changes))


def with_service(robot: RobotConfig, **changes: Any) -> RobotConfig:
    """Return the robot with some keys of [joint_service] changed."""
    service = msgspec.structs.replace(robot.joint_service, **changes)
    return msgspec.structs.replace(robot, joint_service=service)


def firmware(
    target: MotorTarget,
    pos: Pair,
    vel: Pair,
    *,
    vel_limit: float = math.inf,
    input_torque_max: float = math.inf,
) -> Pair:
    """Return the motors' torques by the firmware's law, as its documentation writes it, N m."""
    torques = []
    for i in (0, 1):
        wanted = target.vel_turns[i] + target.pos_gain[i] * (target.pos_turns[i] - pos[i])
        wanted = max(-vel_limit, min(vel_limit, wanted))
        torque = max(-input_torque_max, min(input_torque_max, target.torque[i]))
        torques.append(torque + target.vel_gain[i] * (wanted - vel[i]))
    return torques[0], torques[1]


class BenchJoint:
    """A joint that stays where it is put, and the drive that measures it, in virtual time."""

    law: JointController
    controller: ControllerState

    def __init__(self, robot: RobotConfig, status: DriveStatus) -> None:
        self.gear_ratio = robot.joint.gear_ratio
        self.cycle_ns = round(NS_PER_S / robot.joint_service.rate_hz)
        self.now_ns = T0
        self.q: Pair = (0.02, -1.0)
        self.v: Pair = (0.0, 0.0)
        self.status = status
        self.seq = 0

    @property
    def mode(self) -> Mode:
        """Return the mode the controller is in."""
        return self.controller.failsafe.mode

    def reading(self) -> DriveReading:
        """Return what the drive measures."""
        pos = motor_from_joint(self.q, self.gear_ratio)
        vel = motor_from_joint(self.v, self.gear_ratio)
        return DriveReading(self.now_ns, pos, vel, self.status, 0)

    def until(self, mode: Mode, cycle: Callable[[], T]) -> T | None:
        """Run cycles until it is in a mode, for ten seconds at most; return what the last gave."""
        last = None
        for _ in range(10 * NS_PER_S // self.cycle_ns):
            if self.mode is mode:
                break
            last = cycle()
        assert self.mode is mode
        return last


class Bench(BenchJoint):
    """One controller, cycled at its rate."""

    def __init__(self, robot: RobotConfig, module: str = "knee_right") -> None:
        super().__init__(robot, DriveStatus.ARMED)
        self.law = JointController(believing(robot), module)
        self.controller = self.law.start()

    @property
    def is_stiffened(self) -> bool:
        """Return True if the module says that it holds with all it has."""
        return self.law.state(self.controller, self.now_ns).stiffened

    def fresh(self, **changes: Any) -> JointCommand:
        """Return the next command, echoing the state of the cycle before."""
        self.seq += 1
        return command(**({"seq": self.seq, "echo_t_ns": self.now_ns} | changes))

    def cycle(
        self,
        sent: JointCommand | None = None,
        *,
        estop: bool = False,
        stalled: bool = False,
        after_ns: int = 0,
        near: NeighbourView = UNKNOWN,
    ) -> CycleResult:
        """Run the next cycle: a period, or `after_ns`, after the one before."""
        self.now_ns += after_ns or self.cycle_ns
        reading = None if stalled else self.reading()
        return self.law.step(self.controller, self.now_ns, reading, sent, estop, near=near)

    def run(self, cycles: int, *, fresh: bool = False, **changes: Any) -> list[CycleResult]:
        """Run cycles, with a fresh command in each or with none."""
        return [self.cycle(self.fresh(**changes) if fresh else None) for _ in range(cycles)]

    def move(self, q: Pair) -> None:
        """Move the joint as a joint may: 0.01 rad a cycle."""
        steps = math.ceil(max(abs(b - a) for a, b in zip(self.q, q, strict=True)) / 0.01)
        start = self.q
        for step in range(1, steps + 1):
            share = step / steps
            self.q = (start[0] + share * (q[0] - start[0]), start[1] + share * (q[1] - start[1]))
            self.cycle()

    def to_hold(self) -> None:
        """Arm the drive: HOLD at the measured pose."""
        self.cycle()
        assert self.mode is Mode.HOLD

    def to_track(self, **changes: Any) -> None:
        """Send fresh commands until TRACK has blended in fully."""
        self.to_hold()
        for _ in range(2000):
            self.cycle(self.fresh(**changes))
            if self.mode is Mode.TRACK:
                break
        assert self.mode is Mode.TRACK
        self.run(400, fresh=True, **changes)

    def to(self, mode: Mode) -> None:
        """Bring the controller into a mode by what includes it there on the robot."""
        if mode is Mode.DISARMED:
            self.status = DriveStatus.IDLE
            self.cycle()
        elif mode is Mode.HOLD:
            self.to_hold()
        else:
            self.to_track()
        if mode is Mode.DAMP:
            self.cycle(estop=True)
        if mode is Mode.FAULT:
            self.status = DriveStatus.LOST
            self.cycle()
        assert self.mode is mode


class ModuleBench(BenchJoint):
    """A module and its drive: the drive goes on with what it was told last, if it obeys."""

    def __init__(
        self,
        robot: RobotConfig,
        loop: LoopName = "onboard",
        module: str = "knee_right",
        *,
        last_state: LastState = LastState.NOTHING,
        status: DriveStatus = DriveStatus.IDLE,
        carries: Pair | None = None,
        obeys: bool = True,
    ) -> None:
        """Begin after a service that left `last_state`, with a drive that `carries` torques."""
        self.robot = with_service(robot, loop=loop)
        super().__init__(self.robot, status)
        self.module = DriveManager(self.robot, module, last_state)
        self.carries, self.obeys = carries, obeys
        self.error = AxisError.NONE
        self.zero: Pair | None = None
        """Where the drive answers that its encoders read 0."""
        self.target: MotorTarget | None = None
        self.torque: Pair = (0.0, 0.0)

    @property
    def law(self) -> JointController:  # type: ignore[override]
        """Return that of the module, which may be another one by now."""
        return self.module.controller

    @property
    def controller(self) -> ControllerState:  # type: ignore[override]
        """Return the state of the module's controller."""
        return self.module.state.controller

    def carried(self) -> Pair:
        """Return the joint torques that the drive gives now, N m, by the firmware's law."""
        motors = self.torque
        if self.target is not None:
            now = super().reading()
            motors = firmware(self.target, now.pos_turns, now.vel_turns)
        return joint_torque(motors, self.gear_ratio)

    def reading(self) -> DriveReading:
        """Return what the drive measures and tells."""
        return msgspec.structs.replace(
            super().reading(), error=int(self.error), torque=self.carries, encoder_zero=self.zero
        )

    def cycle(
        self,
        sent: JointCommand | None = None,
        *,
        estop: bool = False,
        silent: bool = False,
        near: NeighbourView = UNKNOWN,
    ) -> DriveAction:
        """Run a cycle, and have the drive do what it orders."""
        self.now_ns += self.cycle_ns
        step = self.module.step(self.now_ns, None if silent else self.reading(), sent, estop, near)
        if self.obeys and step.command is DriveCommand.ARM:
            self.status = DriveStatus.ARMED
        elif step.command is DriveCommand.TARGET:
            self.target = step.target
        elif step.command is DriveCommand.TORQUE:
            self.torque = step.torque
        return step

    def run(self, lasting_ns: int) -> list[DriveAction]:
        """Run cycles without commands."""
        return [self.cycle() for _ in range(lasting_ns // self.cycle_ns)]

    def lead(self, cycles: int = 1, **changes: Any) -> list[DriveAction]:
        """Run cycles, each with a usable command."""
        steps = []
        for _ in range(cycles):
            self.seq += 1
            steps.append(self.cycle(command(seq=self.seq, echo_t_ns=self.now_ns, **changes)))
        return steps

    def to(self, mode: Mode) -> None:
        """Bring the module into HOLD, TRACK or DAMP, settled there."""
        coupled = {"tau_coupled": (3.0, -4.0)}
        self.until(Mode.HOLD, self.cycle)
        if mode in (Mode.TRACK, Mode.DAMP):
            self.lead(2000, **coupled)
        if mode is Mode.DAMP:
            self.cycle(estop=True)
        for _ in range(40):
            self.lead(**coupled) if mode is Mode.TRACK else self.cycle()
        assert self.mode is mode

    def freeze(self, lasting_ns: int, q: Pair) -> None:
        """Run no cycle for a while; the joint then rests somewhere else."""
        self.now_ns += lasting_ns
        self.q, self.v = q, (0.0, 0.0)
