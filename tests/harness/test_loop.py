from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from services.harness.loop import ZeroFile, zero_path
from services.simulator.fronts.sensor_fronts import BIAS_MAX, HarnessFront
from shared.bus.codec import Decoder
from shared.bus.messages import Tare, Wrench
from shared.can.sensor_frames import SampleAssembler
from tests.harness.helpers import (
    HARNESS,
    PERIOD_NS,
    T0,
    TARE_CYCLES,
    Asked,
    G,
    cycles,
    legs,
    make_loop,
    six,
)  # fmt: skip
from tests.robots import ROBOT


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


def test_every_cycle_publishes_once_with_the_next_sequence_number() -> None:
    """A tare that is asked for in each of them is not delayed by that."""
    asked = Asked()
    loop, _, sink = make_loop(asked)
    for n in range(TARE_CYCLES + 1):
        asked.asked = True
        message = loop.cycle(T0 + n * PERIOD_NS)
    assert message.valid
    decoder = Decoder(Wrench)
    messages = [decoder.decode(payload) for payload in sink.payloads]
    stamps = [(m.seq, m.t_ns) for m in messages if m is not None]
    assert stamps == [(n, T0 + n * PERIOD_NS) for n in range(TARE_CYCLES + 1)]


def test_a_tare_on_request_makes_the_present_wrench_the_zero_and_is_reported_until_then() -> None:
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


def test_a_service_that_restarts_under_a_load_goes_on_from_the_zero_before_it(
    tmp_path: Path,
) -> None:
    load = (3.0, 0.0, -100.0, 0.0, 5.0, 0.0)
    loop, sensor, _ = make_loop(zero=ZeroFile(tmp_path))
    sensor.forces = legs((0.0, 0.0, 12.0, 0.0, 0.0, 0.0))  # the cells' own zero
    _, t_ns = cycles(loop, T0, TARE_CYCLES + 1)
    successor, sensor, _ = make_loop(zero=ZeroFile(tmp_path))
    sensor.forces = legs(np.add(load, (0.0, 0.0, 12.0, 0.0, 0.0, 0.0)))
    message, _ = cycles(successor, t_ns, 200)
    assert (message.valid, message.tare) == (True, Tare.DONE)
    np.testing.assert_allclose([*message.force, *message.moment], load, atol=1e-3)


def test_a_service_that_ends_in_a_tare_that_was_asked_for_leaves_it_to_the_next(
    tmp_path: Path,
) -> None:
    asked = Asked()
    loop, _, _ = make_loop(asked, ZeroFile(tmp_path))
    _, t_ns = cycles(loop, T0, TARE_CYCLES + 1)
    asked.asked = True
    _, t_ns = cycles(loop, t_ns, 10)
    successor, sensor, _ = make_loop(zero=ZeroFile(tmp_path))
    sensor.forces = legs((0.0, 0.0, 30.0, 0.0, 0.0, 0.0))
    message, t_ns = cycles(successor, t_ns, TARE_CYCLES)
    assert (message.valid, message.tare) == (False, Tare.RUNNING)
    message, _ = cycles(successor, t_ns, 10)
    np.testing.assert_allclose([*message.force, *message.moment], 0.0, atol=1e-9)


def test_a_zero_that_is_damaged_or_of_an_earlier_boot_is_none(tmp_path: Path) -> None:
    zero, offset = ZeroFile(tmp_path), np.array((0.0, 1.0, 2.0, 3.0, 4.0, -5.0))
    assert zero.read() is None, "an empty file has none"
    zero.write(offset)
    assert np.array_equal(ZeroFile(tmp_path).read(), offset)
    assert ZeroFile(tmp_path, b"another boot").read() is None
    file = zero_path(tmp_path)
    whole = file.read_bytes()
    for at in range(len(whole)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert ZeroFile(tmp_path).read() is None
    file.write_bytes(whole)
    zero = ZeroFile(tmp_path)
    zero.write(None)
    assert zero.read() is None


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
