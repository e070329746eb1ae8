"""The law that a drive goes on with, should its joint service die now. Pure."""

from __future__ import annotations

from typing import Final

from services.joint import pd_law
from services.joint.pd_law import Setpoint
from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.robot.joints import kind_of

HOLD_SHARE: Final = {"ankle": 1.0, "knee": 0.2, "hip": 0.0}
"""How far a drive's gains rise to HOLD's while its service leads.

An ankle's gains rise to all of HOLD's. On TRACK's own, with no more than 4 N m s/rad on its phi, a
push from the side rang on by 0.72 each half swing with all six services dead, and 7 of 26 pairs of
pushes in step with it fell. A knee's rise to a fifth of HOLD's. With none, a knee whose service
froze was soft while the other leg's was stiff, and the robot fell (450 mm); with 600 N m/rad it
moves by 23 mm. With all of it the hand feels the drive's gains that the service takes off 2 ms
late: 26 N in the squat for 18, with 600 N m/rad 19.8. One whose phi alone is stiff is left as it
is: half is on its theta.
"""


class DriveFallback:
    """What one module's drive is left with."""

    def __init__(self, config: RobotConfig, module: str) -> None:
        """Take HOLD's gains."""
        self._hold_k_p, self._hold_k_d = config.hold_gains(module)
        self._share = HOLD_SHARE[kind_of(module)] if self._hold_k_p[1] > 0.0 else 0.0

    def law(self, setpoint: Setpoint, mode: Mode) -> Setpoint:
        """Return it for the setpoint in force. In DAMP a drive that is left goes on sinking."""
        if mode is Mode.DAMP or self._share == 0.0:
            return setpoint
        return pd_law.raise_gains(setpoint, self._hold_k_p, self._hold_k_d, self._share)
