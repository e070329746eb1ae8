"""Does it bear weight, and what is asked for then; its physics: tests/lockstep/test_descent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest

from shared.bus.messages import DriveStatus, JointState, Mode, PlannerMode, PlannerStatus
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from shared.joints import MODULES, kind_of
from shared.robot.robot_model import stand_pose
from tests.messages import joint_state, planner_status
from tools.fleet import procfs
from tools.live import descent
from tools.live.descent import HEARD_S, LIGHT_S, PATIENCE_S, STALLED_S, Ask, Descent, _LegLoad
from tools.verbs import down
from tools.verbs.down import DownFlags

States = list[JointState | None]
KNEE_TORQUE = 40.0
"""N m at 1.188 m, of a robot that stands."""


def stand(robot: RobotConfig, height: float = 1.188, scale: float = 1.0, **more: object) -> States:
    """Return a robot that stands at a height, with its knees' torque times a scale."""
    q = np.array(stand_pose(robot, height)).reshape(6, 2)
    return [
        joint_state(
            q=(float(pair[0]), float(pair[1])),
            v=(0.0, 0.0),
            tau=(0.0, scale * KNEE_TORQUE if kind_of(name) == "knee" else 0.0),
            **{"mode": int(Mode.HOLD)} | more,
        )
        for name, pair in zip(MODULES, q, strict=True)
    ]


def limp(robot: RobotConfig) -> States:
    return stand(robot, scale=0.0, mode=int(Mode.DISARMED), drive=int(DriveStatus.IDLE))


def test_a_stand_bears_the_torsos_weight_and_a_limp_robot_none(robot: RobotConfig) -> None:
    load = _LegLoad(robot)
    assert load.fraction(stand(robot)) == pytest.approx(1.0, abs=0.15)
    assert load.fraction(stand(robot, scale=-0.2)) < 0.0, "its legs hang"
    assert load.fraction(limp(robot)) == 0.0


@pytest.mark.parametrize(
    "states",
    [
        lambda robot: [None, *stand(robot)[1:]],
        lambda robot: [*limp(robot)[:5], stand(robot)[5]],
        lambda robot: stand(robot, mode=int(Mode.DISARMED), drive=int(DriveStatus.HOLDING)),
        lambda robot: stand(robot, mode=int(Mode.FAULT), drive=int(DriveStatus.LOST)),
        lambda robot: stand(robot, 1.294, scale=0.0),
        lambda robot: stand(robot, 1.294, scale=-0.5 * descent.PULLED / KNEE_TORQUE),
    ],
    ids=["one silent", "five limp", "held by drives", "lost", "straight", "straight, friction"],
)  # fmt: skip
def test_what_is_not_known_is_not_light(
    robot: RobotConfig, states: Callable[[RobotConfig], Sequence[JointState | None]]
) -> None:
    assert not _LegLoad(robot).fraction(states(robot)) < descent.LIGHT_FRACTION


def test_a_straight_leg_that_its_shin_pulls_straight_bears_nothing(robot: RobotConfig) -> None:
    pulled = stand(robot, 1.294, scale=-2.0 * descent.PULLED / KNEE_TORQUE)
    assert _LegLoad(robot).fraction(pulled) == 0.0


def asked(
    law: Descent,
    states: States,
    status: PlannerStatus | None,
    seconds: float,
    begin_s: float = 0.0,
    asks: set[Ask] | None = None,
) -> Ask:
    """Show the same for some seconds; return what is asked for at the end, and add all `asks`."""
    ask = Ask.NOTHING
    for at in np.arange(begin_s, begin_s + seconds, 0.1):
        ask = law.step(float(at), states, status)
        if asks is not None:
            asks.add(ask)
    return ask


