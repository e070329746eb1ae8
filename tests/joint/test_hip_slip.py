"""HOLD's hips: stiff against a sway, and taken along by a hand that leads the torso's pitch on."""

from __future__ import annotations

import msgspec
import pytest

from services.joint.controller import JointController
from services.joint.memory import ControllerMemory
from shared import config_file
from shared.clock import NS_PER_MS
from shared.config import RobotConfig
from shared.joints import MODULES, kind_of
from shared.messages import Mode, Pair
from tests.conftest import ROBOT_FILE
from tests.joint.helpers import Bench

LED_P: Pair = (70.0, 28.0)
LED_D: Pair = (40.0, 4.0)
UPRIGHT = {"ankle": (0.0, 0.1), "knee": (0.0, -1.0), "hip": (0.0, 0.4)}


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    """Return the shipped robot with hips that hold stiff, and slip."""
    shipped = config_file.load(ROBOT_FILE)
    hip = msgspec.structs.replace(shipped.stand.hip, k_p=(6000.0, 2000.0), k_d=(45.0, 45.0))
    service = msgspec.structs.replace(
        shipped.joint_service, hold_stiffens_theta=("ankle", "knee", "hip"), hold_hip_slip=25.0
    )
    stand = msgspec.structs.replace(shipped.stand, hip=hip)
    return msgspec.structs.replace(shipped, stand=stand, joint_service=service)


def held(robot: RobotConfig, module: str) -> Bench:
    """Bring a module from TRACK on soft gains to HOLD, and let its gains rise."""
    bench = Bench(robot, module)
    bench.q = UPRIGHT[kind_of(module)]
    told = {"q_ref": bench.q, "k_p": LED_P, "k_d": LED_D, "tau_ff": (0.0, 0.0)}
    bench.to_track(**told)
    bench.run(1, fresh=True, hold=True, **told)
    assert bench.mode is Mode.HOLD
    bench.run(blended(bench, robot))
    return bench


def blended(bench: Bench, robot: RobotConfig) -> int:
    """Return how many cycles `blend_ms` takes, and one."""
    return round(robot.joint_service.blend_ms * NS_PER_MS / bench.cycle_ns) + 1


def turned(bench: Bench, theta: float) -> float:
    """Turn theta by so much, rad; return its torque at rest there, N m."""
    bench.move((bench.q[0], bench.q[1] + theta))
    bench.run(1)
    return bench.controller.tau[1]


def test_a_small_turn_meets_the_stand_gain(robot: RobotConfig) -> None:
    stiff = robot.stand_gains("hip_left").k_p[1]
    small = 0.5 * robot.hold_slip("hip_left") / stiff
    for theta in (small, -2.0 * small, small):
        bench = held(robot, "hip_left")
        at = bench.q[1] + theta
        assert turned(bench, theta) == pytest.approx(-stiff * (at - UPRIGHT["hip"][1]), rel=1e-6)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_hand_that_leads_on_takes_it_along_against_no_more_than_the_slip(
    robot: RobotConfig, way: float
) -> None:
    bench = held(robot, "hip_right")
    slip = robot.hold_slip("hip_right")
    assert slip > 0.0
    assert turned(bench, 0.6 * way) == pytest.approx(-slip * way)
    assert turned(bench, 0.3 * way) == pytest.approx(-slip * way)
    back = 2.0 * slip / robot.stand_gains("hip_right").k_p[1]
    assert turned(bench, -back * way) == pytest.approx(slip * way), "held from where it came to be"


@pytest.mark.parametrize("module", [name for name in MODULES if kind_of(name) != "hip"])
def test_nothing_else_slips(robot: RobotConfig, module: str) -> None:
    bench, torque = held(robot, module), 3.0 * robot.hold_slip("hip_left")
    assert turned(bench, torque / robot.stand_gains(module).k_p[1]) == pytest.approx(-torque)


def test_a_braced_hip_does_not_slip(robot: RobotConfig) -> None:
    """It is what a leg with a limp knee stands on."""
    bench, theta = held(robot, "hip_left"), 0.03
    bench.run(blended(bench, robot), fresh=True, hold=True, brace=True)
    assert turned(bench, theta) == pytest.approx(-robot.stand_gains("hip_left").k_p[1] * theta)


