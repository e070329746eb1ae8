"""Requirements on a run: limits of its figures, standing at its end, soundness throughout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.joint.trips import AT_LIMIT, SHAKE_ABOVE_HZ, SHAKE_S
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import JointEvent, JointState, Mode
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.logs.run_log import RunLog


class VerdictLimit(NamedTuple):
    """One row of the verdict table."""

    key: str
    limit: float
    unit: str
    what: str


LIMITS: Final = (
    VerdictLimit("alive_com_x_max_mm", 20.0, "mm", "COM x, led"),
    VerdictLimit("alive_com_y_max_mm", 10.0, "mm", "COM y, led"),
    VerdictLimit("alive_roll_max_rad", 0.02, "rad", "roll, led"),
    VerdictLimit("alive_yaw_max_rad", 0.02, "rad", "yaw, led"),
    VerdictLimit("alive_sole_tilt_max_rad", 0.02, "rad", "soles' tilt, led"),
    VerdictLimit("torque_at_limit_ms", 50.0, "ms", "module's torque at its limit, longest"),
    VerdictLimit("shaking_nm", 15.0, "N m", "torque above 8 Hz, root mean square"),
    VerdictLimit("sinking_m_s", 0.8, "m/s", "torso's fastest descent"),
    VerdictLimit("overforce_s", 1.0, "s", "hand's force over 100 N while led, longest"),
    VerdictLimit("operator_peak_n", 40.0, "N", "operator's force, led"),
    VerdictLimit("operator_side_peak_n", 60.0, "N", "operator's force sideways, led"),
    VerdictLimit("assist_error_n", 10.0, "N", "assist force against the request"),
    VerdictLimit("hold_com_x_max_mm", 80.0, "mm", "COM x, held"),
    VerdictLimit("hold_com_y_max_mm", 100.0, "mm", "COM y, held"),
    VerdictLimit("handover_max_ms", 65.0, "ms", "kill to HOLD, slowest module"),
    VerdictLimit("handover_torque_step_nm", 5.0, "N m", "torque step at hand-over"),
    VerdictLimit("reengage_s", 1.5, "s", "restart to TRACK, slowest module"),
    VerdictLimit("pd_cycles_late_pct", 0.5, "%", "PD cycles later than two periods"),
    VerdictLimit("fleet_cpu_pct", 160.0, "%", "CPU of all processes (100 %: one core)"),
    VerdictLimit("sequence_gaps", 0.0, "", "messages lost on the way to the log"),
)
"""Live targets. Only `Summary.sound` decides the exit code: the robot stands at the end of the run,
and stood soundly throughout (`SOUND`). `led`: before any kill and, in a run with network
impairments, only while all six modules track; `held`: at all other times. The consequences of a
stall of the machine count as neither (`tools.fleet.stalls`)."""

BY_KEY: Final = {row.key: row for row in LIMITS}

SOUND: Final = ("torque_at_limit_ms", "shaking_nm", "sinking_m_s", "overforce_s")
"""A run in which one of these exceeds its limit is not sound. A person who catches up with a robot
that held leads it down at up to 0.73 m/s (`bad_network`), which the limit of sinking allows."""


OVERFORCE_N: Final = 100.0
"""Force of the hand along z. A led robot yields to 20 N; a force over 100 N for longer than a
second means that it follows something else, such as a faulty harness sensor."""
SOLE_TILT_MAX: Final = 0.05
"""rad; a sole tilted by more than this does not settle on its own."""
TURNED_MAX: Final = 0.3
"""rad, roll and yaw of the torso; requests are at most 0.12."""
PITCH: Final = (-0.5, 1.6)
"""rad; a led pitch is 0 to 1.2, and a hand with 60 N m moves a holding torso by 0.3."""


def why_not_standing(row: SimTruth, robot: RobotConfig) -> str:
    """Return why the robot does not stand or is about to fall, or "" if it stands."""
    if row.fallen:
        return "it has fallen"
    (x, y), geometry = row.over, robot.geometry
    if abs(x) > geometry.l_foot / 2 or abs(y) > (geometry.w_base + geometry.w_foot) / 2:
        return f"its COM is beyond the soles, at {1e3 * x:.0f}, {1e3 * y:.0f} mm"
    tilt = max(row.foot_right_tilt, row.foot_left_tilt)
    if tilt > SOLE_TILT_MAX:
        return f"a sole is tilted by {tilt:.2f} rad"
    roll, pitch, yaw = row.angles
    if max(abs(roll), abs(yaw)) > TURNED_MAX or not PITCH[0] <= pitch <= PITCH[1]:
        return f"its torso has turned: roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} rad"
    return ""


BREAK_S: Final = 0.05
"""A longer gap between states interrupts a figure, s."""
SINK_OVER_S: Final = 0.1
"""Time over which sinking is measured, s; a sole's touchdown or a blow is faster."""
_HELD: Final = (Mode.HOLD, Mode.TRACK, Mode.DAMP)


