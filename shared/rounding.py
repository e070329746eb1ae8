"""Rounding of measured and computed numbers, so that messages are short. Pure.

Each constant is a number of decimals. An encoder counts 6e-5 turns of its motor, which move the
joint by 1e-5 rad.
"""

from __future__ import annotations

from typing import Final

TURNS: Final = 6
"""Decimals of a motor's position, turns; `services.joint.turn_watch` compares positions to 2e-5."""
POSITION: Final = 5
"""Decimals of lengths and angles, m and rad."""
RATE: Final = 4
"""Decimals of their rates, m/s, rad/s and turn/s."""
FORCE: Final = 3
"""Decimals of forces, torques, gains, loads and voltages, N, N m, N m/rad, kg and V."""
_PER_UNIT: Final = tuple(10.0**decimals for decimals in range(TURNS + 1))


def rounded(pair: tuple[float, float], decimals: int) -> tuple[float, float]:
    """Return two numbers, rounded to some decimals; NaN and infinity become NaN.

    It takes 0.2 us, and `round` on both 0.5 us.
    """
    per_unit = _PER_UNIT[decimals]
    a, b = pair
    return (a * per_unit + 0.5) // 1.0 / per_unit, (b * per_unit + 0.5) // 1.0 / per_unit
