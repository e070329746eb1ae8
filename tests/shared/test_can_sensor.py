"""A sensor on a CAN bus: its newest sample, whatever becomes of the link and of this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import can
import pytest

from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus.messages import Vector6
from shared.can import loadcell_can
from shared.can.can_sensor import DRAIN_MAX, RETRY_NS, CanSensor
from shared.can.loadcell_can import SampleAssembler
from shared.clock import NS_PER_MS, NS_PER_S
from shared.exceptions import ConfigError

PAUSE_NS, PERIOD_NS, T0 = 20 * NS_PER_MS, 4 * NS_PER_MS, 5 * NS_PER_S
ONE = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
TWO = (7.0, 8.0, 9.0, 10.0, 11.0, 12.0)


def sensor_on(interface: str, channel: str) -> CanSensor[Vector6]:
    return CanSensor(interface, channel, SampleAssembler(), pause_ns=PAUSE_NS)


class Link(NamedTuple):
    """A sensor on python-can's virtual bus, and the amplifier's side of it."""

    sensor: CanSensor[Vector6]
    amplifier: can.BusABC

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        for can_id, data in frames:
            frame = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
            self.amplifier.send(frame)

    def send_forces(self, *samples: Vector6) -> None:
        for forces in samples:
            self.send(loadcell_can.pack(forces))


@pytest.fixture
def link(request: pytest.FixtureRequest) -> Iterator[Link]:
    channel = request.node.name
    sensor = sensor_on("virtual", channel)
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as amplifier:
        assert sensor.newest(T0) is None
        yield Link(sensor, amplifier)
        sensor.close()


@pytest.fixture
def path(short_dir: Path) -> Path:
    return short_dir / "can.sock"


def test_the_newest_of_the_waiting_samples_is_returned_and_only_once(link: Link) -> None:
    link.send_forces(ONE, TWO)
    assert link.sensor.newest(T0 + PERIOD_NS) == TWO
    assert link.sensor.newest(T0 + 2 * PERIOD_NS) is None


def test_a_sample_whose_frames_come_in_two_reads_is_put_together(link: Link) -> None:
    frames = loadcell_can.pack(ONE)
    link.send(frames[:2])
    assert link.sensor.newest(T0 + PERIOD_NS) is None
    link.send(frames[2:])
    assert link.sensor.newest(T0 + 2 * PERIOD_NS) == ONE


@pytest.mark.parametrize("kind", ["is_extended_id", "is_remote_frame", "is_error_frame"])
def test_frames_that_are_no_data_frames_are_ignored(link: Link, kind: str) -> None:
    flags = {"is_extended_id": False, kind: True}
    data = None if kind == "is_remote_frame" else bytes(8)
    link.amplifier.send(can.Message(arbitration_id=0x300, data=data, **flags))
    link.send_forces(ONE)
    assert link.sensor.newest(T0 + PERIOD_NS) == ONE
    assert link.sensor.malformed == 0


@pytest.mark.parametrize(("gap_ns", "used"), [(PAUSE_NS, True), (PAUSE_NS + 1, False)])
def test_what_waited_during_a_pause_of_this_process_is_thrown_away(
    link: Link, gap_ns: int, used: bool
) -> None:
    link.send_forces(ONE)
    assert link.sensor.newest(T0 + gap_ns) == (ONE if used else None)
    assert link.sensor.discarded == (not used)
    link.send_forces(TWO)
    assert link.sensor.newest(T0 + gap_ns + PERIOD_NS) == TWO


def test_a_queue_too_long_for_one_read_is_thrown_away_whole(link: Link) -> None:
    link.send_forces(*[ONE] * (DRAIN_MAX // 3 + 10))
    assert [link.sensor.newest(T0 + n * PERIOD_NS) for n in (1, 2)] == [None, None]
    assert link.sensor.discarded == 2
    link.send_forces(TWO)
    assert link.sensor.newest(T0 + 3 * PERIOD_NS) == TWO


def test_a_link_that_goes_away_comes_back_by_itself(path: Path) -> None:
    sensor, now_ns = sensor_on("xrl_unix", str(path)), T0
    assert sensor.newest(now_ns) is None
    assert not sensor.connected
    for times in (1, 2):
        with UnixCanHub(path) as hub:
            now_ns += RETRY_NS
            assert sensor.newest(now_ns) is None
            assert (sensor.connected, sensor.opened) == (True, times)
            hub.poll()
            hub.broadcast(loadcell_can.pack(ONE))
            now_ns += PERIOD_NS
            assert sensor.newest(now_ns) == ONE
        now_ns += PERIOD_NS
        assert sensor.newest(now_ns) is None
        assert not sensor.connected
    sensor.close()


def test_the_link_is_not_tried_more_often_than_every_fifth_of_a_second(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[int] = []
    now_ns, real = T0, can.Bus

    def counted(*args: object, **kwargs: object) -> can.BusABC:
        tries.append(now_ns)
        return real(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(can, "Bus", counted)
    sensor = sensor_on("xrl_unix", str(path))
    for _ in range(500):
        assert sensor.newest(now_ns) is None
        now_ns += PERIOD_NS
    assert tries == list(range(T0, T0 + 500 * PERIOD_NS, RETRY_NS))


def test_a_partial_sample_does_not_outlive_its_link(path: Path) -> None:
    frames, sensor = loadcell_can.pack(ONE), sensor_on("xrl_unix", str(path))
    with UnixCanHub(path) as hub:
        sensor.newest(T0)
        hub.poll()
        hub.broadcast(frames[:2])
        assert sensor.newest(T0 + 1) is None
    for now_ns in range(T0 + PERIOD_NS, T0 + RETRY_NS, PERIOD_NS):
        assert sensor.newest(now_ns) is None
    with UnixCanHub(path) as hub:
        sensor.newest(T0 + RETRY_NS)
        assert sensor.connected
        hub.poll()
        hub.broadcast(frames[2:])
        assert sensor.newest(T0 + RETRY_NS + 1) is None
        assert sensor.malformed == 1
        assert sensor.discarded == 0, "no pause of the process is what threw it away"
        sensor.close()


def test_an_unknown_interface_is_refused_at_the_start() -> None:
    with pytest.raises(ConfigError, match=r"'no_such_bus': not known.*socketcan"):
        sensor_on("no_such_bus", "can0")