class Soundness(NamedTuple):
    """The figures of `SOUND`; None where the log has no data."""

    torque_at_limit_ms: float | None = None
    shaking_nm: float | None = None
    sinking_m_s: float | None = None
    overforce_s: float | None = None


def soundness(log: RunLog, truth: Sequence[SimTruth], robot: RobotConfig) -> Soundness:
    """Return the figures of a run from the first row of `truth` onwards."""
    start_ns = truth[0].t_ns
    longest, shaking = [], []
    for module in MODULES:
        states: list[JointState] = [
            row for row in log.messages(topics.JOINT_STATE, module)
            if row.t_ns >= start_ns and row.mode in _HELD
        ]  # fmt: skip
        if len(states) < 2:
            continue
        t = np.array([row.t_ns for row in states])
        tau = np.array([row.tau for row in states])
        at_limit = np.abs(tau).sum(axis=1) >= AT_LIMIT * robot.joint.tau_module_max
        longest.append(_longest_s(t, at_limit))
        shaking.append(float(shaking_of(t, tau).max()))
    return Soundness(
        torque_at_limit_ms=1e3 * max(longest) if longest else None,
        shaking_nm=max(shaking) if shaking else None,
        sinking_m_s=_sinking(truth),
        overforce_s=_overforce_s(log, truth),
    )


def tracking(log: RunLog, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return, for each time, True if all six modules track."""
    track = np.ones(len(times_ns), dtype=bool)
    for module in MODULES:
        rows: list[JointEvent] = log.messages(topics.JOINT_EVENT, module)
        at = np.searchsorted([row.t_ns for row in rows], times_ns, side="right") - 1
        modes = np.array([row.mode_after for row in rows] or [Mode.DISARMED])
        track &= modes[at] == Mode.TRACK
    return track


def _overforce_s(log: RunLog, truth: Sequence[SimTruth]) -> float:
    t = np.array([row.t_ns for row in truth])
    force = np.abs([row.operator_force[2] for row in truth])
    return _longest_s(t, (force > OVERFORCE_N) & tracking(log, t))


def why_not_sound(figures: object) -> str:
    """Return the exceeded limits as text, or an empty string; `figures` has the fields `SOUND`."""
    return "; ".join(
        f"{row.what}: {value:.3g} {row.unit} (limit {row.limit:g})"
        for row in map(BY_KEY.__getitem__, SOUND)
        if (value := getattr(figures, row.key)) is not None and value > row.limit
    )


def shaking_of(t_ns: NDArray[np.int64], tau: Array) -> Array:
    """Return the root mean square above `SHAKE_ABOVE_HZ` (n, 2), N m, as in `services.joint.trips`.

    `tau` (n, 2), N m, is the torque of a module's axes at `t_ns` (n,).
    """
    slow, mean = tau[0].copy(), np.zeros(2)
    found = np.zeros_like(tau)
    dts = np.diff(t_ns, prepend=t_ns[0]) / NS_PER_S
    for index, (dt, now) in enumerate(zip(dts, tau, strict=True)):
        if dt > BREAK_S:
            slow, mean = now.copy(), np.zeros(2)
        slow += (1.0 - math.exp(-2.0 * math.pi * SHAKE_ABOVE_HZ * dt)) * (now - slow)
        mean += (1.0 - math.exp(-dt / SHAKE_S)) * ((now - slow) ** 2 - mean)
        found[index] = mean
    return np.sqrt(found)


def _longest_s(t_ns: NDArray[np.int64], true: NDArray[np.bool_]) -> float:
    """Return the longest uninterrupted time of True, s."""
    longest_ns, since_ns, last_ns = 0, -1, 0
    for at_ns, is_true in zip(t_ns.tolist(), true.tolist(), strict=True):
        broken, last_ns = at_ns - last_ns > BREAK_S * NS_PER_S, at_ns
        if broken or not is_true:
            since_ns = -1
        if not is_true:
            continue
        since_ns = at_ns if since_ns < 0 else since_ns
        longest_ns = max(longest_ns, at_ns - since_ns)
    return longest_ns / NS_PER_S


def _sinking(truth: Sequence[SimTruth]) -> float | None:
    """Return the fastest descent of the torso, m/s."""
    if len(truth) < 2:
        return None
    t = np.array([row.t_ns for row in truth])
    height = np.array([row.torso[2] for row in truth])
    later = np.searchsorted(t, t + round(SINK_OVER_S * 1e3) * NS_PER_MS)
    inside = later < len(t)
    if not inside.any():
        return None
    fallen = height[inside] - height[later[inside]]
    return max(0.0, float((fallen / ((t[later[inside]] - t[inside]) / NS_PER_S)).max()))
