from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from services.harness.filter import WrenchFilter
from services.harness.loop import HarnessLoop
from services.simulator.fronts.sensor_fronts import BIAS_MAX, HarnessFront
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus.codec import Decoder
from shared.bus.messages import Tare, Vector6, Wrench
from shared.can.can_sensor import CanSensor, sensor_of
from shared.can.loadcell_can import SampleAssembler, pack
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from tests.harness.helpers import (
    HARNESS,
    PERIOD_NS,
    ROBOT,
    T0,
    TARE_CYCLES,
    ZERO,
    Asked,
    G,
    Sink,
    cycles,
    legs,
    make_loop,
    six,
)  # fmt: skip


class FrameList:
    """A hub that keeps the packets."""

    def __init__(self) -> None:
        self.packets: list[list[tuple[int, bytes]]] = []

    def poll(self) -> None:
        pass

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        self.packets.append(frames)

    def forces(self) -> npt.NDArray[np.float64]:
        assembler = SampleAssembler()
        found = [assembler.add(*frame) for packet in self.packets for frame in packet]
        return np.array([forces for forces in found if forces is not None])


def sensor_in(run_dir: Path, robot: RobotConfig = ROBOT) -> CanSensor[Vector6]:
    return sensor_of(robot, robot.harness, SampleAssembler(), run_dir)


def test_every_cycle_publishes_once_with_the_next_sequence_number() -> None:
    loop, _, sink = make_loop()
    cycles(loop, T0, 10)
    decoder = Decoder(Wrench)
    messages = [decoder.decode(payload) for payload in sink.payloads]
    stamps = [(m.seq, m.t_ns) for m in messages if m is not None]
    assert stamps == [(n, T0 + n * PERIOD_NS) for n in range(10)]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_never_reaches_the_bus(number: float) -> None:
    loop, sensor, sink = make_loop()
    _, t_ns = cycles(loop, T0, TARE_CYCLES + 1)
    sensor.forces = (0.0, 0.0, number, 0.0, 0.0, 0.0)
    message, _ = cycles(loop, t_ns, 10)
    assert loop.state.refused == 10
    assert not message.valid
    assert len(sink.payloads) == TARE_CYCLES + 11, "Sink.put would have raised NonFiniteError"


def test_what_the_bus_did_not_take_is_counted() -> None:
    loop, _, sink = make_loop()
    cycles(loop, T0, 3)
    sink.closed = True
    cycles(loop, T0 + 3 * PERIOD_NS, 2)
    assert loop.unsent == 2


def test_a_tare_on_request_makes_the_present_wrench_the_zero_and_is_reported_until_it_is_done() -> (
    None
):
    asked = Asked()
    loop, sensor, _ = make_loop(asked)
    _, t_ns = cycles(loop, T0, TARE_CYCLES + 1)
    sensor.forces = legs((0.0, 0.0, 30.0, 0.0, 0.0, 0.0))
    message, t_ns = cycles(loop, t_ns, 100)
    assert message.force[2] == pytest.approx(30.0, abs=1e-3)
    asked.asked = True
    message, t_ns = cycles(loop, t_ns, TARE_CYCLES)
    assert (message.valid, message.tare) == (False, Tare.RUNNING)
    message, t_ns = cycles(loop, t_ns, 1)
    assert (message.valid, message.tare) == (True, Tare.DONE)
    message, _ = cycles(loop, t_ns, 10)
    np.testing.assert_allclose([*message.force, *message.moment], 0.0, atol=1e-9)


def test_a_repeated_request_does_not_delay_the_running_tare() -> None:
    asked = Asked()
    loop, _, _ = make_loop(asked)
    t_ns = T0
    for _ in range(TARE_CYCLES + 1):
        asked.asked = True
        message, t_ns = cycles(loop, t_ns, 1)
    assert message.valid


def test_a_tare_that_shakes_is_reported_and_stays_invalid_until_it_is_still() -> None:
    loop, sensor, _ = make_loop()
    t_ns, tares = T0, []
    for n in range(3 * TARE_CYCLES):
        sensor.forces = legs((0.0, 0.0, 30.0 * math.sin(0.3 * n), 0.0, 0.0, 0.0))
        message, t_ns = cycles(loop, t_ns, 1)
        assert not message.valid
        tares.append(message.tare)
    assert tares[0] == Tare.RUNNING
    assert set(tares[TARE_CYCLES + 1 :]) == {Tare.UNSTEADY}
    sensor.forces = ZERO
    message, _ = cycles(loop, t_ns, 2 * TARE_CYCLES + 2)
    assert (message.valid, message.tare) == (True, Tare.DONE)


def test_the_simulated_sensor_sends_three_frames_in_one_packet() -> None:
    hub = FrameList()
    HarnessFront(ROBOT, hub, seed=1).send([1.0, 2.0, 3.0], [0.1, 0.2, 0.3])
    assert [[can_id for can_id, _ in packet] for packet in hub.packets] == [[0x300, 0x301, 0x302]]


