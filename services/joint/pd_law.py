"""The local law of one module: diagonal PD plus feedforward (docs/law.md#references-and-age).

A `Setpoint` is the law at one instant. A blend of two setpoints is again a PD law, with blended
gains, so a drive's own loop can apply it at any moment of a change of mode. Pure.
"""

from __future__ import annotations

import msgspec

from shared.bus.messages import JointCommand, Pair

ZERO: Pair = (0.0, 0.0)


class Setpoint(msgspec.Struct, gc=False, frozen=True):
    """PD law of the two axes (phi, theta) at one instant."""

    q_ref: Pair
    """rad"""
    v_ref: Pair
    """rad/s"""
    tau_ff: Pair
    """N m"""
    tau_coupled: Pair
    """N m"""
    k_p: Pair
    """N m/rad"""
    k_d: Pair
    """N m s/rad"""


def torque(setpoint: Setpoint | JointCommand, q: Pair, v: Pair) -> Pair:
    """Return tau = k_p (q_ref - q) + k_d (v_ref - v) + tau_ff + tau_coupled, N m.

    This is docs/law.md (13). For a command it is the torque at age zero.
    """
    s = setpoint
    return (
        s.k_p[0] * (s.q_ref[0] - q[0])
        + s.k_d[0] * (s.v_ref[0] - v[0])
        + s.tau_ff[0]
        + s.tau_coupled[0],
        s.k_p[1] * (s.q_ref[1] - q[1])
        + s.k_d[1] * (s.v_ref[1] - v[1])
        + s.tau_ff[1]
        + s.tau_coupled[1],
    )


def extrapolate(command: JointCommand, age_s: float) -> Setpoint:
    """Return the command's law at an age, extrapolated by its rates: docs/law.md (21).

    Args:
        command: references and rates at age zero.
        age_s: age in s, already capped by `joint_service.command_aging_max_ms`.
    """
    c = command
    return Setpoint(
        (c.q_ref[0] + c.v_ref[0] * age_s, c.q_ref[1] + c.v_ref[1] * age_s),
        c.v_ref,
        (c.tau_ff[0] + c.dtau_ff[0] * age_s, c.tau_ff[1] + c.dtau_ff[1] * age_s),
        c.tau_coupled,
        c.k_p,
        c.k_d,
    )


def stand(q: Pair, k_p: Pair, k_d: Pair) -> Setpoint:
    """Return the law for standing at q without a planner."""
    return Setpoint(q, ZERO, ZERO, ZERO, k_p, k_d)


def take_over(q: Pair, v: Pair, tau: Pair, k_p: Pair, k_d: Pair) -> Setpoint:
    """Return the law for standing at q that gives tau at rate v; v_ref fades once it is frozen."""
    return Setpoint(q, v, tau, ZERO, k_p, k_d)


def freeze(setpoint: Setpoint, moving_share: float) -> Setpoint:
    """Return a frozen setpoint: q_ref, tau_ff and gains stay, the rest fades.

    Args:
        setpoint: the setpoint when the references froze.
        moving_share: remaining fraction of v_ref and tau_coupled, 1 .. 0. v_ref fades too, because
            in mid-squat k_d v_ref is 10 N m, and dropping it at once would be a jolt.
    """
    s, share = setpoint, moving_share
    if share <= 0.0:
        return Setpoint(s.q_ref, ZERO, s.tau_ff, ZERO, s.k_p, s.k_d)
    v_ref = (s.v_ref[0] * share, s.v_ref[1] * share)
    coupled = (s.tau_coupled[0] * share, s.tau_coupled[1] * share)
    return Setpoint(s.q_ref, v_ref, s.tau_ff, coupled, s.k_p, s.k_d)


def raise_gains(setpoint: Setpoint, k_p: Pair, k_d: Pair, share: float) -> Setpoint:
    """Return a setpoint whose lower gains have risen towards k_p and k_d by `share` of the gap.

    `share` is 0 .. 1. Gains never fall, because a larger D only adds stiffness.
    """
    s = setpoint
    return Setpoint(
        s.q_ref,
        s.v_ref,
        s.tau_ff,
        s.tau_coupled,
        (
            s.k_p[0] + share * max(0.0, k_p[0] - s.k_p[0]),
            s.k_p[1] + share * max(0.0, k_p[1] - s.k_p[1]),
        ),
        (
            s.k_d[0] + share * max(0.0, k_d[0] - s.k_d[0]),
            s.k_d[1] + share * max(0.0, k_d[1] - s.k_d[1]),
        ),
    )


