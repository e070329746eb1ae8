"""Whether an encoder may have missed whole turns of its motor. Pure.

The drive adds up differences of the encoder's angle within the turn, each the short way round. When
no words come, for up to 51 ms without an error, the count stays where it was. After more than half
a turn it goes on the wrong way, and the joint is 0.18 rad off in phi and in theta. The angle within
the turn cannot show that: the count is off by whole turns. The motion can. An axis that stands
exactly still right after it was fast has had no words; how far it may have gone since is bounded by
its speed before and `ACCELERATION`.

An encoder without power reads 0, which passes the parity check: the count then rests where the
angle within the turn is 0, and no error ever comes.
"""

from __future__ import annotations

from typing import Final

import msgspec

from shared.clock import NS_PER_MS, NS_PER_S

ACCELERATION: Final = 400.0
"""turn/s^2: a motor's largest while the robot stands or one leg is limp (144 was measured)."""
FADES: Final = 200.0
"""turn/s^2: how fast bounds of the speed follow it inwards."""
STILL: Final = 2e-5
"""turns: a third of a count of 16384, to which the estimate settles after the last word."""
STILL_NS: Final = 4 * NS_PER_MS
"""An estimate that has not changed for so long does not follow an encoder."""
SAMPLE_NS: Final = 4 * NS_PER_MS
"""A longer time without a sample is the link's: the drive counts on."""
SETTLES_S: Final = 0.008
"""s: the estimate rests so long after the last word at most."""
GAP_NS: Final = 53 * NS_PER_MS
"""A longer gap the drive reports itself, after 51 ms; a longer rest without an error is one."""
AT_ZERO: Final = 2e-4
"""turns: three counts of 16384. Single precision at the mark of 64 turns resolves 8e-6."""
UNKNOWN: Final = -1.0
"""Value of `encoder_zero` before the drive has answered."""


class TurnWatch(msgspec.Struct):
    """What one axis's estimates have shown, turns and turn/s."""

    pos: float = 0.0
    changed_ns: int = 0
    """Since when the estimate is what it is; 0: nothing has been seen."""
    slowest: float = 0.0
    fastest: float = 0.0
    """Bounds of the speed that the motor may have had when the estimate came to rest."""
    newest_ns: int = 0
    encoder_zero: float = UNKNOWN
    """Where the encoder's angle within the turn is 0, modulo a turn."""
    moved: bool = False
    """It went further than it can while nobody controlled it: by a new zero, or by turns that are
    missing. A count that is set moves `encoder_zero`, a missing turn does not."""
    lost: bool = False
    """Turns may be missing, until the drive has no zero any more."""

    def take(self, t_ns: int, pos: float, vel: float, jump: float, free: float) -> bool:
        """Take a sample; return True if the motor can have come there.

        Args:
            t_ns: its time.
            pos: turns.
            vel: turn/s.
            jump: from the sample that was accepted last, turns.
            free: largest jump of a motor whose encoder was read all the time, turns.
        """
        dt_s = (t_ns - self.newest_ns) / NS_PER_S
        possible = -free <= jump <= free
        if self.changed_ns and abs(pos - self.pos) <= STILL:
            if t_ns - self.changed_ns > GAP_NS:
                self.slowest = self.fastest = 0.0
                self.lost = self.lost or self.is_zero(pos)
        else:
            rested_ns = self.newest_ns - self.changed_ns
            if self.changed_ns and STILL_NS <= rested_ns <= GAP_NS:
                rested_ns += min(t_ns - self.newest_ns, SAMPLE_NS)
                possible = self._explain(jump, rested_ns / NS_PER_S) or possible
            self.pos, self.changed_ns = pos, t_ns
            gains, fades = ACCELERATION * dt_s, FADES * dt_s
            slowest, fastest = self.slowest, self.fastest
            self.slowest = min(max(vel, slowest - gains), slowest + fades)
            self.fastest = max(min(vel, fastest + gains), fastest - fades)
        self.newest_ns = t_ns
        return possible

    def _explain(self, jump: float, rested_s: float) -> bool:
        """Return True if a jump after a rest is one way that the motor may have gone unseen.

        It has lost turns if another way, a turn longer or shorter, is possible too.
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
        """Take where the drive says that the encoder reads 0, turns."""
        if self.moved and self.is_zero(encoder_zero):
            self.lost = True
        self.encoder_zero, self.moved = encoder_zero, False
