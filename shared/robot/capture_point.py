"""Where the body would come to rest as an inverted pendulum. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from shared.bus.messages import Pair
from shared.config.robot_config import GRAVITY


def capture_point(p: Sequence[float], pdot: Sequence[float], slope: Pair = (0.0, 0.0)) -> Pair:
    """Return x and y, m, from midway between the ankles: x - slope z + x' sqrt(z / g).

    Args:
        p: pose, COM x y z first, m; z > 0.
        pdot: its rate, m/s.
        slope: rise of the floor along x and y, rad; uphill of the ankles the COM is over them.
    """
    swing = math.sqrt(p[2] / GRAVITY)
    return p[0] - slope[0] * p[2] + swing * pdot[0], p[1] - slope[1] * p[2] + swing * pdot[1]
