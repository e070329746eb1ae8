"""A module that is held where it hangs, by its drive's own loop, while another one is moved."""

from __future__ import annotations

import math
from typing import NamedTuple

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive
from services.joint.pd_law import ZERO
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.config.sections import StandGains
from tools.bringup import jog_drive
from tools.bringup.jogging import Jog


class Still(NamedTuple):
    """No motion, for as long as it takes (`tools.bringup.jogging.MotionPlan`)."""

    torque_limit: float
    axis: int = 0

    @property
    def duration_s(self) -> float:
        """For ever."""
        return math.inf

    @property
    def reach(self) -> tuple[Pair, Pair]:
        """Nowhere."""
        return ZERO, ZERO

    @property
    def rate_max(self) -> float:
        """No rate."""
        return 0.0

    def gains(self, stand: StandGains) -> tuple[Pair, Pair]:
        """Return the stand gains."""
        return stand.k_p, stand.k_d

    def offset(self, t_s: float) -> tuple[Pair, Pair]:  # noqa: ARG002 - at every time
        """Return no offset and no rate."""
        return ZERO, ZERO


class HeldModule:
    """One drive that holds; its target goes out again in every cycle, as a service's does."""

    def __init__(
        self,
        drive: Drive,
        robot: RobotConfig,
        module: str,
        torque_limit: float,
        clock: jog_drive.Clock,
    ) -> None:
        """Take an idle drive that was opened with the limits of `jogging.gentle`."""
        self._drive, self._robot, self.module = drive, robot, module
        self._plan, self._clock = Still(torque_limit), clock
        self._jog: Jog | None = None

    def hold(self, interrupts: jog_drive.Interrupts) -> str:
        """Arm it and hold it where it is; return what speaks against going on, "" if nothing."""
        reading = jog_drive.arm(self._drive, interrupts, self._clock)
        if isinstance(reading, str):
            return f"{self.module}: {reading}"
        q = joint_from_motor(reading.pos_turns, self._robot.joint.gear_ratio)
        self._jog = Jog(self._robot, self.module, self._plan, q, self._clock())
        target = self._jog.step(self._clock(), reading)
        if target is not None:
            self._drive.write(target)
        return self._trouble()

    def keep(self) -> str:
        """Look at it and send its target again; return what speaks against going on."""
        assert self._jog is not None  # noqa: S101 - `hold` came first
        target = self._jog.step(self._clock(), self._drive.read(0.0))
        if target is not None:
            self._drive.write(target)
        return self._trouble()

    def release(self) -> bool:
        """Idle it; return False if it does not say that it is idle."""
        return jog_drive.idle(self._drive, self._clock)

    def _trouble(self) -> str:
        jog = self._jog
        return f"{self.module}: {jog.trouble}" if jog is not None and jog.trouble else ""
