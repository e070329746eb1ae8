"""The setpoint of each instant: TRACK follows the planner, HOLD freezes, DAMP sinks. Pure.

After a fall, a module in DAMP only damps; docs/hazards.md has the figures for this.

A change of mode freezes the present setpoint. The new mode starts from it, without a torque step.
"""

from __future__ import annotations

import msgspec

from services.joint import pd_law
from services.joint.failsafe import Failsafe
from services.joint.neighbours import UNKNOWN, NeighbourView
from services.joint.pd_law import Setpoint
from services.joint.sinking import Sinking, SinkingState
from shared.bus.messages import JointCommand, Mode, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig

# Compared in each cycle: docs/contributing.md, The control path.
_HOLD, _TRACK, _DAMP = Mode.HOLD, Mode.TRACK, Mode.DAMP


class SetpointState(msgspec.Struct, kw_only=True):
    """State of `SetpointLaw`."""

    frozen: Setpoint
    """Setpoint at the last change of mode: HOLD keeps it, TRACK blends from it."""
    current: Setpoint
    """Setpoint of the last cycle."""
    changed_ns: int = 0
    """Time of the last change of mode."""
    stiffened_ns: int = 0
    """Time at which the module began to stiffen because another may be limp, ns; 0 before."""
    sinking: SinkingState

    @property
    def stays(self) -> bool:
        """True in DAMP if the module does not sink: it is caught, or stiffened for a limp one."""
        return self.sinking.caught or self.sinking.held is not None


class SetpointLaw:
    """Chooses and blends a module's setpoints."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        service, stand = config.joint_service, config.stand_gains(module)
        self.stand_k_p, self.stand_k_d = stand.k_p, stand.k_d
        self._support_k_p, self._support_k_d = config.support_gains(module)
        self._hold_k_p, self._hold_k_d = config.hold_gains(module)
        self._hold_torque = config.envelope.hold_torque
        self._aging_max_s = service.command_aging_max_ms / 1e3
        self._coupled_ramp_ns = service.coupled_ramp_ms * NS_PER_MS
        self._blend_ns = service.blend_ms * NS_PER_MS
        self._stiffen_ns = service.stiffen_ms * NS_PER_MS
        self._limp_k_d = (service.fallen_k_d, service.fallen_k_d)
        self._sinking = Sinking(config, module)

    def at_rest(self) -> SetpointState:
        """Return the state of a module that has not been armed yet: at the stand gains."""
        here = pd_law.stand(pd_law.ZERO, self.stand_k_p, self.stand_k_d)
        return SetpointState(frozen=here, current=here, sinking=self._sinking.start())

    def age_s(self, command: JointCommand, now_ns: int) -> float:
        """Return the age, s, to which a command is extrapolated: docs/law.md (22)."""
        return min(self._aging_max_s, (now_ns - command.echo_t_ns) / NS_PER_S)

    def is_settled(self, s: SetpointState, now_ns: int) -> bool:
        """Return True if the blend after the last change of mode is over."""
        return now_ns - s.changed_ns >= self._blend_ns

    def start(self, s: SetpointState, mode: Mode, now_ns: int, setpoint: Setpoint) -> None:
        """Start a mode from a given setpoint, after DISARMED."""
        _note_change(s, mode, now_ns)
        s.frozen = s.current = setpoint

    def change(self, s: SetpointState, mode: Mode, now_ns: int, q: Pair) -> None:
        """Freeze the present setpoint for a new mode.

        Args:
            s: the setpoints, updated in place.
            mode: the new mode.
            now_ns: this module's monotonic clock.
            q: joint angles (phi, theta), rad.
        """
        _note_change(s, mode, now_ns)
        if mode is Mode.DAMP:
            s.frozen = self._sinking.begin(s.sinking, s.current, q)
        elif mode is Mode.HOLD:
            s.frozen = pd_law.limit_stiffening(s.current, q, self._hold_k_p, self._hold_torque)
        else:
            s.frozen = s.current

    def evaluate(
        self,
        s: SetpointState,
        now_ns: int,
        failsafe: Failsafe,
        q: Pair,
        near: NeighbourView = UNKNOWN,
    ) -> Setpoint:
        """Return the setpoint of this instant.

        Args:
            s: the setpoints, updated in place.
            now_ns: this module's monotonic clock.
            failsafe: mode and newest command.
            q: joint angles (phi, theta), rad.
            near: view of the other modules on this host.
        """
        mode = failsafe.mode
        if failsafe.limp and mode is _DAMP:
            share = min(1.0, (now_ns - s.changed_ns) / self._coupled_ramp_ns)
            limp_law = pd_law.stand(s.frozen.q_ref, pd_law.ZERO, self._limp_k_d)
            s.current = pd_law.blend(s.frozen, limp_law, share)
            return s.current
        limp = near.stiffen and (mode is _HOLD or mode is _DAMP)
        if not s.stiffened_ns and (limp or failsafe.stiffen_requested):
            s.stiffened_ns = now_ns
            if mode is _HOLD:
                self._bound_stiffening(s, now_ns, q)
        since_ns = now_ns - s.changed_ns
        if mode is _TRACK:
            s.current = self._tracked(s, now_ns, failsafe.command, since_ns)
        elif mode is _DAMP:
            near = near._replace(stiffen=s.stiffened_ns > 0)
            s.current = self._sinking.law(s.sinking, s.frozen, s.current, since_ns, q, near)
        else:
            s.current = self._held(s, since_ns)
            if s.stiffened_ns:
                risen = min(1.0, (now_ns - s.stiffened_ns) / self._stiffen_ns)
                s.current = pd_law.raise_gains(
                    s.current, self._support_k_p, self._support_k_d, risen
                )
        return s.current

    def _tracked(
        self, s: SetpointState, now_ns: int, command: JointCommand | None, since_ns: int
    ) -> Setpoint:
        """Return the planner's setpoint now, blended in from HOLD's."""
        assert command is not None  # noqa: S101 - TRACK is entered on fresh commands only
        fresh = pd_law.extrapolate(command, self.age_s(command, now_ns))
        if since_ns >= self._blend_ns:
            return fresh
        return pd_law.blend(self._held(s, since_ns), fresh, since_ns / self._blend_ns)

    def _bound_stiffening(self, s: SetpointState, now_ns: int, q: Pair) -> None:
        """Limit the torque that HOLD's springs add as they rise to their support gains.

        A hip with a soft theta may be far from its reference, because a hand has turned the torso.
        """
        held = self._held(s, now_ns - s.changed_ns)
        near = pd_law.limit_stiffening(held, q, self._support_k_p, self._hold_torque)
        if near is not held:
            s.frozen, s.changed_ns = near, now_ns

    def _held(self, s: SetpointState, since_ns: int) -> Setpoint:
        """Return HOLD's setpoint: the frozen one, with gains rising to at least HOLD's."""
        moving = max(0.0, 1.0 - since_ns / self._coupled_ramp_ns)
        risen = min(1.0, since_ns / self._stiffen_ns)
        frozen = pd_law.freeze(s.frozen, moving)
        return pd_law.raise_gains(frozen, self._hold_k_p, self._hold_k_d, risen)


def _note_change(s: SetpointState, mode: Mode, now_ns: int) -> None:
    s.changed_ns = now_ns
    if mode is not Mode.DAMP:
        s.stiffened_ns = 0
