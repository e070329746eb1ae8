"""Listening to a bus: what is taken in, and what is asked."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import can
import pytest

from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.can import cansimple
from shared.can.cansimple import AxisState, Command, Heartbeat, arbitration_id
from shared.can.cansimple_06 import Command06, Version, pack_version
from shared.can.sensor_frames import pack_forces, pack_imu
from shared.can.unix_can import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Frame
from shared.clock import PACE_FILE, keep_pace
from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from shared.run_directory import make_live_dir
from tests.imu.robots import with_imu
from tools.bringup import can_monitor
from tools.bringup.can_monitor import bus_nodes, listen, listen_to, long_enough, period_ms

NODE, STRANGER = 8, 30
IDLE = Heartbeat(0, AxisState.IDLE, False, False, False, True)
BEAT = cansimple.pack_heartbeat(IDLE)
ASKED = arbitration_id(NODE, Command.GET_VBUS)
ANSWER = cansimple.pack_two_floats(47.5, 0.1)
VERSION = pack_version(Version(2, (4, 4, 58), (0, 6, 10), 0))
SPOKEN: tuple[Frame, ...] = (
    (arbitration_id(NODE, Command.HEARTBEAT), BEAT),
    (arbitration_id(STRANGER, Command.HEARTBEAT), BEAT),
    (arbitration_id(NODE, Command.GET_ENCODER_ESTIMATES), cansimple.pack_two_floats(64.5, 0.0)),
    *pack_forces([1.0, 2.0, 3.0, 4.0, 5.0, -6.0]),
)
"""An axis, a stranger and the load cells."""
ANSWERS: tuple[Frame, ...] = (
    (ASKED, ANSWER), (arbitration_id(NODE, Command06.GET_VERSION), VERSION)
)  # fmt: skip


@contextlib.contextmanager
def bus(
    folder: Path, spoken: tuple[Frame, ...] = (), answers: tuple[Frame, ...] = ()
) -> Iterator[tuple[CanConfig, list[int]]]:
    """Have a bus that says some frames again and again, and others to each request; and those."""
    done, path, asked = threading.Event(), folder / "can.sock", list[int]()
    with UnixCanHub(path) as hub:

        def speak() -> None:
            while not done.is_set():
                for can_id, _data in hub.poll():
                    asked.append(can_id)
                    hub.broadcast(answers or spoken)
                if spoken:  # a frame without any would end the link
                    hub.broadcast(spoken)
                time.sleep(0.001)

        speaker = threading.Thread(target=speak)
        speaker.start()
        try:
            yield CanConfig(interface="xrl_unix", channel=str(path)), asked
        finally:
            done.set()
            speaker.join()


def test_all_that_speaks_is_taken_in_and_nothing_is_sent(short_dir: Path) -> None:
    with bus(short_dir, SPOKEN, ANSWERS) as (config, asked):
        traffic = listen(config, (NODE,), poll_nodes=False, cells=True)
    axis = traffic.nodes[NODE]
    assert traffic.trouble == ""
    assert (axis.heartbeat, axis.pos_turns) == (IDLE, 64.5)
    assert len(axis.heartbeats_s) > 3
    assert traffic.cells.samples[0] == (1.0, 2.0, 3.0, 4.0, 5.0, -6.0)
    assert traffic.malformed == 0
    assert sorted(traffic.nodes) == [NODE, STRANGER], "load cells are no nodes"
    assert asked == [], "any frame feeds a watchdog"
    assert axis.vbus_voltage is None


def test_an_imu_is_received_where_there_is_one(short_dir: Path) -> None:
    frames = tuple(pack_imu([1.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0], valid=True))
    with bus(short_dir, frames) as (config, _):
        traffic = listen(config, (), poll_nodes=False, imu=True)
    assert traffic.imu.samples[0].rate == (0.0, 0.5, 0.0)
    assert traffic.imu.samples[0].valid
    assert len(traffic.imu.samples) == len(traffic.imu.times_s) > 3
    assert traffic.nodes == {}, "its frames are no nodes"


def test_beside_a_fleet_in_slow_motion_no_frame_is_late(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`xrl doctor` gave 25 warnings at half speed, and advised to configure the drives anew."""
    (make_live_dir(tmp_path) / PACE_FILE).write_text("0.5\n")
    name, nodes = next((name, nodes) for name, nodes in bus_nodes(robot).items() if nodes)
    beat_id = arbitration_id(nodes[0], Command.HEARTBEAT)
    stamps = itertools.count(100.0, 0.04)
    slow = SimpleNamespace(
        recv=lambda _: can.Message(next(stamps), beat_id, is_extended_id=False, data=BEAT)
    )
    monkeypatch.setattr(can_monitor, "_bus", lambda _: contextlib.nullcontext(slow))
    try:
        traffic = listen_to(robot, name, tmp_path, poll_nodes=False, seconds=0.02)
    finally:
        keep_pace(tmp_path / "none")
    assert period_ms(traffic.nodes[nodes[0]].heartbeats_s, 20.0) == pytest.approx(20.0)
    assert traffic.seconds == pytest.approx(0.02, rel=0.5)


