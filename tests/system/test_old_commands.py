"""Yesterday's commands on a real bus, and a real joint service that hears them."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from services.joint.differential import motor_from_joint
from services.joint.drive_manager import DriveManager
from services.joint.drivers.base import DriveReading, DriveStatus, MotorTarget
from services.joint.loop import JointLoop, JointPorts
from shared.bus import topics
from shared.bus.messages import Estop, JointCommand, JointEvent, JointState, Mode, Pair
from shared.bus.session import open_session
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import SESSION, command

pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

HOUR_NS = 3600 * NS_PER_S
WILD = {"q_ref": (0.3, -2.5), "k_p": (3000.0, 3000.0), "tau_ff": (50.0, -50.0)}


class StandingDrive:
    """A drive that is armed when told to, and stands."""

    def __init__(self, robot: RobotConfig, q: Pair) -> None:
        self._pos = motor_from_joint(q, robot.joint.gear_ratio)
        self._status = DriveStatus.IDLE
        self.targets: list[MotorTarget] = []

    def read(self, _timeout_s: float) -> DriveReading:
        time.sleep(0.002)
        return DriveReading(time.monotonic_ns(), self._pos, (0.0, 0.0), self._status, 0)

    def write(self, target: MotorTarget) -> None:
        self.targets.append(target)

    def write_torque(self, torque: Pair) -> None:
        raise AssertionError(torque)

    def arm(self, *, onboard: bool) -> None:
        assert onboard
        self._status = DriveStatus.ARMED

    def idle(self) -> None:
        self._status = DriveStatus.IDLE

    def set_position(self, turns: Pair) -> None:
        raise AssertionError(turns)

    def close(self) -> None:
        pass


class Serving:
    """A joint service on a real bus, in a thread."""

    def __init__(self, robot: RobotConfig, module: str, run_dir: Path) -> None:
        self._robot, self._module, self._run_dir = robot, module, run_dir
        self.drive = StandingDrive(robot, (0.0, -1.0))
        self._over, self._up = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Serving:
        self._thread.start()
        assert self._up.wait(30.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _serve(self) -> None:
        robot, module = self._robot, self._module
        with open_session(robot, module, self._run_dir) as session:
            ports = JointPorts(
                commands=session.latest(topics.JOINT_COMMAND, JointCommand, module),
                estops=session.latest(topics.ESTOP, Estop),
                states=session.publisher(topics.JOINT_STATE, JointState, module),
                events=session.publisher(topics.JOINT_EVENT, JointEvent, module),
                traces=session.publisher(topics.JOINT_TRACE, JointTrace, module),
            )
            loop = JointLoop(robot, DriveManager(robot, module), self.drive, ports)
            self._up.set()
            while not self._over.is_set():
                loop.cycle()


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as path:
        yield Path(path)


def test_a_live_joint_service_refuses_old_commands_and_takes_a_planners(
    robot: RobotConfig, run_dir: Path
) -> None:
    """The same publisher, the same commands but for the stamp that they echo."""
    module = "knee_left"
    with (
        Serving(believing(robot), module, run_dir) as service,
        open_session(robot, "planner", run_dir) as session,
    ):
        commands = session.publisher(topics.JOINT_COMMAND, JointCommand, module)
        states = session.latest(topics.JOINT_STATE, JointState, module)
        seq, deadline = 0, time.monotonic() + 30.0

        def put(age_ns: int, until: Mode, refused: int = 0) -> JointState:
            """Answer each state with a command, until the service has come so far."""
            nonlocal seq
            while time.monotonic() < deadline:
                state = states.take()
                if state is None:
                    time.sleep(0.001)
                    continue
                if state.mode == until and state.refused >= refused:
                    return state
                seq += 1
                commands.put(command(seq=seq, echo_t_ns=state.t_ns - age_ns, **WILD))
            raise AssertionError("in time")

        armed = put(HOUR_NS, until=Mode.HOLD)
        written = len(service.drive.targets)
        old = put(HOUR_NS, until=Mode.HOLD, refused=100)
        ahead = put(-HOUR_NS, until=Mode.HOLD, refused=old.refused + 100)
        assert old.tau == ahead.tau == armed.tau
        assert len(set(map(msgspec.json.encode, service.drive.targets[written:]))) == 1
        assert put(0, until=Mode.TRACK).session == SESSION
