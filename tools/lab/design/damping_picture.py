"""Eigenvalue paths of the sampled loop over the drivetrain's stiffness, as a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from shared.config.robot_config import RobotConfig
from shared.extras import late
from tools.lab.design.dynamic_certificate import (
    HALF_NAMES,
    Condition,
    Design,
    DynamicCertificate,
    StiffnessNode,
)
from tools.lab.design.sampled_loop import NO_HAND, NOMINAL
from tools.output import new_figure, save_figure

if TYPE_CHECKING:
    import matplotlib as mpl
else:
    mpl = late("matplotlib")

STIFFNESSES: Final = tuple(float(k) for k in np.geomspace(2e3, 2e5, 25))
DELAYS_MS: Final = (2.0, 20.0)
FREQUENCY_HZ: Final = (0.1, 125.0)
"""Hz; half of the planner's rate, the highest frequency that its samples show."""


def draw(robot: RobotConfig, nodes: list[StiffnessNode], design: Design, path: Path) -> None:
    """Draw decay over frequency of every motion while the planner leads, into a PNG file.

    The first, the middle and the last of the poses are drawn.
    """
    certificate = DynamicCertificate(robot, nodes)
    figure = new_figure(13, 6)
    colours = mpl.colormaps["viridis"]
    period = 1.0 / robot.planner.rate_hz
    for half, axis in enumerate(figure.subplots(1, 2, sharey=True)):
        for node in (nodes[0], nodes[len(nodes) // 2], nodes[-1]):
            for delay_ms, marker in zip(DELAYS_MS, ("o", "x"), strict=True):
                for index, k in enumerate(STIFFNESSES):
                    case = Condition("TRACK", node, half, k, delay_ms / 1e3, NO_HAND, NOMINAL)
                    values = certificate.loop(case, design).eigenvalues()
                    values = values[np.abs(values) > 1e-3]
                    hz = np.abs(np.angle(values)) / (2.0 * math.pi * period)
                    decay = -np.log(np.abs(values)) / period
                    shown = hz > FREQUENCY_HZ[0]
                    axis.scatter(
                        hz[shown], decay[shown], s=9, marker=marker,
                        color=colours(index / (len(STIFFNESSES) - 1)), linewidths=0.8,
                    )  # fmt: skip
        axis.axhline(0.0, color="#c0392b")
        axis.set_xscale("log")
        axis.set_yscale("symlog", linthresh=1.0)
        axis.set_xlim(*FREQUENCY_HZ)
        axis.set_ylim(-2.0, 1000.0)
        axis.set_xlabel("frequency, Hz")
        axis.set_title(HALF_NAMES[half])
    figure.axes[0].set_ylabel("decay, 1/s (below the red line a motion grows)")
    figure.suptitle(
        f"Motions while the planner leads: drivetrain of {STIFFNESSES[0]:.0f} (dark) to "
        f"{STIFFNESSES[-1]:.0f} N m/rad (bright), {DELAYS_MS[0]:g} ms (o) and "
        f"{DELAYS_MS[1]:g} ms (x) from sample to use",
        x=0.01,
        ha="left",
    )
    save_figure(figure, path)
