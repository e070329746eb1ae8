"""What of a target goes over USB to an ODrive v3."""

from __future__ import annotations

import asyncio
import struct
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.odrive_v3 import GAIN_STEP, TargetWriter, values_of

FLOAT = SimpleNamespace(struct_format="f", size=4)
PROPERTIES = [SimpleNamespace(endpoint_id=number, codec=FLOAT) for number in range(8)]
TARGET = MotorTarget((1.0, 2.0), (0.0, 0.0), (0.5, -0.5), (20.0, 20.0), (0.25, 0.25))

number = st.floats(-50.0, 50.0)


class Wire:
    """Stands for the package's device: keeps what is written, and may fail."""

    def __init__(self) -> None:
        self.device = self
        self.values: dict[int, float] = {}
        self.fails = False
        self.last: list[int] = []

    async def write_endpoints(self, ids: list[int], sizes: list[int], data: bytes) -> None:
        assert sum(sizes) == len(data)
        self.last = ids
        if self.fails:
            raise TimeoutError
        self.values |= dict(zip(ids, struct.unpack(f"<{len(ids)}f", data), strict=True))


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def writer(wire: Wire) -> TargetWriter:
    return TargetWriter(wire, PROPERTIES)


def changed(**fields: tuple[float, float]) -> MotorTarget:
    names = MotorTarget.__struct_fields__
    return MotorTarget(*(fields.get(name, getattr(TARGET, name)) for name in names))


def test_the_first_target_is_written_whole_inputs_before_gains(
    wire: Wire, writer: TargetWriter
) -> None:
    asyncio.run(writer.write(TARGET))
    assert wire.last == list(range(8))
    assert list(wire.values.values()) == [1.0, 0.5, 2.0, -0.5, 20.0, 0.25, 20.0, 0.25]


def test_then_only_what_is_new_is_written(wire: Wire, writer: TargetWriter) -> None:
    asyncio.run(writer.write(TARGET))
    asyncio.run(writer.write(changed(torque=(0.5, -0.25))))
    assert wire.last == [3]
    assert wire.values[3] == -0.25


def test_a_gain_is_written_when_it_differs_enough_from_the_drives(
    wire: Wire, writer: TargetWriter
) -> None:
    asyncio.run(writer.write(TARGET))
    wire.last = []
    for step in range(10):
        gain = 20.0 * (1.0 + 0.3 * GAIN_STEP * step)
        asyncio.run(writer.write(changed(pos_gain=(gain, 20.0))))
        assert wire.values[4] == pytest.approx(gain, rel=1.1 * GAIN_STEP)
    assert wire.last == [4]


def test_after_a_failure_everything_is_written_anew(wire: Wire, writer: TargetWriter) -> None:
    asyncio.run(writer.write(TARGET))
    wire.fails = True
    with pytest.raises(TimeoutError):
        asyncio.run(writer.write(changed(pos_turns=(1.5, 2.0))))
    wire.fails = False
    asyncio.run(writer.write(changed(pos_turns=(1.5, 2.0))))
    assert wire.last == list(range(8))


@given(pos_ref=number, vel_ref=number, torque=number, pos=number, vel=number)
def test_the_drive_gives_the_targets_torque_without_its_input_vel(
    pos_ref: float, vel_ref: float, torque: float, pos: float, vel: float
) -> None:
    k, b = 20.0, 0.25
    target = MotorTarget((pos_ref,) * 2, (vel_ref,) * 2, (torque,) * 2, (k,) * 2, (b,) * 2)
    wanted = torque + b * (vel_ref + k * (pos_ref - pos) - vel)
    input_pos, input_torque, *_ = values_of(target)
    assert input_torque + b * (0.0 + k * (input_pos - pos) - vel) == pytest.approx(wanted)
