"""The harness in the loop, in virtual time: what its sensor tells, and what becomes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
import numpy as np
import pytest

from services.simulator.fronts.sensor_fronts import HarnessFront
from services.simulator.physics.plant import IDEAL, changed
from shared.bus.messages import (
    Cause,
    Message,
    Mode,
    PlannerMode,
    PlannerStatus,
    Tare,
    TareRequest,
    Wrench,
)
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from tests.lockstep.runs import (
    Heard,
    Run,
    led_to,
    modes_of,
    run,
    standing_as,
    status_of,
    still,
    variant,
)
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep

M = TypeVar("M", bound=Message)
LIGHT = changed(IDEAL, {"body.payload_scale": 0.9})
"""2 kg of payload less than the planner knows."""


def with_keys(robot: RobotConfig, section: str, **changes: object) -> RobotConfig:
    """Return the robot with keys of a section changed."""
    keys = msgspec.structs.replace(getattr(robot, section), **changes)
    return msgspec.structs.replace(robot, **{section: keys})


@pytest.mark.parametrize(
    ("weighed", "integrates", "duration", "comes_true"),
    [(False, True, 9.0, True), (True, False, 5.5, True), (False, False, 9.0, False)],
    ids=["by its integral", "by the load found", "by neither"],
)
def test_the_assist_comes_true_with_a_payload_the_planner_does_not_know(
    weighed: bool, integrates: bool, duration: float, comes_true: bool
) -> None:
    robot, start = ROBOT, standing_as(ROBOT, LIGHT)
    if not weighed:
        robot = with_keys(robot, "law", load_correction=(0.0, 0.0))
    if not integrates:
        robot = with_keys(robot, "assist", integral_max=0.0)
    resting = led_to((4.0, 1.0, 0.0, 200.0), duration=duration)
    outcome = run(robot, resting, plant=LIGHT, start=start)
    error = abs(np.mean([row.harness_force_z for row in outcome.rows[-100:]]) - 200.0)
    assert error < 10.0 if comes_true else error > 12.0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("delay_ms", [1.0, 20.0])
def test_the_eased_lead_is_lighter_and_as_steady(delay_ms: float) -> None:
    squat = variant("squat", duration=3.0, kill=(), push=())
    plain, eased = (
        run(with_keys(ROBOT, "law", lead_easing=alpha), squat, delay_ms, start=standing_as(ROBOT))
        for alpha in (0.0, 0.5)
    )
    assert eased.stood
    assert np.abs(eased.operator_n).max() < 0.8 * np.abs(plain.operator_n).max()
    assert np.abs(eased.com_mm[:, 0]).max() < np.abs(plain.com_mm[:, 0]).max() + 1.0


def test_an_overloaded_harness_makes_all_hold_and_lead_again() -> None:
    held = []

    def look(fleet: Lockstep, truth: SimTruth) -> None:
        if 2.4 < truth.scenario_s < 3.3:
            held.append(set(modes_of(fleet)))

    tight = with_keys(ROBOT, "harness", overload_force=170.0)
    rests = ((2.0, 1.188, 0.0, 190.0), (3.0, 1.188, 0.0, 190.0), (5.0, 1.188))
    overloading = led_to(*rests, duration=8.0)
    outcome = run(tight, overloading, start=standing_as(ROBOT), each=look)
    assert outcome.stood
    assert held
    assert all(modes == {Mode.HOLD} for modes in held)
    assert set(outcome.modes) == {Mode.TRACK}
    assert Cause.HOLD_ALL in {event.cause for _, event in outcome.lockstep.events}


def heard_in(robot: RobotConfig, scenario: Scenario, **how: Any) -> list[Message]:
    """Return every wrench, status and truth of a run, in the log's order."""
    heard = Heard(Wrench, PlannerStatus, SimTruth)
    run(robot, scenario, record=heard, **how)
    return heard


def of(kind: type[M], heard: list[Message]) -> list[M]:
    return [message for message in heard if isinstance(message, kind)]


TARED_S = 3.3


