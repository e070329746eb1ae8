"""Order and names of the joints (docs/law.md#the-robot).

q, v and tau are vectors in R^12: six modules, each (phi, theta), in `MODULES` order.
phi turns about x (frontal), theta about y (sagittal); positive theta leans forward.
"""

from __future__ import annotations

from typing import Final

MODULES: Final = ("ankle_right", "knee_right", "hip_right", "ankle_left", "knee_left", "hip_left")
"""Module names in the order of q, v and tau."""

SIDES: Final = ("right", "left")
"""Leg order: the right leg has joints 0..5, the left leg 6..11."""

KINDS: Final = ("ankle", "knee", "hip")
"""Joint kinds from the foot up."""

AXES: Final = ("phi", "theta")
"""The two axes of a module, in order."""

JOINTS: Final = tuple(f"{module}_{axis}" for module in MODULES for axis in AXES)
"""The 12 joint names, in the order of q, v and tau."""

N_MODULES: Final = len(MODULES)
N_JOINTS: Final = len(JOINTS)
N_LEG: Final = N_JOINTS // 2

MODULE_INDEX: Final = {name: index for index, name in enumerate(MODULES)}


def kind_of(module: str) -> str:
    """Return "ankle", "knee" or "hip" for a module name."""
    return module.rpartition("_")[0]


def side_of(module: str) -> str:
    """Return "right" or "left" for a module name."""
    return module.rpartition("_")[2]
