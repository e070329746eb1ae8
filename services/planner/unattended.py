"""How far the robot has drifted with nobody's hand on it. Pure.

Height and pitch are open: nothing but the person's hand holds them, so that with nobody there any
error of the feedforward carries the robot away: to straight or folded legs, and the torso over. It
is led only while a hand is felt, or where it stays by itself.

    drift = max(|z - z0|, ARM |pitch - pitch0|)       z0, pitch0: when the hand left it
"""

from __future__ import annotations

from typing import Final

from services.planner.snapshots import UnattendedState
from shared.bus.messages import Pair
from shared.clock import NS_PER_S

FELT: Final = (3.0, 1.0)
"""N and N m: noise and a zero that is off are less, a hand that leads is more
(dry friction alone takes 6 N)."""
LET_GO_NS: Final = NS_PER_S // 2
"""A hand that brakes the robot's inertia with its friction is not felt for up to 0.3 s."""
ARM: Final = 0.25
"""m per rad of the torso's pitch."""


class Unattended:
    """Keeps where a hand was on it last."""

    def __init__(self) -> None:
        """Begin with nobody felt."""
        self._memory = UnattendedState()

    def drift(self, now_ns: int, pose: Pair, force: float, moment: float) -> float:
        """Return the drift, m.

        Args:
            now_ns: the planner's clock.
            pose: height of the COM, m, and the torso's pitch, rad.
            force: upward, of the person on the robot, N; NaN: not known, which is taken for a hand.
            moment: of the person about pitch, N m.
        """
        memory = self._memory
        felt = not (abs(force) < FELT[0] and abs(moment) < FELT[1])
        felt_ns = now_ns if felt else memory.felt_ns
        left = memory.left if memory.left is not None and now_ns - felt_ns > LET_GO_NS else pose
        self._memory = UnattendedState(felt_ns, left)
        return max(abs(pose[0] - left[0]), ARM * abs(pose[1] - left[1]))

    def snapshot(self) -> UnattendedState:
        """Return the state."""
        return self._memory

    def restore(self, memory: UnattendedState) -> None:
        """Continue from a state."""
        self._memory = memory
