"""The bounds that `xrl gains` writes: they hold what the law sends in each pose, for both legs."""

from __future__ import annotations

import numpy as np
import pytest

from services.joint.envelope import Envelope
from services.planner.law.hocca import Hocca
from shared.bus.messages import JointCommand, Outside
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.planner.conftest import Closed


@pytest.mark.parametrize("height", [0.8, 0.95, 1.05, 1.188])
@pytest.mark.parametrize("pitch", [-0.3, 0.0, 0.6, 1.2])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_what_the_law_sends_in_a_stand_is_believed(
    robot: RobotConfig, closed: Closed, height: float, pitch: float, share: float
) -> None:
    q = closed(height, pitch=pitch)
    output = Hocca(robot).tick(q, np.zeros(12), share * robot.assist.force_max, 0.004, align=True)
    for index, module in enumerate(MODULES):
        two = slice(2 * index, 2 * index + 2)
        rows = (output.q_ref, output.v_ref, output.tau_ff, output.dtau_ff, output.tau_coupled)
        pairs = [tuple(row[two].tolist()) for row in (*rows, output.local.D, output.local.D_B)]
        command = JointCommand(
            t_ns=1, seq=1, session=1, echo_t_ns=1, hold=False, q_ref=pairs[0], v_ref=pairs[1],
            tau_ff=pairs[2], dtau_ff=pairs[3], tau_coupled=pairs[4], k_p=pairs[5], k_d=pairs[6],
            margin=output.local.margins.service, margin_onboard=output.local.margins.onboard,
        )  # fmt: skip
        judged = Envelope(robot, module).judge(command, None, pairs[0], (0.0, 0.0))
        assert judged is Outside.NOTHING, module


def test_both_legs_have_the_same_room_to_either_side(robot: RobotConfig) -> None:
    assert robot.gain_schedule is not None
    assert robot.gain_schedule.bounds is not None
    for bounds in robot.gain_schedule.bounds.values():
        for (low, _), (high, _) in bounds.tau_ff:
            assert low == pytest.approx(-high, abs=2e-3)
