"""Lines, discs and words on a picture, smooth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from PIL import ImageDraw, ImageFont

Point = tuple[float, float]
SCALE: Final = 2
"""Drawn larger and reduced, so that lines are smooth."""


class Canvas:
    """Drawing in pixels of the picture, on an image that is larger."""

    def __init__(self, draw: ImageDraw.ImageDraw) -> None:
        self._draw = draw

    def line(self, points: Sequence[Point], colour: str, width: float) -> None:
        """Draw a line through points."""
        self._draw.line(_scaled(points), fill=colour, width=round(width * SCALE), joint="curve")

    def polygon(self, points: Sequence[Point], colour: str) -> None:
        """Fill a polygon."""
        self._draw.polygon(_scaled(points), fill=colour)

    def disc(self, at: Point, radius: float, colour: str) -> None:
        """Fill a disc."""
        (x, y), r = at, radius
        self._draw.ellipse(_scaled([(x - r, y - r), (x + r, y + r)]), fill=colour)

    def arrow(self, at: Point, by: Point, colour: str) -> None:
        """Draw an arrow from a point by a vector; none that is shorter than a pixel."""
        length = float(np.hypot(*by))
        if length < 1.0:
            return
        x, y = at[0] + by[0], at[1] + by[1]
        ux, uy = by[0] / length, by[1] / length
        self.line([at, (x, y)], colour, 4.0)
        tip = [(x + 9 * ux, y + 9 * uy), (x - 7 * uy, y + 7 * ux), (x + 7 * uy, y - 7 * ux)]
        self.polygon(tip, colour)

    def text(self, at: Point, text: str, colour: str, size: int) -> None:
        """Write a text whose upper left corner is at a point."""
        font = ImageFont.load_default(size * SCALE)
        self._draw.text((at[0] * SCALE, at[1] * SCALE), text, fill=colour, font=font)


def _scaled(points: Sequence[Point]) -> list[Point]:
    return [(x * SCALE, y * SCALE) for x, y in points]
