"""The interval of a share that was seen in some trials (E. B. Wilson, 1927)."""

from __future__ import annotations

import math
from typing import Final

Z_95: Final = 1.959964
"""Two-sided 95 % of a normal distribution, in standard deviations."""


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a share.

    It is one share's: of several intervals, the worst is missed more often than once in 20.

    Args:
        hits: how often it was so.
        of: trials, independent of each other; at least 1.
    """
    share, z2 = hits / of, Z_95 * Z_95
    middle = (share + z2 / (2 * of)) / (1.0 + z2 / of)
    half = Z_95 / (1.0 + z2 / of) * math.sqrt(share * (1.0 - share) / of + z2 / (4 * of * of))
    return max(0.0, middle - half), min(1.0, middle + half)
