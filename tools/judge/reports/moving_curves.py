"""Curves that grow beside the moving picture: the paper's Fig. 7 as an animation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from shared.clock import NS_PER_S
from tools.judge.reports.canvas import Canvas
from tools.judge.reports.scene import RobotPose

WIDTH: Final = 440
"""By which the picture is wider, px."""
TOP, HEIGHT, GAP = 66.0, 84.0, 22.0
LEFT, RIGHT = 64.0, 16.0


class CurvePanel(NamedTuple):
    """One panel: what it shows, and its lines' inks."""

    title: str
    values: Callable[[RobotPose], tuple[float, ...]]
    names: tuple[str, ...]
    least: float
    """Smallest span of its axis."""


PANELS: Final = (
    CurvePanel("COM, mm", lambda pose: (1e3 * pose.com[0], 1e3 * pose.com[1]), ("x", "y"), 20.0),
    CurvePanel("height, m", lambda pose: (pose.torso[2],), ("torso",), 0.1),
    CurvePanel("hand, N", lambda pose: (-pose.force[2],), ("robot on hand",), 20.0),
)


class Curves:
    """All panels of a run."""

    def __init__(
        self, poses: Sequence[RobotPose], began_ns: int, left: float, inks: Sequence[str], ink: str
    ) -> None:
        self._t = [(pose.t_ns - began_ns) / NS_PER_S for pose in poses]
        self._left, self._inks, self._ink = left + LEFT, inks, ink
        self._columns = [list(zip(*map(panel.values, poses), strict=True)) for panel in PANELS]
        self._ranges = [
            _range(columns, p.least) for columns, p in zip(self._columns, PANELS, strict=True)
        ]

    def draw(self, canvas: Canvas, number: int) -> None:
        """Draw all curves up to a frame."""
        for index, panel in enumerate(PANELS):
            top = TOP + index * (HEIGHT + GAP)
            low, high = self._ranges[index]
            for value in (low, high):
                y = self._y(value, index)
                canvas.line([(self._left, y), (self._left + self._width, y)], self._ink, 0.5)
                canvas.text((self._left - 46.0, y - 7.0), f"{value:.3g}", self._ink, 11)
            canvas.text((self._left, top - 17.0), panel.title, self._ink, 12)
            for line, name in enumerate(panel.names):
                canvas.text(
                    (self._left + 90.0 + 60.0 * line, top - 17.0), name, self._inks[line], 12
                )
                values = self._columns[index][line][: number + 1]
                points = [
                    (self._x(t), self._y(value, index))
                    for t, value in zip(self._t, values, strict=False)
                ]
                if len(points) > 1:
                    canvas.line(points, self._inks[line], 1.6)
        x, bottom = self._x(self._t[number]), TOP + len(PANELS) * (HEIGHT + GAP) - GAP
        canvas.line([(x, TOP), (x, bottom)], self._ink, 0.5)
        canvas.text((x - 12.0, bottom + 4.0), f"{self._t[number]:.1f} s", self._ink, 11)

    @property
    def _width(self) -> float:
        return WIDTH - LEFT - RIGHT

    def _x(self, t: float) -> float:
        begin, end = self._t[0], self._t[-1]
        return self._left + self._width * (t - begin) / max(1e-9, end - begin)

    def _y(self, value: float, index: int) -> float:
        low, high = self._ranges[index]
        top = TOP + index * (HEIGHT + GAP)
        return top + HEIGHT * (high - value) / (high - low)


def _range(columns: Sequence[Sequence[float]], least: float) -> tuple[float, float]:
    """Return a panel's limits: its values and a margin, at least so far apart."""
    low = min(min(column) for column in columns)
    high = max(max(column) for column in columns)
    more = max(0.05 * (high - low), 0.5 * (least - (high - low)))
    return low - more, high + more
