from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from services.imu.attitude import FROZEN_NS, AttitudeLaw, up_in_sensor
from services.imu.loop import ImuLoop
from shared.bus.messages import Attitude, Vector4
from shared.can.sensor_frames import ImuSample
from shared.clock import NS_PER_MS
from shared.config.sections import ImuConfig

ROBOT_IMU = ImuConfig(fitted=True, stale_ms=100.0)
STALE_NS = round(100.0 * NS_PER_MS)
T0 = 7_000_000_000
angles = st.floats(-1.2, 1.2)


def sample(turned: Rotation, *, valid: bool = True) -> ImuSample:
    x, y, z, w = turned.as_quat().tolist()
    return ImuSample((w, x, y, z), (0.1, 0.2, 0.3), valid)


@given(angles, angles, st.floats(-math.pi, math.pi), st.tuples(angles, angles, angles))
def test_up_is_the_vertical_in_torso_axes_whatever_the_heading(
    roll: float, pitch: float, heading: float, mounting: tuple[float, float, float]
) -> None:
    """By scipy: the torso is turned, the mounting and the sensor's own yaw drop out."""
    torso = Rotation.from_euler("ZXY", (0.0, roll, pitch))
    mount_roll, mount_pitch, mount_yaw = mounting
    mounted = Rotation.from_euler("ZXY", (mount_yaw, mount_roll, mount_pitch))  # sensor to torso
    measured = Rotation.from_euler("Z", heading) * torso * mounted
    law = AttitudeLaw(msgspec.structs.replace(ROBOT_IMU, mounting=mounting))
    reading = law.step(T0, sample(measured))
    assert reading.valid
    np.testing.assert_allclose(reading.up, torso.inv().apply((0.0, 0.0, 1.0)), atol=6e-6)
    np.testing.assert_allclose(reading.rate, mounted.apply((0.1, 0.2, 0.3)), atol=6e-5)


@pytest.mark.parametrize(("late_ns", "valid"), [(0, True), (STALE_NS, True), (STALE_NS + 1, False)])
def test_a_sample_is_good_up_to_its_age_and_the_numbers_stay(late_ns: int, valid: bool) -> None:
    law = AttitudeLaw(ROBOT_IMU)
    nothing = law.step(T0, None)
    assert (nothing.valid, nothing.age_ns) == (False, -1), "before the first"
    first = law.step(T0, sample(Rotation.from_euler("X", 0.1)))
    later = law.step(T0 + late_ns, None)
    assert (later.valid, later.age_ns, later.up) == (valid, late_ns, first.up)


def test_a_sensor_that_reports_invalid_is_believed_and_its_numbers_are_not() -> None:
    law = AttitudeLaw(ROBOT_IMU)
    first = law.step(T0, sample(Rotation.identity()))
    lost = law.step(T0 + 1, sample(Rotation.from_euler("X", 1.0), valid=False))
    assert first.valid
    assert not lost.valid
    assert lost.up == first.up


@pytest.mark.parametrize(
    "quaternion", [(0.0, 0.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.0), (1.0, 1.0, 0.0, 0.0)]
)
def test_a_quaternion_that_is_none_is_refused_as_if_it_never_came(quaternion: Vector4) -> None:
    law = AttitudeLaw(ROBOT_IMU)
    good = law.step(T0, sample(Rotation.identity()))
    bad = law.step(T0 + STALE_NS, ImuSample(quaternion, (0.0, 0.0, 0.0), valid=True))
    assert law.refused == 1
    assert bad.up == good.up
    assert bad.age_ns == STALE_NS
    assert not law.step(T0 + STALE_NS + 1, None).valid


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_up_in_sensor_axes_is_of_unit_length(quaternion: Vector4) -> None:
    assert math.hypot(*up_in_sensor(quaternion)) == pytest.approx(1.0)


def test_the_loop_publishes_every_cycle_and_counts_what_could_not_be_sent() -> None:
    waiting = [sample(Rotation.identity()), None, sample(Rotation.from_euler("Y", 0.1))]
    sent: list[Attitude] = []

    class Sensor:
        def newest(self, _now_ns: int) -> ImuSample | None:
            return waiting.pop(0)

    class Bus:
        def put(self, message: Attitude) -> bool:
            sent.append(message)
            return len(sent) != 2

    loop = ImuLoop(Sensor(), AttitudeLaw(ROBOT_IMU), Bus())
    for cycle in range(3):
        loop.cycle(T0 + cycle * 10 * NS_PER_MS)
    assert [message.seq for message in sent] == [0, 1, 2]
    assert [message.age_ns for message in sent] == [0, 10 * NS_PER_MS, 0]
    assert sent[2].up == pytest.approx((-math.sin(0.1), 0.0, math.cos(0.1)), abs=6e-6)
    assert loop.unsent == 1


def test_samples_that_repeat_are_no_attitude_until_one_differs() -> None:
    law, same = AttitudeLaw(ROBOT_IMU), sample(Rotation.from_euler("X", 0.1))
    valid = [law.step(T0 + at_ns, same).valid for at_ns in range(0, FROZEN_NS + 1, NS_PER_MS)]
    assert valid == [True] * (len(valid) - 1) + [False]
    assert law.step(T0 + 2 * FROZEN_NS, sample(Rotation.from_euler("X", 0.1001))).valid