def test_told_to_loosen_it_is_as_soft_as_it_was_led_without_a_step(robot: RobotConfig) -> None:
    """With one ankle limp, stiff hips hand the hand's moment to the sole that is left."""
    bench = held(robot, "hip_left")
    last = turned(bench, 0.2)
    cycles = blended(bench, robot)
    for _ in range(cycles):
        bench.run(1, fresh=True, hold=True, loosen=True)
        assert abs(bench.controller.tau[1] - last) < 4.0 * robot.hold_slip("hip_left") / cycles
        last = bench.controller.tau[1]
    assert bench.controller.setpoint.k_p[1] == LED_P[1]
    assert bench.controller.setpoint.k_d[1] == LED_D[1]
    stays = robot.hold_gains("hip_left")[0][0]
    assert bench.controller.setpoint.k_p[0] == stays, "phi is not loosened"
    bench.run(5)
    assert bench.controller.setpoint.k_p[1] == LED_P[1], "nor does silence stiffen it again"


def test_a_controller_that_goes_on_from_its_memory_slips_from_where_it_was(
    robot: RobotConfig,
) -> None:
    bench = held(robot, "hip_left")
    turned(bench, 0.3)
    bench.run(3, fresh=True, hold=True, loosen=True)
    text = msgspec.json.encode(bench.controller.remember())
    twin = JointController(robot, "hip_left")
    twin.recall(msgspec.json.decode(text, type=ControllerMemory))
    for _ in range(100):
        bench.q = (bench.q[0], bench.q[1] + 0.002)
        bench.cycle()
        twin.step(bench.now_ns, bench.reading(), None, estop=False)
        assert twin.tau == bench.controller.tau


def test_a_robot_file_without_it_has_hips_that_do_not_slip(robot: RobotConfig) -> None:
    service = msgspec.structs.replace(robot.joint_service, hold_hip_slip=0.0)
    rigid = msgspec.structs.replace(robot, joint_service=service)
    bench, theta = held(rigid, "hip_left"), 0.03
    assert turned(bench, theta) == pytest.approx(-robot.stand_gains("hip_left").k_p[1] * theta)


def test_what_a_braced_hip_carries_does_not_jump_as_hold_comes_back(robot: RobotConfig) -> None:
    """A knee comes back, the robot is led for a moment, and drops out again."""
    bench = held(robot, "hip_left")
    bench.run(blended(bench, robot), fresh=True, hold=True, brace=True)
    carried = turned(bench, 0.04)
    assert abs(carried) > 3.0 * robot.hold_slip("hip_left")
    told = {"q_ref": bench.q, "k_p": LED_P, "k_d": LED_D, "tau_ff": (0.0, 0.0)}
    while bench.mode is Mode.HOLD:
        bench.run(1, fresh=True, **told)
    last = bench.controller.tau[1]
    for _ in range(2 * blended(bench, robot)):
        bench.run(1, fresh=True, hold=True, **told)
        assert abs(bench.controller.tau[1] - last) < 1.5
        last = bench.controller.tau[1]
    assert abs(last) == pytest.approx(robot.hold_slip("hip_left"))


@pytest.mark.parametrize("then", ["held", "led again"])
def test_a_hand_that_leads_on_meets_no_more_than_the_slip_as_the_mode_changes(
    robot: RobotConfig, then: str
) -> None:
    """Springs that rose while the hand went on had come to 80 N m a hip."""
    bench = Bench(robot, "hip_left")
    bench.q = UPRIGHT["hip"]
    told = {"k_p": LED_P, "k_d": LED_D, "tau_ff": (0.0, 0.0)}
    bench.to_track(q_ref=bench.q, **told)
    bench.run(1, fresh=True, hold=True, q_ref=bench.q, **told)
    if then == "led again":
        bench.run(2 * blended(bench, robot), fresh=True, hold=True, q_ref=bench.q, **told)
        while bench.mode is Mode.HOLD:
            bench.run(1, fresh=True, q_ref=bench.q, **told)
    for _ in range(blended(bench, robot)):
        bench.q = (bench.q[0], bench.q[1] + 0.001)
        bench.run(1, fresh=True, hold=then == "held", q_ref=bench.q, **told)
        assert abs(bench.controller.tau[1]) <= robot.hold_slip("hip_left") + 1e-9


def test_told_to_loosen_as_it_comes_to_hold_it_never_stiffens(robot: RobotConfig) -> None:
    """An ankle's fault asks for both in one command."""
    bench = Bench(robot, "hip_left")
    bench.q = UPRIGHT["hip"]
    told = {"q_ref": bench.q, "k_p": LED_P, "k_d": LED_D}
    bench.to_track(**told)
    for _ in range(2 * blended(bench, robot)):
        bench.run(1, fresh=True, hold=True, loosen=True, **told)
        assert bench.controller.setpoint.k_p[1] == LED_P[1]
        assert bench.controller.setpoint.k_d[1] == LED_D[1]