def limit_stiffening(setpoint: Setpoint, q: Pair, k_p: Pair, added_max: float) -> Setpoint:
    """Return a setpoint for which stiffening adds at most `added_max` to a spring's torque.

    An axis too far from its reference holds its position instead. Its spring's torque becomes
    feedforward, so the torque does not change.

    Args:
        setpoint: the present setpoint.
        q: joint angles, rad.
        k_p: gains to which the setpoint will rise, N m/rad.
        added_max: maximum torque that stiffening may add to a spring, N m.
    """
    s = setpoint
    away = (s.q_ref[0] - q[0], s.q_ref[1] - q[1])
    far = (
        (k_p[0] - s.k_p[0]) * abs(away[0]) > added_max,
        (k_p[1] - s.k_p[1]) * abs(away[1]) > added_max,
    )
    if far == (False, False):
        return s
    carried = load_to_feedforward(s, far, q)
    q_ref = (q[0] if far[0] else s.q_ref[0], q[1] if far[1] else s.q_ref[1])
    return Setpoint(q_ref, s.v_ref, carried.tau_ff, s.tau_coupled, s.k_p, s.k_d)


def load_to_feedforward(setpoint: Setpoint, sinks: tuple[bool, bool], q: Pair) -> Setpoint:
    """Return a setpoint in which the sinking axes carry their load as feedforward.

    DAMP removes the springs of these axes, but not the load. A robot that stands without a planner
    has no other feedforward that could fade.

    Args:
        setpoint: the present setpoint.
        sinks: for (phi, theta), True if the axis sinks.
        q: joint angles, rad.
    """
    s = setpoint
    tau_ff = (
        s.tau_ff[0] + (s.k_p[0] * (s.q_ref[0] - q[0]) if sinks[0] else 0.0),
        s.tau_ff[1] + (s.k_p[1] * (s.q_ref[1] - q[1]) if sinks[1] else 0.0),
    )
    return Setpoint(s.q_ref, s.v_ref, tau_ff, s.tau_coupled, s.k_p, s.k_d)


def damp(
    setpoint: Setpoint,
    sinks: tuple[bool, bool],
    k_d: float,
    feedforward_share: float,
    risen: float,
) -> Setpoint:
    """Return DAMP's law: axes that sink lose their stiffness, the others hold.

    Args:
        setpoint: from `load_to_feedforward`, with rates and coupling faded.
        sinks: for (phi, theta), True if the axis sinks.
        k_d: damping of an axis that sinks, N m s/rad.
        feedforward_share: remaining fraction of such an axis's feedforward, 1 .. 0.
        risen: progress of its damping to k_d, 0 .. 1.
    """
    s, share = setpoint, feedforward_share
    phi, theta = sinks
    return Setpoint(
        s.q_ref,
        s.v_ref,
        (s.tau_ff[0] * (share if phi else 1.0), s.tau_ff[1] * (share if theta else 1.0)),
        s.tau_coupled,
        (0.0 if phi else s.k_p[0], 0.0 if theta else s.k_p[1]),
        (
            s.k_d[0] + risen * (k_d - s.k_d[0]) if phi else s.k_d[0],
            s.k_d[1] + risen * (k_d - s.k_d[1]) if theta else s.k_d[1],
        ),
    )


def hold_theta(setpoint: Setpoint, q_ref: float, v_ref: float, k_p: float, k_d: float) -> Setpoint:
    """Return DAMP's law with theta held at q_ref; rad, rad/s, N m/rad, N m s/rad."""
    s = setpoint
    return Setpoint(
        (s.q_ref[0], q_ref),
        (s.v_ref[0], v_ref),
        s.tau_ff,
        s.tau_coupled,
        (s.k_p[0], k_p),
        (s.k_d[0], k_d),
    )


def blend(a: Setpoint, b: Setpoint, share: float) -> Setpoint:
    """Return the PD law with (1 - share) of a's torque plus share of b's, at every q and v."""
    k_p = _mix(a.k_p, b.k_p, share)
    k_d = _mix(a.k_d, b.k_d, share)
    return Setpoint(
        _mix_weighted(a.q_ref, b.q_ref, a.k_p, b.k_p, k_p, share),
        _mix_weighted(a.v_ref, b.v_ref, a.k_d, b.k_d, k_d, share),
        _mix(a.tau_ff, b.tau_ff, share),
        _mix(a.tau_coupled, b.tau_coupled, share),
        k_p,
        k_d,
    )


def _mix(a: Pair, b: Pair, share: float) -> Pair:
    return (a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share)


def _mix_weighted(a: Pair, b: Pair, w_a: Pair, w_b: Pair, w: Pair, share: float) -> Pair:
    """Mix two references by share and gain; without any gain, the reference is b."""
    rest = 1.0 - share
    return (
        (rest * w_a[0] * a[0] + share * w_b[0] * b[0]) / w[0] if w[0] > 0.0 else b[0],
        (rest * w_a[1] * a[1] + share * w_b[1] * b[1]) / w[1] if w[1] > 0.0 else b[1],
    )
