"""From leg forces to a wrench that can be trusted: tare, low-pass, saturation, staleness.

Pure: a state, the time and a sample go in, the next state and a reading come out
(design section 3 f). The rules:

- *Tare*: the mean leg forces over `tare_s` become the zero. A saturated cell, or a gap
  longer than `stale_ms`, begins it anew. Nothing is valid until it is done.
- *Low-pass*: first order at `low_pass_hz`, exact for any time between samples. After a
  gap it therefore weighs the new sample as much as the gap was long.
- *Saturation*: a sample with any raw leg force at or beyond `leg_force_max` is not used.
- *Staleness*: a sample is fresh while its age is at most `stale_ms`.
- A sample with a number that is not finite is refused and counted, as if it never came.
"""

from __future__ import annotations

import math
from enum import IntEnum

import msgspec
import numpy as np
import numpy.typing as npt

from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import HarnessConfig
from shared.loadcell_can import LegSample, as_sent
from shared.stewart import N_LEGS, geometry_matrix

Array = npt.NDArray[np.float64]

NEVER_NS = -1
"""Stands for the time of something that has not happened."""


class Phase(IntEnum):
    """What the samples are used for."""

    TARING = 0
    MEASURING = 1


class FilterState(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """All that the filter remembers; its arrays are never written to."""

    phase: Phase
    tare_start_ns: int
    """Time of the first sample of the tare; `NEVER_NS` before it."""
    tare_count: int
    tare_sum: Array
    """(6,) sum of the raw leg forces since then, N."""
    offset: Array
    """(6,) leg forces that count as zero, N."""
    wrench: Array
    """(6,) last good wrench after the low-pass, [N; N m]."""
    wrench_t_ns: int
    """Time of the last sample that went into it."""
    sample_t_ns: int
    """Time of the newest finite sample; `NEVER_NS` before the first."""
    saturated: bool
    """True if a leg of that sample was saturated."""
    refused: int
    """Samples that were not finite."""


class Reading(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """What the filter says at one moment."""

    wrench: Array
    """(6,) [force in N; moment in N m], torso axes, about the harness point."""
    valid: bool
    """True if fresh, not saturated and tared; otherwise the wrench is the last good one."""
    saturated: bool
    age_ns: int
    """Age of the newest finite sample; -1 before the first."""


def initial_state() -> FilterState:
    """Return the state at power-up: waiting for the first sample of the tare."""
    return FilterState(
        phase=Phase.TARING,
        tare_start_ns=NEVER_NS,
        tare_count=0,
        tare_sum=np.zeros(N_LEGS),
        offset=np.zeros(N_LEGS),
        wrench=np.zeros(6),
        wrench_t_ns=NEVER_NS,
        sample_t_ns=NEVER_NS,
        saturated=False,
        refused=0,
    )


def start_tare(state: FilterState) -> FilterState:
    """Return the state with the tare begun anew; the harness must be unloaded."""
    return msgspec.structs.replace(
        state,
        phase=Phase.TARING,
        tare_start_ns=NEVER_NS,
        tare_count=0,
        tare_sum=np.zeros(N_LEGS),
    )


class WrenchFilter:
    """The constants of the filter and its one step."""

    def __init__(self, config: HarnessConfig) -> None:
        """Derive the constants.

        Raises:
            ConfigError: the sensor's geometry is singular.
        """
        self._G = geometry_matrix(config.base_radius, config.platform_radius, config.height)
        self._cutoff = 2.0 * math.pi * config.low_pass_hz  # rad/s
        # A cell at the end of its range reads this after its trip through float32.
        self._force_limit = as_sent(config.leg_force_max)
        self._stale_ns = round(config.stale_ms * NS_PER_MS)
        self._tare_ns = round(config.tare_s * NS_PER_S)

    def step(
        self, state: FilterState, now_ns: int, sample: LegSample | None
    ) -> tuple[FilterState, Reading]:
        """Take the newest sample, or None if there is none, and say what holds now."""
        if sample is not None:
            state = self._take(state, sample)
        seen = state.sample_t_ns != NEVER_NS
        age_ns = now_ns - state.sample_t_ns if seen else -1
        fresh = 0 <= age_ns <= self._stale_ns
        reading = Reading(
            wrench=state.wrench,
            valid=fresh and not state.saturated and state.phase is Phase.MEASURING,
            saturated=state.saturated,
            age_ns=age_ns,
        )
        return state, reading

    def _take(self, state: FilterState, sample: LegSample) -> FilterState:
        if not all(map(math.isfinite, sample.forces)):
            return msgspec.structs.replace(state, refused=state.refused + 1)
        saturated = max(map(abs, sample.forces)) >= self._force_limit
        forces = np.array(sample.forces)
        if state.phase is Phase.TARING:
            state = self._tare(state, sample.t_ns, forces, saturated)
        elif not saturated:
            state = self._measure(state, sample.t_ns, forces)
        return msgspec.structs.replace(state, sample_t_ns=sample.t_ns, saturated=saturated)

    def _tare(self, state: FilterState, t_ns: int, forces: Array, saturated: bool) -> FilterState:
        gap = t_ns - state.sample_t_ns > self._stale_ns
        if saturated or gap:
            state = start_tare(state)
        if saturated:
            return state
        start_ns = t_ns if state.tare_start_ns == NEVER_NS else state.tare_start_ns
        total = state.tare_sum + forces
        count = state.tare_count + 1
        if t_ns - start_ns < self._tare_ns:
            return msgspec.structs.replace(
                state, tare_start_ns=start_ns, tare_count=count, tare_sum=total
            )
        return msgspec.structs.replace(
            state,
            phase=Phase.MEASURING,
            offset=total / count,
            wrench=np.zeros(6),
            wrench_t_ns=t_ns,
        )

    def _measure(self, state: FilterState, t_ns: int, forces: Array) -> FilterState:
        dt = max(0, t_ns - state.wrench_t_ns) / NS_PER_S
        weight = -math.expm1(-self._cutoff * dt)
        wrench = state.wrench + weight * (self._G @ (forces - state.offset) - state.wrench)
        return msgspec.structs.replace(state, wrench=wrench, wrench_t_ns=t_ns)
