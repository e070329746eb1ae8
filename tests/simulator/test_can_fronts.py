"""The CAN fronts of drives and IMU: dialects, silence, periods, and an IMU in any mounting."""

from __future__ import annotations

import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.imu.attitude import AttitudeLaw
from services.simulator.drives.axis_faults import BUS_FAULTS, FAULTS
from services.simulator.fronts.cansimple_dialects import (
    SDO_ENDPOINTS,
    DialectName,
    errors_06,
)
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.fronts.sensor_fronts import ImuFront
from services.simulator.fronts.unix_can_hub import UnixCanHub
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import ImuErrors, PlantConfig, changed
from services.simulator.physics.world import World
from shared.bus.messages import Vector3
from shared.can import cansimple, cansimple_06
from shared.can.cansimple import AxisState, Command, arbitration_id, pack_float, pack_u32
from shared.can.cansimple_06 import Command06, DriveError06, ProcedureResult, SdoOpcode
from shared.can.sensor_frames import ImuAssembler
from shared.can.unix_can import REMOTE_FLAG, UnixCanBus, unpack_frames
from shared.config.robot_config import RobotConfig
from tests.imu.robots import with_imu
from tests.lockstep.runs import still
from tests.simulator.banks import CPR, DT, ZERO, make_bank
from tools.sim.virtual_services import VirtualCan

NODE, AXIS = 5, 3  # axis1 of knee_right


class Bench:
    """Two axes of a bank on a bus, and a client on it."""

    def __init__(self, path: Path, dialect: DialectName, turns: float = 0.0) -> None:
        self.hub = UnixCanHub(path)
        self.bank = make_bank(turns=turns)
        self.front = CanSimpleFront(self.bank, [self.hub], [{4: 2, NODE: AXIS}], dialect=dialect)
        self.client = UnixCanBus(str(path))
        self.front.receive()  # admits the client

    def send(self, command: int, data: bytes = b"", *, remote: bool = False) -> None:
        self.client.send(
            can.Message(
                arbitration_id=arbitration_id(NODE, command),
                data=data,
                is_extended_id=False,
                is_remote_frame=remote,
            )
        )
        self.front.receive()

    def heard(self) -> list[tuple[int, bytes]]:
        return [
            (can_id & ~REMOTE_FLAG, data)
            for can_id, data in unpack_frames(self.client.recv_packet(0.0))
        ]

    def ask(self, command: int) -> bytes:
        self.send(command, remote=True)
        ((can_id, data),) = self.heard()
        assert can_id == arbitration_id(NODE, command)
        return data

    def heartbeat(self) -> bytes:
        self.front.send_heartbeats(self.bank.now_s)
        return dict(self.heard())[arbitration_id(NODE, Command.HEARTBEAT)]

    def step(self, seconds: float = DT) -> None:
        self.bank.step(self.bank.now_s + seconds, ZERO, ZERO)


@pytest.fixture
def benches() -> Iterator[Callable[..., Bench]]:
    """Make benches, each on a bus of its own, and close them."""
    made: list[Bench] = []
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:

        def make(dialect: DialectName, turns: float = 0.0) -> Bench:
            made.append(Bench(Path(folder) / f"can{len(made)}", dialect, turns))
            return made[-1]

        yield make
        for bench in made:
            bench.client.shutdown()
            bench.hub.close()


@pytest.fixture
def old(benches: Callable[..., Bench]) -> Bench:
    return benches("0.5")


@pytest.fixture
def new(benches: Callable[..., Bench]) -> Bench:
    return benches("0.6")


# ---- frames