def test_simulated_legs_carry_the_wrench_and_a_constant_bias_and_white_noise() -> None:
    hub = FrameList()
    front = HarnessFront(ROBOT, hub, seed=1)
    wrench = np.array([10.0, -20.0, 100.0, 5.0, -6.0, 7.0])
    for _ in range(2000):
        front.send(wrench[:3], wrench[3:])
    residual = hub.forces() - np.linalg.solve(G, wrench) - front.bias
    noise = ROBOT.simulation.harness_noise
    np.testing.assert_allclose(residual.std(axis=0), noise, rtol=0.1)
    np.testing.assert_allclose(residual.mean(axis=0), 0.0, atol=5 * noise / math.sqrt(2000))
    assert (np.abs(front.bias) <= BIAS_MAX).all()
    assert np.abs(front.bias).max() > 1.0, "without a bias the tare would have nothing to do"


def test_the_simulated_sensor_is_the_same_for_the_same_seed_and_another_for_another() -> None:
    packets = []
    for seed in (1, 1, 2):
        hub = FrameList()
        HarnessFront(ROBOT, hub, seed).send([1.0, 2.0, 3.0], [0.1, 0.2, 0.3])
        packets.append(hub.packets)
    assert packets[0] == packets[1] != packets[2]


def test_the_simulated_cells_clip_and_the_service_calls_that_saturated() -> None:
    hub = FrameList()
    front = HarnessFront(ROBOT, hub, seed=1)
    loop, sensor, _ = make_loop()
    _, t_ns = cycles(loop, T0, TARE_CYCLES + 1)
    front.send([0.0, 0.0, 3000.0], [0.0, 0.0, 0.0])
    forces = hub.forces()[0]
    assert np.abs(forces).max() == HARNESS.leg_force_max
    sensor.forces = six(forces)
    message, _ = cycles(loop, t_ns, 1)
    assert message.saturated
    assert not message.valid


def test_the_operators_wrench_arrives_through_the_simulated_sensor_within_its_noise(
    short_dir: Path,
) -> None:
    robot = msgspec.structs.replace(
        ROBOT, simulation=msgspec.structs.replace(ROBOT.simulation, harness_noise=0.5)
    )
    path = short_dir / "can_harness.sock"
    sensor = sensor_in(short_dir, robot)
    law, sink = WrenchFilter(robot.harness), Sink()
    loop = HarnessLoop(sensor, law, sink, Asked())
    wrench = np.array([30.0, -20.0, 150.0, 4.0, 60.0, -5.0])
    with UnixCanHub(path) as hub:
        front = HarnessFront(robot, hub, seed=3)
        t_ns = T0
        message = loop.cycle(t_ns)
        errors = []
        for n in range(TARE_CYCLES + 500):
            t_ns += PERIOD_NS
            load = wrench if n > TARE_CYCLES else np.zeros(6)
            front.send(load[:3], load[3:])
            message = loop.cycle(t_ns)
            assert message.valid is (n >= TARE_CYCLES)
            assert message.age_ns == 0
            if n > TARE_CYCLES + 50:
                errors.append(np.subtract([*message.force, *message.moment], wrench))
        sensor.close()
    # The noise of six legs through G, before the low-pass makes it smaller.
    sigma = 0.5 * np.sqrt((G**2).sum(axis=1))
    assert len(errors) > 400
    assert (np.std(errors, axis=0) < sigma).all()
    assert (np.abs(np.mean(errors, axis=0)) < sigma / 2.0).all()
    assert (np.abs(errors) < 4.0 * sigma).all()


def test_the_simulator_going_away_makes_the_wrench_invalid_until_it_is_back(
    short_dir: Path,
) -> None:
    path = short_dir / "can_harness.sock"
    sensor = sensor_in(short_dir)
    loop = HarnessLoop(sensor, WrenchFilter(HARNESS), Sink(), Asked())
    seen: list[bool] = []
    t_ns = T0
    for present, count in ((True, 200), (False, 50), (True, 100)):
        hub = UnixCanHub(path) if present else None
        for _ in range(count):
            if hub is not None:
                hub.poll()
                hub.broadcast(pack(ZERO))
            seen.append(loop.cycle(t_ns).valid)
            t_ns += PERIOD_NS
        if hub is not None:
            hub.close()
    sensor.close()
    # The last sample is still usable for `stale_ms`; the link is tried every 0.2 s.
    assert seen[199]
    assert not any(seen[206:250])
    assert all(seen[310:])
    assert sensor.opened == 2


def test_a_low_rate_is_no_pause_of_the_process(short_dir: Path) -> None:
    slow = msgspec.structs.replace(
        ROBOT,
        harness=msgspec.structs.replace(HARNESS, rate_hz=20.0),
        can={**ROBOT.can, HARNESS.bus: CanConfig(interface="virtual", channel="{run}")},
    )
    sensor = sensor_in(short_dir, slow)
    sensor.newest(T0)
    sensor.newest(T0 + 50 * NS_PER_MS)
    assert sensor.discarded == 0
    sensor.close()
