"""Computes how far the robot has drifted with nobody's hand on it. Pure.

Height and pitch are open: only the person's hand holds them. With nobody there, any error of the
feedforward carries the robot away, to straight or folded legs or a tipped torso. The planner
therefore stays engaged only while a hand is felt, or while the robot stays in place by itself.

    drift = max(|z - z0|, ARM |pitch - pitch0|)       z0, pitch0: when the hand was lost
"""

from __future__ import annotations

from typing import Final

import msgspec

from shared.bus.messages import Pair
from shared.clock import NS_PER_S

HAND_MIN: Final = (3.0, 1.0)
"""N and N m; noise and zero errors are smaller, a leading hand is stronger (dry friction alone
takes 6 N)."""
HAND_LOST_NS: Final = NS_PER_S // 2
"""ns; a hand that brakes the robot's inertia with its friction is not felt for up to 0.3 s."""
ARM: Final = 0.25
"""m per rad of the torso's pitch."""


class UnattendedState(msgspec.Struct):
    """State of `Unattended`."""

    felt_ns: int = 0
    """Time at which a hand was last felt."""
    left: Pair | None = None
    """Pose in which it left the robot: height of the COM, m, and the torso's pitch, rad."""


class Unattended:
    """Keeps the pose at which a hand was last felt."""

    def __init__(self) -> None:
        self.state = UnattendedState()

    def drift(self, now_ns: int, pose: Pair, force: float, moment: float) -> float:
        """Return the drift, m.

        Args:
            now_ns: the planner's clock.
            pose: height of the COM, m, and the torso's pitch, rad.
            force: upward, of the person on the robot, N; NaN if not known, which counts as a hand.
            moment: of the person about pitch, N m.
        """
        state = self.state
        felt = not (abs(force) < HAND_MIN[0] and abs(moment) < HAND_MIN[1])
        if felt:
            state.felt_ns = now_ns
        if state.left is None or now_ns - state.felt_ns <= HAND_LOST_NS:
            state.left = pose
        return max(abs(pose[0] - state.left[0]), ARM * abs(pose[1] - state.left[1]))
