"""Compute the wrench and its validity from leg forces (docs/law.md#harness). Pure.

- *Tare*: the mean leg forces over `tare_s` become the zero. A saturated or frozen cell, a gap
  longer than `stale_ms`, or forces that vary too much restart the tare. No wrench is valid before
  the tare is done. A constant load during the tare becomes part of the zero.
- *Low-pass*: first order at `low_pass_hz`, exact for any time between samples. The weight of a
  new sample therefore grows with the gap before it.
- *Saturation*: a sample with any raw leg force at or beyond `leg_force_max` is not used.
- *Staleness*: a sample is fresh while its age is at most `stale_ms`.
- *Frozen*: no wrench is valid while a cell has repeated its reading for `FROZEN_NS`. A working cell
  is noisy; a hung amplifier, a loose wire or a bus that repeats its last frame is not.
- *Not finite*: a sample with a number that is not finite is refused and counted.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
import numpy.typing as npt

from shared.bus.messages import Tare, Vector6
from shared.can.sensor_frames import as_sent
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import HarnessConfig
from shared.robot.stewart import N_LEGS, geometry_matrix

Array = npt.NDArray[np.float64]

_ZERO: Final[Array] = np.zeros(N_LEGS)

FROZEN_NS: Final = 100 * NS_PER_MS
"""Time without change after which a cell counts as frozen, ns: 25 samples."""
NEVER_NS = -1
"""Value of a time whose event has not happened yet."""


TARE_DEVIATION_MAX: Final = 3.0
"""Maximum standard deviation of a leg force during a tare, N: several times a cell's noise, and
less than a hand on the harness or a swaying robot causes."""


class FilterState(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """State of the filter; its arrays are never modified.

    The default is the state at power-up, which waits for the first sample of the tare.
    """

    tare: Tare = Tare.RUNNING
    tare_start_ns: int = NEVER_NS
    """Time of the first sample of the tare; `NEVER_NS` before it."""
    tare_count: int = 0
    tare_first: Array = _ZERO
    """(6,) raw leg forces of the first sample, N. The sums are relative to it, to stay small."""
    tare_sum: Array = _ZERO
    """(6,) sum of the differences between raw leg forces and `tare_first`, N."""
    tare_squares: Array = _ZERO
    """(6,) sum of the squares of these differences, N^2."""
    offset: Array = _ZERO
    """(6,) zero of the leg forces, N."""
    wrench: Array = _ZERO
    """(6,) last valid wrench after the low-pass, [N; N m]."""
    wrench_t_ns: int = NEVER_NS
    """Time of the last sample that `wrench` includes."""
    sample_t_ns: int = NEVER_NS
    """Time of the newest finite sample; `NEVER_NS` before the first."""
    raw: Array = _ZERO
    """(6,) leg forces of the newest finite sample, N."""
    changed_ns: Array = _ZERO
    """(6,) time of the last change of each leg force, ns."""
    frozen: bool = False
    """True if a leg force has not changed for `FROZEN_NS`."""
    saturated: bool = False
    """True if a leg force of the newest finite sample was saturated."""
    refused: int = 0
    """Number of samples that were not finite."""


class FilteredWrench(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """Output of the filter."""

    wrench: Array
    """(6,) [force in N; moment in N m], torso axes, about the harness point."""
    valid: bool
    """True if fresh, not saturated, not frozen and tared; otherwise `wrench` is the last valid
    wrench."""
    saturated: bool
    age_ns: int
    """Age of the newest finite sample; -1 before the first."""


def tared_state(offset: Array) -> FilterState:
    """Return the state of a sensor that is tared with the zero `offset` (6,), N."""
    return FilterState(tare=Tare.DONE, offset=offset)


def start_tare(state: FilterState) -> FilterState:
    """Return the state with a new tare started; unchanged while a tare runs."""
    return state if state.tare is not Tare.DONE else _begin_tare(state, Tare.RUNNING)


class WrenchFilter:
    """Filter of the leg forces, with its constants."""

    def __init__(self, config: HarnessConfig) -> None:
        """Derive the constants; raise ConfigError if the sensor's geometry is singular."""
        self._G = geometry_matrix(config.base_radius, config.platform_radius, config.height)
        self._cutoff = 2.0 * math.pi * config.low_pass_hz  # rad/s
        # The frames round a cell's largest reading to this float32.
        self._force_limit = as_sent(config.leg_force_max)
        self._stale_ns = round(config.stale_ms * NS_PER_MS)
        self._tare_ns = round(config.tare_s * NS_PER_S)

    def step(
        self, state: FilterState, now_ns: int, forces: Vector6 | None
    ) -> tuple[FilterState, FilteredWrench]:
        """Process the newest leg forces, N; None without a new sample. Return state and reading."""
        if forces is not None:
            state = self._add(state, now_ns, forces)
        seen = state.sample_t_ns != NEVER_NS
        age_ns = now_ns - state.sample_t_ns if seen else -1
        fresh = 0 <= age_ns <= self._stale_ns
        reading = FilteredWrench(
            wrench=state.wrench,
            valid=fresh and not state.saturated and not state.frozen and state.tare is Tare.DONE,
            saturated=state.saturated,
            age_ns=age_ns,
        )
        return state, reading

    def _add(self, state: FilterState, t_ns: int, sample: Vector6) -> FilterState:
        if not all(map(math.isfinite, sample)):
            return msgspec.structs.replace(state, refused=state.refused + 1)
        saturated = max(map(abs, sample)) >= self._force_limit
        forces = np.array(sample)
        changed_ns = np.where(forces == state.raw, state.changed_ns, t_ns)
        if state.sample_t_ns == NEVER_NS:
            changed_ns[:] = t_ns
        frozen = bool(t_ns - changed_ns.min() >= FROZEN_NS)
        state = msgspec.structs.replace(state, raw=forces, changed_ns=changed_ns, frozen=frozen)
        if state.tare is not Tare.DONE:
            state = self._tare(state, t_ns, forces, unusable=saturated or frozen)
        elif not (saturated or frozen):
            state = self._measure(state, t_ns, forces)
        return msgspec.structs.replace(state, sample_t_ns=t_ns, saturated=saturated)

    def _tare(self, state: FilterState, t_ns: int, forces: Array, *, unusable: bool) -> FilterState:
        gap = t_ns - state.sample_t_ns > self._stale_ns
        if unusable or gap:
            state = _begin_tare(state, state.tare)
        if unusable:
            return state
        if state.tare_start_ns == NEVER_NS:
            state = msgspec.structs.replace(state, tare_start_ns=t_ns, tare_first=forces)
        moved = forces - state.tare_first
        total = state.tare_sum + moved
        squares = state.tare_squares + moved * moved
        count = state.tare_count + 1
        if t_ns - state.tare_start_ns < self._tare_ns:
            return msgspec.structs.replace(
                state, tare_count=count, tare_sum=total, tare_squares=squares
            )
        mean = total / count
        if np.max(squares / count - mean * mean) > TARE_DEVIATION_MAX**2:
            return _begin_tare(state, Tare.UNSTEADY)
        return msgspec.structs.replace(
            state, tare=Tare.DONE, offset=state.tare_first + mean, wrench=_ZERO, wrench_t_ns=t_ns
        )

    def _measure(self, state: FilterState, t_ns: int, forces: Array) -> FilterState:
        dt = max(0, t_ns - state.wrench_t_ns) / NS_PER_S
        weight = -math.expm1(-self._cutoff * dt)
        wrench = state.wrench + weight * (self._G @ (forces - state.offset) - state.wrench)
        return msgspec.structs.replace(state, wrench=wrench, wrench_t_ns=t_ns)


def _begin_tare(state: FilterState, tare: Tare) -> FilterState:
    return msgspec.structs.replace(
        state,
        tare=tare,
        tare_start_ns=NEVER_NS,
        tare_count=0,
        tare_first=_ZERO,
        tare_sum=_ZERO,
        tare_squares=_ZERO,
    )
