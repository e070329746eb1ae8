"""What of a target goes over USB to an ODrive v3."""

from __future__ import annotations

import asyncio
import struct
from types import SimpleNamespace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.odrive_v3 import OdriveV3, TargetWriter, values_of
from shared.bus.messages import Pair

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


def changed(**fields: Pair) -> MotorTarget:
    return msgspec.structs.replace(TARGET, **fields)


WHOLE = {0: 1.0, 1: 0.5, 2: 2.0, 3: -0.5, 4: 20.0, 5: 0.25, 6: 20.0, 7: 0.25}


def test_the_first_target_and_one_after_a_failure_is_written_whole_inputs_before_gains(
    wire: Wire, writer: TargetWriter
) -> None:
    asyncio.run(writer.write(TARGET))
    assert (wire.last, wire.values) == (list(WHOLE), WHOLE)
    wire.fails = True
    with pytest.raises(TimeoutError):
        asyncio.run(writer.write(changed(pos_turns=(1.5, 2.0))))
    wire.fails = False
    asyncio.run(writer.write(changed(pos_turns=(1.5, 2.0))))
    assert wire.last == list(WHOLE)


@pytest.mark.parametrize(
    ("fields", "written", "value"),
    [({"torque": (0.5, -0.25)}, 3, -0.25), ({"pos_gain": (20.002, 20.0)}, 4, 20.002)],
    ids=["an input", "a gain, by however little: the law has its own threshold"],
)
def test_then_only_what_is_new_is_written(
    wire: Wire, writer: TargetWriter, fields: dict[str, Pair], written: int, value: float
) -> None:
    asyncio.run(writer.write(TARGET))
    asyncio.run(writer.write(changed(**fields)))
    assert wire.last == [written]
    assert wire.values[written] == pytest.approx(value, rel=1e-7)


@given(
    pos_ref=number, vel_ref=number, torque=number, pos=number, vel=number,
    k=st.just(0.0) | st.floats(1e-3, 400.0), limit=st.floats(1.0, 100.0),
)  # fmt: skip
def test_the_drive_gives_the_targets_torque_without_its_input_vel(
    pos_ref: float, vel_ref: float, torque: float, pos: float, vel: float, k: float, limit: float
) -> None:
    """Also where its clamp on the velocity is active; without a pos_gain it is not meant to be."""
    b = 0.25
    limit = limit if k else 100.0
    target = MotorTarget((pos_ref,) * 2, (vel_ref,) * 2, (torque,) * 2, (k,) * 2, (b,) * 2)

    def law(input_pos: float, input_vel: float, input_torque: float) -> float:
        wanted_vel = min(limit, max(-limit, input_vel + k * (input_pos - pos)))
        return input_torque + b * (wanted_vel - vel)

    wanted = law(pos_ref, vel_ref, torque)
    for axis in (0, 1):
        input_pos, input_torque = values_of(target)[2 * axis : 2 * axis + 2]
        assert law(input_pos, 0.0, input_torque) == pytest.approx(wanted, abs=1e-9)


class Tree:
    """Stands for the package's device: a tree of properties with values to be read."""

    def __init__(self, values: dict[str, float]) -> None:
        self.device = self
        self.serial_number, self.fw_version = "0", (0, 5, 6)
        self.functions: dict[str, str] = {}
        self._values = list(values.values())
        self.properties = {
            name: SimpleNamespace(endpoint_id=number, codec=FLOAT)
            for number, name in enumerate(values)
        }

    async def read_endpoints(self, ids: list[int], _sizes: list[int], transient: bool) -> bytes:
        assert not transient
        return struct.pack(f"<{len(ids)}f", *(self._values[number] for number in ids))


def board(**values: float) -> OdriveV3:
    """Return a board with everything the driver uses, and some values below both axes."""
    names = (
        "encoder.pos_estimate", "encoder.vel_estimate", "current_state", "error", "motor.error",
        "encoder.error", "controller.error", "controller.input_pos", "controller.input_torque",
        "controller.config.pos_gain", "controller.config.vel_gain", "config.enable_watchdog",
        "encoder.config.cpr", "encoder.shadow_count", "encoder.count_in_cpr",
    )  # fmt: skip
    tree = {f"{axis}.{name}": 0.0 for axis in ("axis0", "axis1") for name in names}
    return OdriveV3(Tree(tree | {name.replace("__", "."): value for name, value in values.items()}))


def currents(first: float, second: float) -> dict[str, float]:
    name = "motor__current_control__Iq_setpoint"
    return {f"axis0__{name}": first, f"axis1__{name}": second}


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1)])
def test_a_torque_has_its_sign_whichever_way_the_phases_are_wired(signs: tuple[int, int]) -> None:
    """The firmware's current is the torque times the encoder's direction (motor.cpp)."""
    name = "encoder__config__direction"
    wired = {f"axis{axis}__{name}": value for axis, value in enumerate(signs)}
    found = board(**currents(10.0, -20.0), **wired)
    asyncio.run(found.read_settings())
    assert asyncio.run(found.torques(0.5)) == (signs[0] * 5.0, signs[1] * -10.0)
    none = board(**currents(float("nan"), 1.0))
    assert asyncio.run(none.torques(0.5)) is None, "a current that is no number"


def test_each_encoders_zero_is_told_modulo_a_turn() -> None:
    of_axis = {
        "axis0": {"shadow_count": 96.0, "count_in_cpr": 16.0, "config__cpr": 64.0},
        "axis1": {"shadow_count": -8.0, "count_in_cpr": 8.0, "config__cpr": 32.0},
    }
    values = {f"{axis}__encoder__{k}": v for axis, row in of_axis.items() for k, v in row.items()}
    assert asyncio.run(board(**currents(0.0, 0.0), **values).encoder_zero()) == (0.25, 0.5)
