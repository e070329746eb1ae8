"""A robot whose knees hold on gains of their own: what is tested here is no matter of tuning.

Its joint services believe any command within their limits; `envelope` is tested by itself.
"""

from __future__ import annotations

import msgspec
import pytest

from shared.config import files as config_file
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from tests.conftest import ROBOT_FILE


@pytest.fixture(scope="session")
def robot() -> RobotConfig:
    """Return the shipped robot with a soft knee, whose theta HOLD does not stiffen."""
    shipped = config_file.load(ROBOT_FILE)
    knee = msgspec.structs.replace(shipped.stand.knee, k_p=(900.0, 1500.0), k_d=(45.0, 25.0))
    return msgspec.structs.replace(
        believing(shipped),
        stand=msgspec.structs.replace(shipped.stand, knee=knee),
        joint_service=msgspec.structs.replace(
            shipped.joint_service, hold_stiffens_theta=("ankle",)
        ),
    )
