"""A sensor on a CAN bus: its frames, its newest sample, and its service."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus.messages import Vector6
from shared.can.can_sensor import DRAIN_MAX, RETRY_NS, CanSensor
from shared.can.sensor_frames import (
    IMU_IDS,
    LOADCELL_IDS,
    FrameGroup,
    ImuAssembler,
    ImuSample,
    SampleAssembler,
    as_sent,
    pack_forces,
    pack_imu,
)
from shared.can.sensor_service import next_deadline
from shared.clock import NS_PER_MS, NS_PER_S

Frames = list[tuple[int, bytes]]
ONE = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
TWO = (-1.0, -2.0, -3.0, -4.0, -5.0, -6.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
part, float32 = st.floats(-1.0, 1.0), st.floats(width=32, allow_nan=False)


class Kind(NamedTuple):
    """A sensor, and two samples of it that survive their frames."""

    assembler: Callable[[], FrameGroup[Any]]
    one: Frames
    two: Frames
    lost_unseen: tuple[tuple[int, ...], ...] = ()
    """Losses of frames that leave a sample's frames in order; the docs name them."""

    def samples(self) -> list[Any]:
        return [added(self.assembler(), frames)[-1] for frames in (self.one, self.two)]


KINDS = {
    "load cells": Kind(SampleAssembler, pack_forces(ONE), pack_forces(TWO), ((1, 2, 3), (2, 3, 4))),
    "IMU": Kind(
        ImuAssembler,
        pack_imu((0.5, 0.5, 0.5, 0.5), (1.0, 2.0, 3.0), valid=True),
        pack_imu((0.5, -0.5, 0.5, -0.5), (3.0, 2.0, 1.0), valid=False),
        ((1, 2, 3), (2, 3, 4)),
    ),
}
each_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def added(assembler: FrameGroup[Any], frames: Frames) -> list[Any]:
    return [assembler.add(*frame) for frame in frames]


def test_the_layouts_are_those_of_the_protocols() -> None:
    """By hand: two little-endian float32 a frame; w = 1 clips to 0x7FFF, 1 rad/s is 0x0200."""
    assert KINDS["load cells"].one == [
        (can_id, struct.pack("<ff", *ONE[2 * n : 2 * n + 2]))
        for n, can_id in enumerate((0x300, 0x301, 0x302))
    ]
    assert pack_imu(LEVEL, (1.0, 0.0, -1.0), valid=True) == [
        (0x11, bytes.fromhex("00000003")),
        (0x21, bytes.fromhex("7FFF000000000000")),
        (0x32, bytes.fromhex("02000000FE00")),
    ]
    assert IMU_IDS == (0x11, 0x21, 0x32)


@given(st.tuples(*[float32] * 6), st.floats(-1e5, 1e5))
def test_forces_come_out_of_the_frames_as_they_went_in(
    forces: tuple[float, ...], any_force: float
) -> None:
    assembler = SampleAssembler()
    assert added(assembler, pack_forces(forces)) == [None, None, forces]
    sent = added(assembler, pack_forces((any_force,) * 6))[2]
    assert sent == (as_sent(any_force),) * 6
    assert assembler.malformed == 0


@given(st.tuples(part, part, part, part), st.tuples(*[st.floats(-60.0, 60.0)] * 3), st.booleans())
def test_an_attitude_comes_back_as_it_was_sent_but_for_rounding(
    quaternion: tuple[float, ...], rate: tuple[float, ...], valid: bool
) -> None:
    sample: ImuSample = added(ImuAssembler(), pack_imu(quaternion, rate, valid=valid))[2]
    assert sample.quaternion == pytest.approx(quaternion, abs=2.0**-15)
    assert sample.rate == pytest.approx(rate, abs=2.0**-10)
    assert sample.valid is valid


@each_kind
@pytest.mark.parametrize("count", [1, 2, 3])
def test_frames_of_two_samples_are_never_mixed_when_some_are_lost(kind: Kind, count: int) -> None:
    frames, (one, two) = kind.one + kind.two, kind.samples()
    for lost in set(itertools.combinations(range(6), count)) - set(kind.lost_unseen):
        assembler = kind.assembler()
        came = added(assembler, [frame for n, frame in enumerate(frames) if n not in lost])
        assert all(sample in (None, one, two) for sample in came), lost
        assert added(assembler, kind.one)[2] == one


@each_kind
def test_a_frame_of_the_wrong_length_ends_the_sample_and_no_other_makes_it_good(kind: Kind) -> None:
    assembler = kind.assembler()
    first, (can_id, second), third = kind.one
    assert added(assembler, [first, (can_id, second[:-1]), third]) == [None] * 3
    assert assembler.malformed == 2
    assert added(kind.assembler(), [first, (can_id, second[:-1]), *kind.two[1:]]) == [None] * 4


@each_kind
@pytest.mark.parametrize("foreign", [0, LOADCELL_IDS[0] - 1, LOADCELL_IDS[2] + 1, 0x7FF])
def test_foreign_frames_are_ignored_between_those_of_a_sample(kind: Kind, foreign: int) -> None:
    assembler = kind.assembler()
    came = added(assembler, [f for own in kind.one for f in ((foreign, bytes(8)), own)])
    assert (came[-1], assembler.malformed) == (kind.samples()[0], 0)


PAUSE_NS, PERIOD_NS, T0 = 20 * NS_PER_MS, 4 * NS_PER_MS, 5 * NS_PER_S


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
            self.send(pack_forces(forces))


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


def test_the_newest_waiting_sample_is_returned_once_however_its_frames_come(link: Link) -> None:
    link.send_forces(ONE, TWO)
    assert link.sensor.newest(T0 + PERIOD_NS) == TWO
    assert link.sensor.newest(T0 + 2 * PERIOD_NS) is None
    frames = pack_forces(ONE)
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
            hub.broadcast(pack_forces(ONE))
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
    frames, sensor = pack_forces(ONE), sensor_on("xrl_unix", str(path))
    with UnixCanHub(path) as hub:
        sensor.newest(T0)
        hub.poll()
        hub.broadcast(frames[:2])
        assert sensor.newest(T0 + 1) is None
    for at_ns in range(T0 + PERIOD_NS, T0 + RETRY_NS, PERIOD_NS):
        assert sensor.newest(at_ns) is None
    with UnixCanHub(path) as hub:
        sensor.newest(T0 + RETRY_NS)
        assert sensor.connected
        hub.poll()
        hub.broadcast(frames[2:])
        assert sensor.newest(T0 + RETRY_NS + 1) is None
        assert sensor.malformed == 1
        assert sensor.discarded == 0, "no pause of the process is what threw it away"
        sensor.close()


@pytest.mark.parametrize(
    ("late_ns", "next_ns", "missed"),
    [(-1, 1000, 0), (0, 1000, 0), (999, 1000, 0), (1000, 2000, 1), (1001, 2000, 1),
     (7500, 8000, 7)],
)  # fmt: skip
def test_missed_deadlines_are_skipped_and_the_grid_is_kept(
    late_ns: int, next_ns: int, missed: int
) -> None:
    assert next_deadline(T0, 1000, T0 + late_ns) == (T0 + next_ns, missed)