def test_requests_are_answered_from_the_registers(benches: Callable[..., Bench]) -> None:
    old = benches("0.5", turns=-0.25)
    old.bank.inject("knee_right.axis1", "OVERSPEED")
    assert old.ask(Command.GET_ENCODER_ESTIMATES) == struct.pack("<ff", -0.25, 0.0)
    own = (int(old.bank.encoder_mount[AXIS]) - 4096) % CPR
    assert old.ask(Command.GET_ENCODER_COUNT) == struct.pack("<ii", -4096, own)
    assert old.ask(Command.GET_MOTOR_ERROR) == struct.pack("<Q", 0x1_1000_0000)
    assert old.ask(Command.GET_CONTROLLER_ERROR) == struct.pack("<II", 1, 0)
    assert old.ask(Command.GET_VBUS) == struct.pack("<ff", 48.0, 0.0)
    old.bank.inject("knee_right.axis1", "ENCODER")
    assert old.ask(Command.GET_ENCODER_ERROR) == struct.pack("<II", 0x80, 0)


def test_only_its_own_node_changes_a_drive_and_a_current_has_the_calibrated_sign(
    old: Bench,
) -> None:
    can_id = arbitration_id(NODE + 4, Command.SET_INPUT_TORQUE)
    data = struct.pack("<f", 9.0)
    old.client.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
    old.front.receive()
    assert not old.bank.input_torque.any()
    # CAN of 0.5 has no way to ask for it; `test_drives.py` has the rule.
    old.bank.input_torque[AXIS] = 0.0827
    old.bank.settings.set(AXIS // 2, "axis1.encoder.config.direction", -1)
    old.step()
    assert cansimple.unpack_two_floats(old.ask(Command.GET_IQ)) == pytest.approx((-1.0, -1.0))


def test_an_axis_that_was_armed_reports_a_requested_current_in_idle_too(old: Bench) -> None:
    """The measured one stays as it was when the axis disarmed (can_simple.cpp, 0.5.6)."""
    old.bank.input_torque[AXIS] = 0.0827
    old.step()
    assert cansimple.unpack_two_floats(old.ask(Command.GET_IQ)) == pytest.approx((1.0, 1.0))
    old.bank.request_state(AXIS, AxisState.IDLE)
    old.bank.input_torque[AXIS] = 2 * 0.0827
    old.step()
    assert not old.bank.torque.any()
    assert cansimple.unpack_two_floats(old.ask(Command.GET_IQ)) == pytest.approx((2.0, 1.0))
    old.bank.reboot(AXIS)
    old.step(5.0)
    assert old.ask(Command.GET_IQ) == bytes(8)


def test_a_heartbeat_keeps_its_period(old: Bench) -> None:
    count = 0
    for _ in range(1000):
        old.step(1e-3)
        old.front.send_heartbeats(old.bank.now_s)
        count += len(old.heard())
    assert count == 20, "two axes, each every 100 ms"


@pytest.mark.parametrize(("action", "limit"), [(0, 60.0), (1, 33.0)])
def test_a_restart_of_0_6_saves_its_settings_first_if_asked(
    new: Bench, action: int, limit: float
) -> None:
    new.bank.current_lim[AXIS] = 33.0
    new.send(Command.REBOOT, bytes([action]))
    assert new.bank.current_lim[AXIS] == limit


# ---- dialects


def test_each_dialect_has_its_own_bits_and_a_heartbeat_of_0_6_its_result(
    old: Bench, new: Bench
) -> None:
    for each in (old, new):
        each.bank.inject("knee_right.axis1", "WATCHDOG")
    heartbeat = cansimple.unpack_heartbeat(old.heartbeat())
    assert (heartbeat.axis_error, heartbeat.axis_state) == (0x800, AxisState.IDLE)
    heartbeat_06 = cansimple_06.unpack_heartbeat(new.heartbeat())
    assert (heartbeat_06.axis_error, heartbeat_06.axis_state) == (0x0100_0000, AxisState.IDLE)
    assert heartbeat_06.procedure_result == ProcedureResult.DISARMED
    assert new.ask(Command06.GET_ERROR) == struct.pack("<II", 0x0100_0000, 0x0100_0000)
    new.bank.clear_errors(AXIS)
    new.bank.request_state(AXIS, AxisState.CLOSED_LOOP_CONTROL)
    new.step(0.2)
    assert cansimple_06.unpack_heartbeat(new.heartbeat()).procedure_result == ProcedureResult.BUSY
    new.bank.request_state(AXIS, AxisState.IDLE)
    new.step(0.2)
    heartbeat = cansimple_06.unpack_heartbeat(new.heartbeat())
    assert heartbeat.procedure_result == ProcedureResult.SUCCESS
    assert heartbeat.trajectory_done


@pytest.mark.parametrize("name", [*FAULTS, *BUS_FAULTS])
def test_every_fault_but_the_silent_one_has_a_bit_in_0_6(name: str) -> None:
    errors = errors_06({**FAULTS, **BUS_FAULTS}[name])
    assert (errors == DriveError06.NONE) == (name == "DISARM")


# ---- endpoints


def endpoint(name: str) -> int:
    return next(number for number, each in SDO_ENDPOINTS.items() if each == name)


def read(bench: Bench, name: str) -> bytes:
    bench.send(Command06.RX_SDO, cansimple_06.pack_sdo(SdoOpcode.READ, endpoint(name)))
    ((can_id, data),) = bench.heard()
    assert can_id == arbitration_id(NODE, Command06.TX_SDO)
    _, number, value = cansimple_06.unpack_sdo(data)
    assert number == endpoint(name)
    return value


def test_an_endpoint_has_its_type_and_is_written_for_its_own_axis(new: Bench) -> None:
    assert read(new, "motor.config.pre_calibrated")[0] == 1
    assert struct.unpack("<I", read(new, "encoder.config.cpr")) == (16384,)
    assert struct.unpack("<f", read(new, "vbus_voltage")) == (48.0,)
    name = "controller.config.vel_limit"
    written = cansimple_06.pack_sdo(SdoOpcode.WRITE, endpoint(name), struct.pack("<f", 7.5))
    new.send(Command06.RX_SDO, written)
    confirmed = cansimple_06.pack_sdo(0, endpoint(name), struct.pack("<f", 7.5))
    assert new.heard() == [(arbitration_id(NODE, Command06.TX_SDO), confirmed)]
    assert new.bank.vel_limit[AXIS] == 7.5
    assert new.bank.vel_limit[AXIS - 1] == 60.0
    assert struct.unpack("<f", read(new, name)) == (7.5,)


@pytest.mark.parametrize("dialect", ["0.5", "0.6"])
def test_in_0_5_estimates_are_zeros_from_each_start_up_to_the_first_closed_loop(
    benches: Callable[..., Bench], dialect: DialectName
) -> None:
    bench = benches(dialect)
    bank = bench.bank
    bank.connected[AXIS] = 0.0  # the bench has armed it
    bank.set_count(AXIS, 7 * CPR + 5)
    there = struct.pack("<ff", 7.0 + 5 / CPR, 0.0)
    assert bench.ask(Command.GET_ENCODER_ESTIMATES) == (bytes(8) if dialect == "0.5" else there)
    if dialect == "0.5":  # the count locates it all the same
        own = int(bank.encoder_mount[AXIS])
        assert bench.ask(Command.GET_ENCODER_COUNT) == struct.pack("<ii", 7 * CPR + 5, own)
    bank.request_state(AXIS, AxisState.CLOSED_LOOP_CONTROL)
    bank.request_state(AXIS, AxisState.IDLE)
    assert bench.ask(Command.GET_ENCODER_ESTIMATES) == there
    bank.reboot(AXIS)
    assert bank.connected[AXIS] == 0.0


# ---- silence


@pytest.mark.parametrize("why", ["link", "supply"])
def test_a_silent_drive_neither_sends_nor_receives_nor_feeds(old: Bench, why: str) -> None:
    if why == "link":
        old.bank.conditions.link(AXIS // 2, up=False)
    else:
        old.bank.supply(AXIS // 2, 0.0)
    old.step(0.5)
    old.front.send_encoders()
    old.front.send_heartbeats(old.bank.now_s)
    old.send(Command.SET_INPUT_TORQUE, struct.pack("<f", 1.0))
    old.send(Command.GET_IQ, remote=True)
    assert old.heard() == []
    assert old.bank.input_torque[AXIS] == 0.0
    old.bank.conditions.link(AXIS // 2, up=True)
    assert sent(old).total() == (2 if why == "link" else 0), "it sends again"


def sent(bench: Bench, steps: int = 1) -> Counter[int]:
    """Return how often each id is sent in so many steps."""
    counts: Counter[int] = Counter()
    for _ in range(steps):
        bench.step()
        bench.front.send_encoders()
        counts.update(can_id for can_id, _ in bench.heard())
    return counts


# ---- periods


def test_estimates_are_sent_at_each_axis_s_period_and_never_at_a_period_of_zero(old: Bench) -> None:
    assert old.bank.settings.get(1, "axis1.config.can.node_id") == NODE
    old.bank.settings.set(1, "axis0.config.can.encoder_rate_ms", 10)
    ids = [arbitration_id(node, Command.GET_ENCODER_ESTIMATES) for node in (4, NODE)]
    assert sent(old, 100) == dict(zip(ids, (10, 100), strict=True))
    old.bank.settings.fill("config.can.encoder_rate_ms", 0)
    old.bank.settings.fill("config.can.heartbeat_rate_ms", 0)
    assert not sent(old, 50)
    old.front.send_heartbeats(old.bank.now_s)
    assert old.heard() == []
    old.bank.settings.fill("config.can.encoder_rate_ms", 1)
    assert sent(old).total() == 2


def test_a_silent_drive_gets_what_waited_on_its_bus_unless_another_node_acknowledged_it(
    old: Bench,
) -> None:
    """Nobody acknowledged it: the kernel kept it, an arming request too."""
    old.bank.request_state(AXIS, AxisState.IDLE)
    old.step()
    old.bank.conditions.link(AXIS >> 1, up=False)
    old.send(Command.SET_INPUT_TORQUE, pack_float(0.5))
    old.send(Command.SET_AXIS_STATE, pack_u32(AxisState.CLOSED_LOOP_CONTROL))
    old.step(3.0)
    assert old.bank.state[AXIS] == AxisState.IDLE
    old.bank.conditions.link(AXIS >> 1, up=True)
    old.front.receive()
    old.step()
    assert old.bank.state[AXIS] == AxisState.CLOSED_LOOP_CONTROL
    assert old.bank.input_torque[AXIS] == 0.5
    old.hub.shared = True
    old.bank.conditions.link(AXIS >> 1, up=False)
    old.send(Command.SET_INPUT_TORQUE, pack_float(0.75))
    old.bank.conditions.link(AXIS >> 1, up=True)
    old.front.receive()
    assert old.bank.input_torque[AXIS] == 0.5, "the other node acknowledged it"


EXACT = ImuErrors(tilt=(0.0, 0.0), noise=0.0)


@pytest.mark.parametrize("mounting", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.5), (3.1, 0.0, 0.4)])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.0873, -0.05)])
def test_however_the_sensor_is_mounted_the_service_finds_up_and_the_torsos_rates(
    robot: RobotConfig, mounting: Vector3, slope: tuple[float, float]
) -> None:
    fitted = with_imu(robot, mounting=mounting)
    plant = changed(PlantConfig(), {"floor.slope": list(slope)})
    world = World(body_of(fitted, plant), still(1.0))
    torso = Rotation.from_euler("ZXY", (0.4, 0.1, -0.3))
    x, y, z, w = torso.as_quat().tolist()
    world.data.qpos[3:7] = w, x, y, z
    world.data.qvel[3:6] = 0.5, -1.0, 0.25
    frames = VirtualCan(ImuAssembler())
    ImuFront(fitted.imu, EXACT, frames, 1).send(world)
    reading = AttitudeLaw(fitted.imu).step(1, frames.newest(1))
    gravity = world.model.opt.gravity
    np.testing.assert_allclose(
        reading.up, torso.inv().apply(-gravity / np.linalg.norm(gravity)), atol=2e-4
    )
    np.testing.assert_allclose(reading.rate, (0.5, -1.0, 0.25), atol=4e-3)
