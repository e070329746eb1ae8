"""Listening to a bus: what is taken in, and what is asked."""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.can import cansimple, imu_can, loadcell_can
from shared.can.cansimple import AxisState, Command, Heartbeat, arbitration_id
from shared.can.cansimple_06 import Command06, Version, pack_version
from shared.can.unix_can import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Frame
from shared.config.sections import CanConfig
from tools.bringup import can_monitor
from tools.bringup.can_monitor import listen, round_trips

NODE = 8
STRANGER = 30
IDLE = Heartbeat(0, AxisState.IDLE, False, False, False, True)


class Bus:
    """A bus on which one axis, a stranger and the load cells speak."""

    def __init__(self, path: Path) -> None:
        self.config = CanConfig(interface="xrl_unix", channel=str(path))
        self.asked: list[int] = []
        self._hub = UnixCanHub(path)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._hub.close()

    def _run(self) -> None:
        heartbeat = cansimple.pack_heartbeat(IDLE)
        frames = [
            (arbitration_id(NODE, Command.HEARTBEAT), heartbeat),
            (arbitration_id(STRANGER, Command.HEARTBEAT), heartbeat),
            (
                arbitration_id(NODE, Command.GET_ENCODER_ESTIMATES),
                cansimple.pack_two_floats(64.5, 0.0),
            ),
            *loadcell_can.pack([1.0, 2.0, 3.0, 4.0, 5.0, -6.0]),
        ]
        while not self._stop.is_set():
            for can_id, _data in self._hub.poll():
                self.asked.append(can_id)
                node, command = cansimple.split_id(can_id & ~REMOTE_FLAG)
                if command == Command.GET_VBUS:
                    answer = cansimple.pack_two_floats(47.5, 0.1)
                    self._hub.broadcast([(arbitration_id(node, command), answer)])
                elif command == Command06.GET_VERSION:
                    answer = pack_version(Version(2, (4, 4, 58), (0, 6, 10), 0))
                    self._hub.broadcast([(arbitration_id(node, command), answer)])
            self._hub.broadcast(frames)
            time.sleep(0.002)


@pytest.fixture
def bus() -> Iterator[Bus]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as folder:
        bus = Bus(Path(folder) / "can.sock")
        yield bus
        bus.close()


def test_heartbeats_estimates_and_load_cells_are_taken_in(bus: Bus) -> None:
    traffic = listen(bus.config, (NODE,), poll_nodes=False, cells=True)
    axis = traffic.nodes[NODE]
    assert traffic.trouble == ""
    assert axis.heartbeat == IDLE
    assert axis.pos_turns == 64.5
    assert len(axis.heartbeats_s) > 3
    assert traffic.cells.samples[0] == (1.0, 2.0, 3.0, 4.0, 5.0, -6.0)
    assert traffic.malformed == 0
    assert sorted(traffic.nodes) == [NODE, STRANGER], "load cells are no nodes"


def test_an_imu_is_received_where_there_is_one(tmp_path: Path) -> None:
    frames = imu_can.pack([1.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0], valid=True)
    config = CanConfig(interface="xrl_unix", channel=str(tmp_path / "can.sock"))
    done = threading.Event()
    with UnixCanHub(tmp_path / "can.sock") as hub:

        def speak() -> None:
            while not done.is_set():
                hub.poll()
                hub.broadcast(frames)
                time.sleep(0.002)

        speaker = threading.Thread(target=speak)
        speaker.start()
        traffic = listen(config, (), poll_nodes=False, imu=True)
        done.set()
        speaker.join()
    assert traffic.imu.samples[0].rate == (0.0, 0.5, 0.0)
    assert traffic.imu.samples[0].valid
    assert len(traffic.imu.samples) == len(traffic.imu.times_s) > 3
    assert traffic.nodes == {}, "its frames are no nodes"


def test_nothing_is_sent_where_nothing_is_to_be_asked(bus: Bus) -> None:
    traffic = listen(bus.config, (NODE,), poll_nodes=False)
    assert bus.asked == [], "any frame feeds a watchdog"
    assert traffic.nodes[NODE].vbus_voltage is None


def test_version_and_supply_are_asked_for_by_requests_without_data(bus: Bus) -> None:
    traffic = listen(bus.config, (NODE,), poll_nodes=True)
    assert all(can_id & REMOTE_FLAG for can_id in bus.asked)
    assert traffic.nodes[NODE].vbus_voltage == 47.5
    version = traffic.nodes[NODE].version
    assert version is not None
    assert version.firmware == (0, 6, 10)


def test_a_missing_bus_is_reported_and_not_raised(tmp_path: Path) -> None:
    nowhere = CanConfig(interface="xrl_unix", channel=str(tmp_path / "no.sock"))
    assert "no.sock" in listen(nowhere, (NODE,), poll_nodes=True).trouble
    unknown = CanConfig(interface="carrier_pigeon", channel="0")
    assert "carrier_pigeon" in listen(unknown, (NODE,), poll_nodes=True).trouble


ASKED = arbitration_id(NODE, Command.GET_VBUS)
ANSWER = cansimple.pack_two_floats(47.5, 0.1)


@contextlib.contextmanager
def answering(folder: Path, *frames: Frame) -> Iterator[CanConfig]:
    """Have a bus on which each request is answered by some frames."""
    done = threading.Event()
    path = folder / "can.sock"
    with UnixCanHub(path) as hub:

        def speak() -> None:
            while not done.is_set():
                for _ in hub.poll():
                    hub.broadcast(frames)
                time.sleep(0.001)

        speaker = threading.Thread(target=speak)
        speaker.start()
        try:
            yield CanConfig(interface="xrl_unix", channel=str(path))
        finally:
            done.set()
            speaker.join()


@pytest.mark.parametrize(
    "frame",
    [
        (ASKED | EXTENDED_FLAG, ANSWER),
        (ASKED | ERROR_FLAG, ANSWER),
        (ASKED | REMOTE_FLAG, ANSWER),
        (ASKED, ANSWER[:4]),
        (arbitration_id(NODE + 1, Command.GET_VBUS), ANSWER),
        (arbitration_id(NODE, Command.GET_IQ), ANSWER),
    ],
    ids=["extended", "error", "a request, or its echo", "short", "of another", "to another"],
)
def test_only_the_axis_that_was_asked_answers(tmp_path: Path, frame: Frame) -> None:
    with answering(tmp_path, frame) as config:
        trips = round_trips(config, (NODE,), 3)[NODE]
    assert trips.lost == 3
    with answering(tmp_path, frame, (ASKED, ANSWER)) as config:
        assert round_trips(config, (NODE,), 3)[NODE].lost == 0


class Twice:
    """A bus on which the first request is answered twice, and no other one."""

    def __init__(self) -> None:
        self.waiting = [can.Message(arbitration_id=ASKED, data=ANSWER, is_extended_id=False)] * 2
        self.sent = 0

    def send(self, *_: object, **__: object) -> None:
        self.sent += 1

    def recv(self, _timeout: float) -> can.Message | None:
        return self.waiting.pop() if self.sent and self.waiting else None


def test_an_answer_that_comes_late_is_none_to_the_next_request() -> None:
    bus = Twice()
    took = [can_monitor._asked(bus, NODE) for _ in range(2)]  # type: ignore[arg-type]
    assert took[0] is not None
    assert took[1] is None
