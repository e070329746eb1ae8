"""How soundly a robot stood, from its log: torques at their limit, shaking, sinking."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.joint.trips import AT_LIMIT, SHAKE_ABOVE_HZ, SHAKE_S
from shared.bus import topics
from shared.bus.messages import JointState, Mode, SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.judge.verdict_limits import LIMITS, SOUND
from tools.logs.run_log import RunLog

Array = NDArray[np.float64]

BREAK_S: Final = 0.05
"""Longest gap between states; within a longer one nothing is known."""
SINK_OVER_S: Final = 0.1
"""A sole's touch or a blow is faster, and no sinking."""
_HELD: Final = (Mode.HOLD, Mode.TRACK, Mode.DAMP)


def soundness(log: RunLog, truth: Sequence[SimTruth], robot: RobotConfig) -> dict[str, Any]:
    """Return the figures of a run from its first row on; None where the log has no data."""
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
    return {
        "torque_at_limit_ms": 1e3 * max(longest) if longest else None,
        "shaking_nm": max(shaking) if shaking else None,
        "sinking_m_s": _sinking(truth),
    }


def why_not_sound(figures: Mapping[str, Any]) -> str:
    """Return the exceeded limits as text; "" if none is."""
    rows = (row for row in LIMITS if row.key in SOUND)
    over = [row for row in rows if (figures.get(row.key) or 0.0) > row.limit]
    return "; ".join(
        f"{row.what}: {figures[row.key]:.3g} {row.unit} (limit {row.limit:g})" for row in over
    )


def shaking_of(t_ns: NDArray[np.int64], tau: Array) -> Array:
    """Return the root mean square above `SHAKE_ABOVE_HZ` (n, 2), N m, as `services.joint.trips`.

    `tau` (n, 2), N m, is that of a module's axes at `t_ns` (n,).
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
    """Return the longest time without a break, s."""
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
    """Return the fastest way down of the torso, m/s."""
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
