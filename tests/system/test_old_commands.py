"""Yesterday's commands on a real bus, and a real joint service that hears them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from services.joint.drive_manager import DriveManager
from services.joint.drivers.base import DriveReading
from services.joint.loop import JointLoop, JointPorts
from shared.bus import topics
from shared.bus.messages import Estop, JointCommand, JointEvent, JointState, Mode
from shared.bus.session import open_session
from shared.bus.traces import JointTrace
from shared.clock import NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import SESSION, command
from tests.joint.test_loop import FakeDrive

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(60)]

HOUR_NS = 3600 * NS_PER_S
WILD = {"q_ref": (0.3, -2.5), "k_p": (3000.0, 3000.0), "tau_ff": (50.0, -50.0)}


class StandingDrive(FakeDrive):
    """Stands, and answers at 500 Hz of the real clock."""

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__(SimpleNamespace(gear_ratio=robot.joint.gear_ratio, onboard=True))

    def read(self, timeout_s: float) -> DriveReading | None:
        time.sleep(0.002)
        self.rig.now_ns = time.monotonic_ns()
        return super().read(timeout_s)


@contextmanager
def serving(robot: RobotConfig, module: str, run_dir: Path) -> Iterator[StandingDrive]:
    """Run a joint service on a real bus, in a thread."""
    drive, over, up = StandingDrive(robot), threading.Event(), threading.Event()

    def serve() -> None:
        with open_session(robot, module, run_dir) as session:
            ports = JointPorts(
                commands=session.latest(topics.JOINT_COMMAND, JointCommand, module),
                estops=session.latest(topics.ESTOP, Estop),
                states=session.publisher(topics.JOINT_STATE, JointState, module),
                events=session.publisher(topics.JOINT_EVENT, JointEvent, module),
                traces=session.publisher(topics.JOINT_TRACE, JointTrace, module),
            )
            loop = JointLoop(robot, DriveManager(robot, module), drive, ports)
            up.set()
            while not over.is_set():
                loop.cycle()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert up.wait(30.0)
        yield drive
    finally:
        over.set()
        thread.join()


def test_a_live_joint_service_refuses_old_commands_and_takes_a_planners(
    robot: RobotConfig, run_dir: Path
) -> None:
    """The same publisher, the same commands but for the stamp that they echo."""
    module = "knee_left"
    run_dir.mkdir()
    with (
        serving(believing(robot), module, run_dir) as drive,
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
        written = len(drive.targets)
        old = put(HOUR_NS, until=Mode.HOLD, refused=100)
        ahead = put(-HOUR_NS, until=Mode.HOLD, refused=old.refused + 100)
        assert old.tau == ahead.tau == armed.tau
        assert len(set(map(msgspec.json.encode, drive.targets[written:]))) == 1
        assert put(0, until=Mode.TRACK).session == SESSION
        assert drive.torques == drive.told == []