def test_what_hangs_or_is_limp_is_idled_and_not_before_it_is_sure(robot: RobotConfig) -> None:
    for states in (limp(robot), stand(robot, scale=0.1)):
        law = Descent(robot, 1.0)
        assert asked(law, states, planner_status(), LIGHT_S - 0.2) is Ask.NOTHING
        assert asked(law, states, None, 0.6, LIGHT_S - 0.2) is Ask.IDLE


def test_a_robot_that_becomes_light_is_idled_without_a_lead_or_a_stop_before(
    robot: RobotConfig,
) -> None:
    law, asks = Descent(robot, 1.0), set[Ask]()
    asked(law, stand(robot), planner_status(), 0.5, asks=asks)
    asked(law, limp(robot), planner_status(), LIGHT_S + 1.0, 0.5, asks)
    assert asks == {Ask.NOTHING, Ask.IDLE}


def test_a_moment_of_lightness_is_none(robot: RobotConfig) -> None:
    law = Descent(robot, 1.0)
    for k in range(45):
        states = stand(robot, scale=0.0 if k % 8 < 7 else 1.0)
        assert law.step(0.1 * k, states, planner_status()) is not Ask.IDLE


def test_a_planner_that_leads_takes_it_down_else_damp_does(robot: RobotConfig) -> None:
    refuses = planner_status(mode=int(PlannerMode.MISLOADED))
    for status, wanted in ((planner_status(), Ask.SIT), (None, Ask.STOP), (refuses, Ask.STOP)):
        assert asked(Descent(robot, 1.0), stand(robot), status, 1.5) is wanted


def test_once_in_damp_it_does_not_come_back_to_the_planner(robot: RobotConfig) -> None:
    states = stand(robot, mode=int(Mode.DAMP))
    assert asked(Descent(robot, 100.0), states, planner_status(), 12.0) is Ask.NOTHING


def gives_up(law: Descent, states: States, status: PlannerStatus | None, seconds: float) -> str:
    with pytest.raises(FleetError) as raised:
        asked(law, states, status, seconds)
    return str(raised.value)


def test_each_reason_to_give_up_says_what_helps(robot: RobotConfig) -> None:
    law = partial(Descent, robot, 1.0)
    tripped = planner_status(mode=int(PlannerMode.OVERLOADED), why="")
    standing = stand(robot)
    faulty = [msgspec.structs.replace(standing[0], mode=int(Mode.FAULT)), *standing[1:]]
    damped = stand(robot, mode=int(Mode.DAMP))
    for said, words in (
        (gives_up(law(), [None] * 6, None, HEARD_S + 0.5), "ankle_right, knee_right, hip_right, "),
        (gives_up(law(), faulty, None, 3.0), "ankle_right FAULT: the legs may still carry"),
        (gives_up(law(), standing, tripped, PATIENCE_S + 3.0), "does not lead (OVERLOADED)"),
        (gives_up(law(), standing, planner_status(), STALLED_S + 3.0), "robot is held up at a COM"),
        (gives_up(law(), standing, None, HEARD_S + 3.0), "not all modules go to DAMP"),
        (gives_up(law(), damped, None, 60.0), "down, but the legs may still carry the robot"),
    ):
        assert words in said
        assert "--limp" in said or "take the hand off" in said
    asks = set[Ask]()
    with pytest.raises(FleetError):
        asked(law(), faulty, None, 3.0, asks=asks)
    assert asks <= {Ask.NOTHING}, "a stop would have it sink beside a limp leg"


def test_down_refuses_where_nobody_knows_and_leaves_a_simulator_as_it_was(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    running: dict[str, int] = {}
    monkeypatch.setattr(procfs, "service_pids", lambda _run_dir: running)
    flags = DownFlags(run_dir=tmp_path / "run")
    assert down.run(flags) == 0
    running |= {"knee_left": 1}
    with pytest.raises(FleetError, match=r"files are missing.*`xrl down --limp`"):
        down.run(flags)
    assert down.run(DownFlags(run_dir=tmp_path / "run", limp=True)) == 0
    running |= {"simulator": 2}
    assert down.run(flags) == 0
