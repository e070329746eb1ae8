"""Structs of the gain schedule that `xrl gains` writes beside the robot file."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import msgspec

from shared.toml_file import Range

Stiffness: TypeAlias = Annotated[float, Range(0.0, 1e4, "N m/rad")]
LegGains: TypeAlias = tuple[Stiffness, Stiffness, Stiffness, Stiffness, Stiffness, Stiffness]
"""(ankle phi, theta, knee phi, theta, hip phi, theta), N m/rad; both legs are alike."""


Damping: TypeAlias = Annotated[float, Range(0.0, 1e3, "N m s/rad")]
LegDamping: TypeAlias = tuple[Damping, Damping, Damping, Damping, Damping, Damping]


Bounds: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Minimum (phi, theta), maximum (phi, theta)."""


class ModuleBounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Bounds on the commands to one kind of module, over all poses and every assist."""

    k_p: Bounds
    """N m/rad; includes the stand gains, and the stiffest split: k_q_fraction_max times K_q."""
    k_d: Bounds
    """N m s/rad"""
    theta: tuple[float, float]
    """Range of theta, rad; each entry of `tau_ff` is for an equal part of it."""
    tau_ff: tuple[Bounds, ...]
    """N m, by theta, for both legs: the bounds of phi are symmetric."""
    v_ref: tuple[float, float]
    """rad/s, either way: joint rate in the body's fastest motions (`BODY_RATES`)."""


class GainSchedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Local joint stiffnesses over COM height and torso pitch; made by `xrl gains`."""

    version: int
    digest: str
    """SHA-256 of the inputs."""
    inputs: dict[str, Any]
    """The robot's parameters when this was computed, by dotted key."""
    z: tuple[float, ...]
    """COM heights of the nodes, m above the ankles, rising."""
    pitch: tuple[float, ...]
    """Torso pitches of the nodes, rad, rising."""
    D: tuple[tuple[LegGains, ...], ...]
    """Local stiffness at [z][pitch]."""
    D_B: LegDamping
    """Local damping, N m s/rad, the same in every pose."""
    coupling_bandwidth_hz: Annotated[float, Range(0.1, 100.0, "Hz")]
    """Bandwidth of the two poles of tau_coupled."""
    lead_easing: Annotated[float, Range(0.0, 0.95, "1")]
    """Maximum `law.lead_easing` with which the loop is stable; smaller values are stable too."""
    coupling_damping: Annotated[float, Range(0.0, 10.0, "1")]
    """Damping that the local gains and tau_coupled reach together, as a fraction of B_p."""
    bounds: dict[str, ModuleBounds] | None = None
    """By kind of module: the envelope of commands that a joint service accepts
    (`services.joint.envelope`). None: made by an older `xrl gains`; commands are not checked."""