def test_version_and_supply_are_asked_for_by_requests_without_data(short_dir: Path) -> None:
    with bus(short_dir, SPOKEN, ANSWERS) as (config, asked):
        axis = listen(config, (NODE,), poll_nodes=True).nodes[NODE]
    assert asked
    assert all(can_id & REMOTE_FLAG for can_id in asked)
    assert axis.vbus_voltage == 47.5
    assert axis.version is not None
    assert axis.version.firmware == (0, 6, 10)


@pytest.mark.parametrize(
    ("interface", "channel"), [("xrl_unix", "/no.sock"), ("carrier_pigeon", "0")]
)
def test_a_missing_bus_is_reported_and_not_raised(interface: str, channel: str) -> None:
    nowhere = CanConfig(interface=interface, channel=channel)
    word = channel if interface == "xrl_unix" else interface
    assert word in listen(nowhere, (NODE,), poll_nodes=True).trouble


@pytest.mark.parametrize(
    "frame",
    [
        (ASKED | EXTENDED_FLAG, ANSWER), (ASKED | ERROR_FLAG, ANSWER),
        (ASKED | REMOTE_FLAG, ANSWER), (ASKED, ANSWER[:4]),
        (arbitration_id(NODE + 1, Command.GET_VBUS), ANSWER),
        (arbitration_id(NODE, Command.GET_IQ), ANSWER),
    ],
    ids=["extended", "error", "a request, or its echo", "short", "of another", "to another"],
)  # fmt: skip
def test_only_a_whole_answer_of_the_axis_that_was_asked_counts(
    short_dir: Path, frame: Frame
) -> None:
    with bus(short_dir, answers=(frame,)) as (config, _):
        assert listen(config, (NODE,), poll_nodes=True).nodes[NODE].vbus_voltage is None


def test_the_period_stands_a_reader_that_stalls_and_a_sender_that_catches_up() -> None:
    stalled = [0.002 * i + (0.3 if i > 20 else 0.0) for i in range(40)]
    assert period_ms(stalled, 2.0) == pytest.approx(2.0)
    bursts = [0.002 * i if i % 2 else 0.002 * (i - 1) + 0.0001 for i in range(40)]
    assert period_ms(bursts, 2.0) == pytest.approx(2.0, rel=0.1)
    slow = [0.01 * i for i in range(40)]
    assert period_ms(slow, 2.0) == pytest.approx(10.0), "another period is what it is"
    assert period_ms(slow[:3], 2.0) is None


def test_every_bus_is_listened_to_for_some_heartbeats_but_not_for_ever(robot: RobotConfig) -> None:
    listened = [long_enough(period) for period in (20, 500, 10_000)]
    assert listened == pytest.approx([0.5, 1.5, 3.0])
    nodes = bus_nodes(robot)
    assert sorted(nodes) == sorted(robot.buses)
    assert nodes["knee_left"] == (8, 9)
    assert nodes[robot.harness.bus] == ()
    assert "imu" not in nodes
    assert bus_nodes(with_imu(robot))["imu"] == ()
