"""Records of a robot on three hosts, in virtual time: clocks apart, messages late at random."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from shared.bus import topics
from shared.bus.codec import encode
from shared.bus.messages import JointState, Message
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.files import to_toml
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, side_of
from shared.mcap_log.writer import SCHEMA_VERSION, RunWriter
from tests.conftest import ROBOT_FILE
from tests.shared.mcap_log.runs import Queue, sample
from tools.sim.lockstep import NOTHING_HAPPENS, Lockstep
from tools.sim.virtual_services import HostClock
from tools.topic_keys import sender_of

BODY, RIGHT, LEFT = "10.0.0.1", "10.0.0.2", "10.0.0.3"
CLOCKS: Final = {
    BODY: HostClock(3 * 24 * 3600 * NS_PER_S),
    RIGHT: HostClock(-NS_PER_S // 2, 40.0),
    LEFT: HostClock(7_200 * NS_PER_S, -60.0),
}
"""Each against virtual time: started at another moment, and a little too fast or slow."""
HOST_OF: Final = {"planner": BODY, "harness": BODY, "imu": BODY, "recorder": BODY} | {
    module: RIGHT if side_of(module) == "right" else LEFT for module in MODULES
}

LEG: Final = ("ankle_left", "knee_left", "hip_left")

Sent = tuple[int, str, str, bytes]
"""Virtual time, sender, key, payload."""


def sent_by_all(robot: RobotConfig, seconds: float) -> list[Sent]:
    """Return all messages of a standing robot whose services read the clocks of their hosts."""
    sent: list[Sent] = []

    def put(topic: Topic, module: str, message: Message) -> None:
        key = topic.key(robot.name, module)
        sent.append((fleet.now_ns, sender_of(topic, module), key, encode(message)))

    scenario = msgspec.structs.replace(NOTHING_HAPPENS, duration=seconds)
    clocks = {name: CLOCKS[host] for name, host in HOST_OF.items()}
    fleet = Lockstep(robot, scenario, record=put, clocks=clocks, traced=True)
    for _ in fleet.run():
        pass
    return sent


def write_record(
    folder: Path,
    robot: RobotConfig,
    sent: Sequence[Sent],
    host: str,
    *,
    of: Sequence[str] = (),
    lost: Callable[[Sent], bool] = lambda _one: False,
    clock: HostClock | None = None,
) -> Path:
    """Write what a host's recorder gets by its clock, None: as in `CLOCKS`; `of` its services."""
    clock = clock or CLOCKS[host]
    dice = random.Random(5)
    newest: dict[str, int] = {}
    rows: list[tuple[str, bytes, int]] = []
    for one in sent:
        at_ns, sender, key, payload = one
        if (not of or sender in of) and not lost(one):
            # a link keeps the order of what passes it
            newest[key] = max(newest.get(key, 0), clock.read(at_ns) + dice.randrange(NS_PER_MS))
            rows.append((key, payload, newest[key]))
    rows.sort(key=lambda row: row[2])
    robot_file, offset_ns = to_toml(on_three_hosts(robot)), 1_700_000_000 * NS_PER_S
    with writer_of(folder, robot, robot_file.encode(), offset_ns - clock.offset_ns, of) as writer:
        writer.take_from(Queue(rows), len(rows))
    return writer.path


def writer_of(
    folder: Path, robot: RobotConfig, robot_file: bytes, offset_ns: int = 0, of: Sequence[str] = ()
) -> RunWriter:
    """Return what writes a record with a robot file in it; `of`: of these services alone."""
    about = {"schema_version": SCHEMA_VERSION, "robot": robot.name, "of": ",".join(of)}
    gains = ROBOT_FILE.with_name("robot.gains.json").read_bytes()
    return RunWriter(
        folder,
        topics.all_keys(robot.name),
        offset_ns=offset_ns,
        metadata={"run": about},
        attachments={"robot.toml": robot_file, "robot.gains.json": gains},
        chunk_kib=256,
    )


def on_three_hosts(robot: RobotConfig) -> RobotConfig:
    """Return the robot with its services' endpoints at their hosts."""
    ports = {name: f"tls/{host}:{7447 + n}" for n, (name, host) in enumerate(HOST_OF.items())}
    bus = msgspec.structs.replace(
        robot.bus,
        endpoints={**robot.bus.endpoints, "simulator": "tls/127.0.0.1:7446", **ports},
        security=msgspec.structs.replace(robot.bus.security, mode="mtls"),
    )
    return msgspec.structs.replace(robot, bus=bus)


def states(
    module: str, clock: HostClock, begin_s: float, end_s: float, *, hz: float = 10.0, first: int = 0
) -> list[Sent]:
    """Return states of a module alone, stamped by a clock."""
    key = topics.JOINT_STATE.key("xrl", module)
    found: list[Sent] = []
    for n in range(round((end_s - begin_s) * hz)):
        at_ns = round((begin_s + n / hz) * NS_PER_S)
        state = sample(JointState, t_ns=clock.read(at_ns), seq=first + n)
        found.append((at_ns, module, key, encode(state)))
    return found


def kept_up(seconds: float) -> list[Sent]:
    """Return what the body says all the time: there is something in every part of the record."""
    return states("knee_right", CLOCKS[RIGHT], 0.0, seconds, hz=2.0)
