"""Detects that an encoder may have missed whole turns of its motor. Pure.

The drive adds up differences of the encoder's angle within the turn, each the short way round. If
the encoder's words are missing, which is no error for up to 51 ms, the count does not change. If
the motor turns by more than half a turn meanwhile, the count is then wrong by whole turns; each
turn is 0.18 rad in phi and in theta. The angle within the turn cannot show that. The motion can: an
axis that stands exactly still right after fast motion has received no words. Its earlier speed and
`ACCELERATION` bound its motion since.

An encoder without power reads 0, which passes the parity check. The count then rests where the
angle within the turn is 0, and no error is ever reported. A live motor may rest there too: in 6 of
960 random crouches of 10 s, one of the twelve motors did. So while the drive is armed, turns count
as lost only if the estimate also jumped there, or if the motor's torque changes by more than
stiction but the estimate does not. While the drive is not armed, a rest there is enough, and the
drive stays unarmed.
"""

from __future__ import annotations

from typing import Final

import msgspec

from shared.clock import NS_PER_MS, NS_PER_S

ACCELERATION: Final = 400.0
"""Largest acceleration of a standing robot's motors, limp leg or not, turn/s^2 (measured: 144)."""
FADES: Final = 200.0
"""Rate at which the bounds of the speed approach the estimated speed, turn/s^2."""
STILL: Final = 2e-5
"""Largest change at rest, turns: a third of a count of 16384; estimates settle to within it."""
STILL_NS: Final = 4 * NS_PER_MS
"""Time without a change after which an estimate has stopped following its encoder, ns."""
SAMPLE_NS: Final = 4 * NS_PER_MS
"""Maximum time between samples, ns. If it is longer, the link failed and the drive still counts."""
SETTLES_S: Final = 0.008
"""Maximum time from the last word until the estimate rests, s."""
GAP_NS: Final = 53 * NS_PER_MS
"""Maximum gap in the words, ns: the drive reports a gap after 51 ms, so a longer rest is real."""
AT_ZERO: Final = 2e-4
"""Tolerance of `is_zero`, turns: three counts of 16384; float32 at the mark of 64 resolves 8e-6."""
JUMPED: Final = 1.0
"""Speed of the estimate, shortly before its rest, that shows a jump, turn/s: at the estimator's
bandwidth of 1000 rad/s, a jump of 0.003 turns or more. A smaller one is below 0.5 mrad at the
joint."""
PEAK_FADES: Final = 10.0
"""Decay of that speed, turn/s^2."""
STICTION: Final = 5.0
"""Change of tau_theta + tau_phi (second motor: tau_theta - tau_phi), N m, that moves a live motor
by more than `STILL`, through its friction and the drivetrain's flex."""
UNKNOWN: Final = -1.0
"""Value of `encoder_zero` before the drive has answered."""


class TurnWatch(msgspec.Struct):
    """History of one axis's estimates, turns and turn/s."""

    pos: float = 0.0
    changed_ns: int = 0
    """Time of the estimate's last change, ns; 0 before the first sample."""
    slowest: float = 0.0
    fastest: float = 0.0
    """Bounds of the speed that the motor may have had when the estimate came to rest."""
    newest_ns: int = 0
    peak: float = 0.0
    """Highest recent speed when the estimate last changed."""
    torque: float = 0.0
    """Torque of the motor at that time, as for `STICTION`."""
    encoder_zero: float = UNKNOWN
    """Position at which the encoder's angle within the turn is 0, modulo a turn."""
    moved: bool = False
    """True after an impossible jump while the module was not controlled, because of a new zero or
    missing turns. A new zero changes `encoder_zero`; a missing turn does not."""
    lost: bool = False
    """True if turns may be missing, until the drive's zero is cleared."""

    def process(
        self, t_ns: int, pos: float, vel: float, jump: float, free: float, torque: float | None
    ) -> bool:
        """Process a sample; return True if the motor may have reached it.

        Args:
            t_ns: time of the sample.
            pos: turns.
            vel: turn/s.
            jump: change since the last accepted sample, turns.
            free: largest possible jump if the encoder was read without gaps, turns.
            torque: of the motor, as for `STICTION`, N m; None while the drive is not armed.
        """
        dt_s = (t_ns - self.newest_ns) / NS_PER_S
        possible = -free <= jump <= free
        if self.changed_ns and abs(pos - self.pos) <= STILL:
            if t_ns - self.changed_ns > GAP_NS:
                self.slowest = self.fastest = 0.0
                dead = torque is None or self.peak > JUMPED or abs(torque - self.torque) > STICTION
                self.lost = self.lost or (dead and self.is_zero(pos))
        else:
            rested_ns = self.newest_ns - self.changed_ns
            if self.changed_ns and STILL_NS <= rested_ns <= GAP_NS:
                rested_ns += min(t_ns - self.newest_ns, SAMPLE_NS)
                possible = self._explain(jump, rested_ns / NS_PER_S) or possible
            self.pos, self.changed_ns, self.torque = pos, t_ns, torque or 0.0
            self.peak = max(abs(vel), self.peak - PEAK_FADES * dt_s)
            gains, fades = ACCELERATION * dt_s, FADES * dt_s
            slowest, fastest = self.slowest, self.fastest
            self.slowest = min(max(vel, slowest - gains), slowest + fades)
            self.fastest = max(min(vel, fastest + gains), fastest - fades)
        self.newest_ns = t_ns
        return possible

    def _explain(self, jump: float, rested_s: float) -> bool:
        """Return True if the motor may have made this jump unseen, during a rest of the estimate.

        Turns may be lost if a jump that is one turn longer or shorter is possible too.
        """
        longest_s = rested_s + SETTLES_S
        gained = 0.5 * ACCELERATION * longest_s + FADES * SETTLES_S
        least, most = self.slowest - gained, self.fastest + gained
        least *= longest_s if least < 0.0 else rested_s
        most *= longest_s if most > 0.0 else rested_s
        if jump + 1.0 <= most or jump - 1.0 >= least:
            self.lost = True
        return least <= jump <= most

    def is_zero(self, pos: float) -> bool:
        """Return True if the encoder's angle within the turn is 0 at a position, turns."""
        off = (pos - self.encoder_zero) % 1.0
        return self.encoder_zero != UNKNOWN and (off < AT_ZERO or off > 1.0 - AT_ZERO)

    def compare(self, encoder_zero: float) -> None:
        """Update the reported position at which the encoder reads 0, turns."""
        if self.moved and self.is_zero(encoder_zero):
            self.lost = True
        self.encoder_zero, self.moved = encoder_zero, False
