"""Compute the up direction, a unit vector in torso axes, from the IMU's orientation. Pure.

The quaternion rotates sensor axes to world axes with z up, so the third row of its rotation is up
in sensor axes. The heading, which is wrong near steel, has no effect. The mounting rotates sensor
axes to torso axes.

A sample whose quaternion is not of unit length is refused and counted, because its frames must have
another format. A working sensor is noisy, so no reading is valid once samples have not changed for
`FROZEN_NS`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from shared.bus.messages import Vector3, Vector4
from shared.can.sensor_frames import ImuSample
from shared.clock import NS_PER_MS
from shared.config.sections import ImuConfig
from shared.robot.frames import rotated, torso_rotation
from shared.rounding import POSITION, RATE

UNIT_TOLERANCE: Final = 0.02
"""Maximum deviation of a quaternion's length from 1; rounding to 2^-15 causes 6e-5."""


FROZEN_NS: Final = 250 * NS_PER_MS
"""Time without change after which the sensor counts as frozen, ns. It is longer than a load cell's,
because an IMU's steps are coarser: 3e-5 in the quaternion, 2e-3 rad/s in the rates."""


class AttitudeReading(NamedTuple):
    """Output of the attitude filter."""

    up: Vector3
    """Unit vector opposite to gravity, torso axes."""
    rate: Vector3
    """Angular velocity, rad/s, torso axes."""
    valid: bool
    """True if fresh, not frozen, and valid according to the sensor; otherwise `up` and `rate` are
    the last valid values."""
    age_ns: int
    """Age of the newest accepted sample; -1 before the first."""


class AttitudeLaw:
    """Filter of the attitude; stores the mounting and the last valid values."""

    def __init__(self, config: ImuConfig) -> None:
        self.refused = 0
        """Number of samples whose quaternion was not of unit length."""
        self._mounting = torso_rotation(config.mounting)
        self._stale_ns = round(config.stale_ms * NS_PER_MS)
        self._up: Vector3 = (0.0, 0.0, 1.0)
        self._rate: Vector3 = (0.0, 0.0, 0.0)
        self._knows = False
        self._sample_ns: int | None = None
        self._newest: ImuSample | None = None
        self._changed_ns = 0

    def step(self, now_ns: int, sample: ImuSample | None) -> AttitudeReading:
        """Process the newest sample, or None without a new one; return the reading."""
        if sample is not None and not _is_unit(sample.quaternion):
            self.refused += 1
            sample = None
        if sample is not None:
            self._sample_ns = now_ns
            if sample != self._newest:
                self._newest, self._changed_ns = sample, now_ns
            self._knows = sample.valid
            if sample.valid:
                self._up = _rounded(
                    rotated(self._mounting, up_in_sensor(sample.quaternion)), POSITION
                )
                self._rate = _rounded(rotated(self._mounting, sample.rate), RATE)
        if self._sample_ns is None:
            return AttitudeReading(self._up, self._rate, valid=False, age_ns=-1)
        age_ns = now_ns - self._sample_ns
        fresh = age_ns <= self._stale_ns
        live = self._sample_ns - self._changed_ns < FROZEN_NS
        return AttitudeReading(self._up, self._rate, fresh and self._knows and live, age_ns)


def up_in_sensor(quaternion: Vector4) -> Vector3:
    """Return up in sensor axes: the third row of the quaternion's rotation, of unit length."""
    w, x, y, z = quaternion
    up = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z)
    length = math.hypot(*up)
    return (up[0] / length, up[1] / length, up[2] / length)


def _rounded(vector: Vector3, decimals: int) -> Vector3:
    x, y, z = vector
    return round(x, decimals), round(y, decimals), round(z, decimals)


def _is_unit(quaternion: Vector4) -> bool:
    return abs(math.hypot(*quaternion) - 1.0) <= UNIT_TOLERANCE
