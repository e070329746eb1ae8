"""Listening to a bus: what is taken in, and what is asked."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.simulator.unix_can_hub import UnixCanHub
from shared.can import cansimple, imu_can, loadcell_can
from shared.can.cansimple import AxisState, Command, Heartbeat, arbitration_id
from shared.can.cansimple_06 import Command06, Version, pack_version
from shared.can.unix_can import REMOTE_FLAG
from shared.config.sections import CanConfig
from tools.bringup.can_monitor import listen

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
    assert traffic.samples[0] == (1.0, 2.0, 3.0, 4.0, 5.0, -6.0)
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
    assert traffic.attitudes[0].rate == (0.0, 0.5, 0.0)
    assert traffic.attitudes[0].valid
    assert len(traffic.attitudes) == len(traffic.attitudes_s) > 3
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
