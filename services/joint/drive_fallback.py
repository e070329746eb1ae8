"""Law with which a drive continues when its joint service dies. Pure."""

from __future__ import annotations

from typing import Final

from services.joint import pd_law
from services.joint.pd_law import Setpoint
from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.joints import kind_of

HOLD_SHARE: Final = {"ankle": 1.0, "knee": 0.2, "hip": 0.0}
"""Fraction of the way from a drive's gains to HOLD's while its service leads.

An ankle's gains rise to all of HOLD's. On TRACK's own, with at most 4 N m s/rad on its phi, a push
from the side decayed by 0.72 each half swing with all six services dead, and 7 of 26 pairs of
pushes in step with it fell. A knee's gains rise to a fifth of HOLD's. Without that, a knee whose
service froze was soft while the other leg's was stiff, and the robot fell (450 mm); with 600 N
m/rad it moves by 23 mm. With all of HOLD's gains the hand feels the drive's gains, which the
service subtracts 2 ms late: 26 N in the squat instead of 18; with 600 N m/rad 19.8. A module whose
phi alone is stiff keeps its gains: half of them is on its theta.
"""


class DriveFallback:
    """What one module's drive is left with."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take HOLD's gains."""
        self._hold_k_p, self._hold_k_d = config.hold_gains(module)
        self._share = HOLD_SHARE[kind_of(module)] if self._hold_k_p[1] > 0.0 else 0.0

    def law(self, setpoint: Setpoint, mode: Mode) -> Setpoint:
        """Return the fallback for a setpoint. In DAMP a drive without commands goes on sinking."""
        if self._share == 0.0 or mode is Mode.DAMP:
            return setpoint
        return pd_law.raise_gains(setpoint, self._hold_k_p, self._hold_k_d, self._share)