def test_the_wrench_is_what_acts_on_the_torso_and_a_tare_takes_it_for_its_zero() -> None:
    """The torso pitches while a load comes to rest on it; at `TARED_S` a new zero is asked for."""
    leaning = led_to((2.0, 1.1, 0.4, 150.0), duration=4.1)
    asked: list[int] = []

    def tare(fleet: Lockstep, truth: SimTruth) -> None:
        if not asked and truth.scenario_s >= TARED_S:
            asked.append(fleet.now_ns)
            fleet.harness.tare(TareRequest(t_ns=fleet.now_ns, seq=1, source="a test"))

    leaned = heard_in(unheeded(ROBOT), leaning, start=standing_as(ROBOT), each=tare)
    wrenches = {m.t_ns: m for m in of(Wrench, leaned)}
    stamps = sorted(wrenches)
    assert set(np.diff(stamps)) == {round(1e9 / ROBOT.harness.rate_hz)}
    errors = []
    for truth in of(SimTruth, leaned):
        if 2.8 < truth.scenario_s < TARED_S:
            # truth is told after the step, the sensor sampled before it: nothing moves fast
            wrench = wrenches[max(t for t in stamps if t <= truth.t_ns)]
            roll, pitch, _ = truth.angles
            x, y, z = wrench.force
            up = np.cos(roll) * (z * np.cos(pitch) - x * np.sin(pitch)) + np.sin(roll) * y
            errors.append(up + truth.harness_force_z)
            assert (wrench.valid, truth.harness_force_z > 100.0, pitch > 0.3) == (True,) * 3
    assert np.abs(np.mean(errors)) < 1.0
    assert np.abs(errors).max() < 4.0
    at = next(i for i, m in enumerate(leaned) if getattr(m, "scenario_s", 0.0) >= TARED_S)
    *_, before = of(Wrench, leaned[:at])
    assert before.valid
    assert np.linalg.norm(before.force) > 100.0
    after = of(Wrench, leaned[at:])
    assert {m.tare for m in after if not m.valid} == {Tare.RUNNING}
    assert after[-1].valid
    assert np.linalg.norm(after[-1].force) < 10.0


def test_the_tare_is_done_on_the_hoist_and_the_planner_hears_the_wrench_after_the_delay() -> None:
    """A stand-up with 8 ms on each link, each way."""
    heard = heard_in(ROBOT, still(0.5), delay_ms=8.0, stands=False)
    first_valid = next(m for m in heard if isinstance(m, Wrench) and m.valid)
    since_ns = first_valid.t_ns - heard[0].t_ns
    assert since_ns == pytest.approx(ROBOT.harness.tare_s * 1e9, abs=5e6)
    hoisted = [m for m in of(SimTruth, heard) if m.t_ns <= first_valid.t_ns]
    assert all(m.hoist > 0.5 and m.harness_force_z == 0.0 for m in hoisted)
    sent = {m.seq: m.t_ns for m in of(Wrench, heard)}
    statuses = [m for m in of(PlannerStatus, heard) if m.wrench_seq >= 0]
    ages_ms = [(m.t_ns - sent[m.wrench_seq]) / 1e6 for m in statuses]
    assert len(ages_ms) > 100
    assert min(ages_ms) >= 8.0
    assert max(ages_ms) < 8.0 + 2e3 / ROBOT.planner.rate_hz


def unheeded(robot: RobotConfig) -> RobotConfig:
    """Return the robot with nothing made of the wrench."""
    robot = with_keys(robot, "law", lead_easing=0.0, load_correction=(0.0, 0.0))
    return with_keys(robot, "assist", integral_max=0.0)


# ---- a sensor that lies is reported before the load is, and the assist goes

FAILS_S = 3.0
ASSIST_N = 80.0


def drift(front: HarnessFront, _since_s: float) -> None:
    """Let one cell drift by 20 N/s; the world is seen at 100 Hz."""
    front.bias = np.add(front.bias, (0.0, 0.0, 0.2, 0.0, 0.0, 0.0))


def invert(front: HarnessFront, since_s: float) -> None:
    """Turn the sign of every cell round."""
    if since_s < 0.01:
        front._G_inverse = -front._G_inverse


def stick_at_zero(front: HarnessFront, _since_s: float) -> None:
    """Have one cell measure nothing but noise."""
    front._G_inverse[3], front.bias[3] = 0.0, 0.0


def carry(fail: Callable[[HarnessFront, float], None]) -> tuple[Run, list[str]]:
    """Carry a person in a crouch while the sensor fails; return also what the planner says then."""
    said: list[str] = []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if row.scenario_s >= FAILS_S:
            fail(fleet.harness._robot.harness, row.scenario_s - FAILS_S)
            said.append(status_of(fleet).why)

    scenario = led_to((2.0, 1.0, 0.0, ASSIST_N), duration=FAILS_S + 9.0)
    return run(ROBOT, scenario, each=look), said


@pytest.mark.parametrize("fail", [drift, invert, stick_at_zero])
def test_a_sensor_that_begins_to_lie_is_named_and_the_load_is_not_learnt(
    fail: Callable[[HarnessFront, float], None],
) -> None:
    """It said that the robot carried 8 to 12 kg more than its file, and led on with the force."""
    outcome, said = carry(fail)
    assert outcome.stood
    first = next(i for i, why in enumerate(said) if "harness and joints disagree" in why)
    assert first < 500, "within 5 s"
    assert "mass.payload" not in said[-1]
    assert abs(outcome.status.load[0]) < 1.0
    led = outcome.status.mode == PlannerMode.LEADING
    assert not led or outcome.status.assist_n < 0.7 * ASSIST_N, "the assist goes"


def test_a_sensor_that_is_right_is_believed_through_a_squat_with_assist() -> None:
    outcome, said = carry(lambda _front, _since_s: None)
    assert not any("disagree" in why for why in said)
    assert outcome.status.assist_n == pytest.approx(ASSIST_N, abs=50.0)
    assert np.ptp(outcome.height[-500:]) < 0.01
