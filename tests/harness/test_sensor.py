from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from services.harness.sensor import CanHarnessSensor
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.can import loadcell_can
from shared.can.can_sensor import DRAIN_MAX, RETRY_NS
from shared.clock import NS_PER_MS, NS_PER_S
from shared.exceptions import ConfigError
from tests.harness.helpers import PERIOD_NS, CanHub

PAUSE_NS = 20 * NS_PER_MS
T0 = 5 * NS_PER_S
ONE = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
TWO = (7.0, 8.0, 9.0, 10.0, 11.0, 12.0)


@pytest.fixture
def link(request: pytest.FixtureRequest) -> Iterator[tuple[CanHarnessSensor, CanHub, can.BusABC]]:
    """A sensor on python-can's virtual bus, and the amplifier's side of it."""
    channel = request.node.name
    sensor = CanHarnessSensor("virtual", channel, pause_ns=PAUSE_NS)
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as amplifier:
        assert sensor.read(T0) is None
        yield sensor, CanHub(amplifier), amplifier
        sensor.close()


@pytest.fixture
def socket_path() -> Iterator[Path]:
    directory = tempfile.mkdtemp(dir="/tmp")
    yield Path(directory) / "can.sock"
    shutil.rmtree(directory)


Link = tuple[CanHarnessSensor, CanHub, can.BusABC]


def test_the_newest_of_the_waiting_samples_is_returned_and_only_once(link: Link) -> None:
    sensor, hub, _ = link
    hub.send_forces(ONE)
    hub.send_forces(TWO)
    sample = sensor.read(T0 + PERIOD_NS)
    assert sample is not None
    assert (sample.forces, sample.t_ns) == (TWO, T0 + PERIOD_NS)
    assert sensor.read(T0 + 2 * PERIOD_NS) is None


def test_a_sample_whose_frames_come_in_two_reads_is_put_together(link: Link) -> None:
    sensor, hub, _ = link
    frames = loadcell_can.pack(ONE)
    hub.broadcast(frames[:2])
    assert sensor.read(T0 + PERIOD_NS) is None
    hub.broadcast(frames[2:])
    sample = sensor.read(T0 + 2 * PERIOD_NS)
    assert sample is not None
    assert sample.forces == ONE


@pytest.mark.parametrize("kind", ["is_extended_id", "is_remote_frame", "is_error_frame"])
def test_frames_that_are_no_data_frames_are_ignored(link: Link, kind: str) -> None:
    sensor, hub, amplifier = link
    flags = {"is_extended_id": False, kind: True}
    data = None if kind == "is_remote_frame" else bytes(8)
    amplifier.send(can.Message(arbitration_id=0x300, data=data, **flags))
    hub.send_forces(ONE)
    sample = sensor.read(T0 + PERIOD_NS)
    assert sample is not None
    assert sample.forces == ONE
    assert sensor.malformed == 0


@pytest.mark.parametrize(("gap_ns", "used"), [(PAUSE_NS, True), (PAUSE_NS + 1, False)])
def test_what_waited_during_a_pause_of_this_process_is_thrown_away(
    link: Link, gap_ns: int, used: bool
) -> None:
    sensor, hub, _ = link
    hub.send_forces(ONE)
    assert (sensor.read(T0 + gap_ns) is not None) is used
    assert sensor.discarded == (not used)
    hub.send_forces(TWO)
    sample = sensor.read(T0 + gap_ns + PERIOD_NS)
    assert sample is not None
    assert sample.forces == TWO


def test_a_queue_too_long_for_one_read_is_thrown_away_whole(link: Link) -> None:
    sensor, hub, _ = link
    for _ in range(DRAIN_MAX // 3 + 10):
        hub.send_forces(ONE)
    assert sensor.read(T0 + PERIOD_NS) is None
    assert sensor.read(T0 + 2 * PERIOD_NS) is None
    assert sensor.discarded == 2
    hub.send_forces(TWO)
    sample = sensor.read(T0 + 3 * PERIOD_NS)
    assert sample is not None
    assert sample.forces == TWO


def test_a_link_that_goes_away_comes_back_by_itself(socket_path: Path) -> None:
    sensor = CanHarnessSensor("xrl_unix", str(socket_path), pause_ns=PAUSE_NS)
    now_ns = T0
    assert sensor.read(now_ns) is None
    assert not sensor.connected
    for times in (1, 2):
        with UnixCanHub(socket_path) as hub:
            now_ns += RETRY_NS
            assert sensor.read(now_ns) is None
            assert sensor.connected
            assert sensor.opened == times
            hub.poll()
            hub.broadcast(loadcell_can.pack(ONE))
            now_ns += PERIOD_NS
            sample = sensor.read(now_ns)
            assert sample is not None
            assert sample.forces == ONE
        now_ns += PERIOD_NS
        assert sensor.read(now_ns) is None
        assert not sensor.connected
    sensor.close()


def test_the_link_is_not_tried_more_often_than_every_fifth_of_a_second(
    socket_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[int] = []
    now_ns = T0
    real = can.Bus

    def counted(*args: object, **kwargs: object) -> can.BusABC:
        tries.append(now_ns)
        return real(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(can, "Bus", counted)
    sensor = CanHarnessSensor("xrl_unix", str(socket_path), pause_ns=PAUSE_NS)
    for _ in range(500):
        assert sensor.read(now_ns) is None
        now_ns += PERIOD_NS
    assert tries == list(range(T0, T0 + 500 * PERIOD_NS, RETRY_NS))


def test_a_partial_sample_does_not_outlive_its_link(socket_path: Path) -> None:
    first, second, third = loadcell_can.pack(ONE)
    sensor = CanHarnessSensor("xrl_unix", str(socket_path), pause_ns=PAUSE_NS)
    with UnixCanHub(socket_path) as hub:
        sensor.read(T0)
        hub.poll()
        hub.broadcast([first, second])
        assert sensor.read(T0 + 1) is None
    for now_ns in range(T0 + PERIOD_NS, T0 + RETRY_NS, PERIOD_NS):
        assert sensor.read(now_ns) is None
    with UnixCanHub(socket_path) as hub:
        sensor.read(T0 + RETRY_NS)
        assert sensor.connected
        hub.poll()
        hub.broadcast([third])
        assert sensor.read(T0 + RETRY_NS + 1) is None
        assert sensor.malformed == 1
        assert sensor.discarded == 0, "no pause of the process is what threw it away"
        sensor.close()


def test_an_unknown_interface_is_refused_at_the_start() -> None:
    with pytest.raises(ConfigError, match=r"'no_such_bus': not known.*socketcan"):
        CanHarnessSensor("no_such_bus", "can0", pause_ns=PAUSE_NS)
