"""Robots that shook themselves down trip, and stand in HOLD; what a person does trips nothing.

The gains are those of before the dynamic certificate: the coupling unfiltered, a third of the local
damping. Its joint services believe any command, so that it is the trips that save it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import Cause, Mode, PlannerMode, PlannerStatus, Trip
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_S
from shared.config.gain_schedule import believing
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.robot.trip_table import JOINT_TRIPS, untripped
from tests.lockstep.runs import (
    Heard,
    Run,
    kill,
    led_to,
    modes_of,
    push,
    run,
    standing_as,
    still,
    variant,
)
from tools.sim.lockstep import Lockstep

RESTS_TWICE = changed(PlantConfig(), {"person.load_scale": 2.0})
PUSHED = (push(3.0, 40.0, 0.0, 0.0),)
SMALL_ERRORS: Mapping[str, Any] = {
    "encoder.zero_errors": [math.radians(0.5) * (-1) ** i for i in range(12)],
    "body.payload_scale": 0.85,
    "body.com_offset": [0.015, 0.0, 0.0],
    "drive.lag_s": 0.002,
    "drivetrain.play": math.radians(0.25),
    "floor.slope": [math.radians(1.0), 0.0],
    "drive.torque_scale": 0.95,
}
SHAKEN: Mapping[str, Mapping[str, Any]] = {
    "k 8000": {},
    "k 5000": {"drivetrain.stiffness": 5000.0},
    "k 3000": {"drivetrain.stiffness": 3000.0},
    "k 2000": {"drivetrain.stiffness": 2000.0},
    "play 0.75 deg": {"drivetrain.play": math.radians(0.75)},
    "small errors": SMALL_ERRORS,
}
"""Stiffness of the drivetrains in N m/rad."""


def unfiltered(robot: RobotConfig) -> RobotConfig:
    """Return the robot without the dynamic certificate; its joints accept any command.

    The coupling is unfiltered and the local damping a third. The load is not estimated, because
    shaking looks like a load.
    """
    made = robot.gain_schedule
    assert made is not None
    weak = msgspec.structs.replace(
        made,
        coupling_bandwidth_hz=200.0,
        coupling_damping=1.0,
        D_B=tuple(0.3 * each for each in made.D_B),
    )
    law = msgspec.structs.replace(robot.law, load_correction=(0.0, 0.0))
    return believing(msgspec.structs.replace(robot, gain_schedule=weak, law=law))


def trip_run(
    robot: RobotConfig,
    told: Scenario,
    plant: PlantConfig | None = None,
    *,
    let_go_s: float = math.inf,
    until_s: float = math.inf,
    **how: Any,
) -> Run:
    """Run to the end or to `until_s` of virtual time, without a fall."""

    def look(fleet: Lockstep, row: SimTruth) -> bool:
        if row.scenario_s >= let_go_s:
            fleet.world.let_go()
        fell.append(row.fallen)
        return fleet.now_ns > until_s * NS_PER_S

    fell: list[bool] = []
    outcome = run(robot, told, plant=plant, each=look, **how)
    assert not any(fell)
    return outcome


def fastest(heights: NDArray[np.float64]) -> float:
    """Return the fastest way down, m/s."""
    return float(-np.diff(heights).min()) * 100.0


def causes(outcome: Run) -> set[Cause]:
    return {Cause(event.cause) for _, event in outcome.lockstep.events}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", SHAKEN)
def test_a_robot_that_shook_itself_down_stands_in_hold(robot: RobotConfig, name: str) -> None:
    shaky, plant = unfiltered(robot), changed(PlantConfig(), SHAKEN[name])

    # with no trip it shakes until a drive disarms for its current (48 A, at the torque's limit), or
    # falls after 2 to 4 s: when, the last bit decides
    def is_limp(fleet: Lockstep, _row: SimTruth) -> bool:
        return Mode.FAULT in modes_of(fleet)

    shakes = untripped(shaky)
    falls = run(shakes, still(8.0, push=PUSHED), plant=plant, stands=False, each=is_limp)
    limp = Mode.FAULT in falls.modes
    assert limp or falls.rows[-1].fallen, "nothing is proved by a robot that would have stood"
    # where it is never led for a second the scenario, and its push, do not begin
    outcome = trip_run(shaky, still(4.0, push=PUSHED), plant, stands=False, until_s=8.0)
    assert Cause.SHAKING in causes(outcome)
    led_s = [
        (leaves.t_ns - enters.t_ns) / 1e9
        for enters, leaves in _led(outcome.lockstep)
        if leaves.cause == Cause.SHAKING
    ]
    assert len(led_s) >= 3, "it was led more than once"
    assert max(led_s) < 0.7, "in time: 0.3 s of it the gains blend in"


def _led(fleet: Lockstep) -> list[tuple[Any, Any]]:
    """Return each module's entries into TRACK with what ended them."""
    found, entered = [], {}
    for module, event in fleet.events:
        if event.mode_after == Mode.TRACK:
            entered[module] = event
        elif module in entered:
            found.append((entered.pop(module), event))
    return found


def test_what_keeps_shaking_is_led_ever_more_rarely(robot: RobotConfig) -> None:
    shaky, plant = unfiltered(robot), changed(PlantConfig(), SHAKEN["k 5000"])
    outcome = trip_run(shaky, still(12.0), plant, stands=False, until_s=11.0)
    tracked = [
        (enters.t_ns, (leaves.t_ns - enters.t_ns) / 1e9)
        for enters, leaves in _led(outcome.lockstep)
    ]
    starts = sorted({enters_ns // 10**8 for enters_ns, _ in tracked})  # tenths of a second
    waits = [later - earlier for earlier, later in pairwise(starts)]
    assert len(waits) >= 3
    assert all(later > 1.5 * earlier for earlier, later in pairwise(waits)), waits
    # 1.2 here, and another on other processors: shaking amplifies a product's last bit
    assert sum(led_s for _, led_s in tracked) / 6 < 1.5, "seconds led, of 10"
    assert outcome.status.wait_s > 2.0


@pytest.mark.sampled(3)
@pytest.mark.parametrize("delay_ms", [1.0, 20.0])
@pytest.mark.parametrize("height", [1.1, 0.85])
def test_a_person_who_sags_is_caught(robot: RobotConfig, height: float, delay_ms: float) -> None:
    """200 N rest on the harness where none were asked for: it went to the knees' stop, 0.76 m."""
    statuses = Heard(PlannerStatus)
    how: dict[str, Any] = {"delay_ms": delay_ms, "let_go_s": 2.4, "record": statuses}
    outcome = trip_run(robot, _sags(height), RESTS_TWICE, start=standing_as(robot), **how)
    sagged = outcome.height[outcome.t > 2.4]
    assert min(sagged) > height - 0.06
    assert fastest(sagged) < 0.32
    assert Cause.HOLD_ALL in causes(outcome)
    told_by = [row for row in statuses if row.trip == Trip.SAGGING]
    assert told_by, "and it says why"
    assert statuses[-1].trip == Trip.SAGGING, "it is not led while the load rests on it"
    assert {row.mode for row in told_by[1:]} <= {PlannerMode.TRIPPED, PlannerMode.WAITING}
    assert all("sinks with weight" in row.why for row in told_by)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", ["crawl", "squat", "lean", "shift"])
def test_on_a_plant_of_many_errors_nothing_trips_without_a_reason(
    robot: RobotConfig, name: str
) -> None:
    statuses = Heard(PlannerStatus)
    plant = changed(PlantConfig(), SMALL_ERRORS)
    scenario = variant(name, duration=8.0, kill=(), push=())
    outcome = run(robot, scenario, plant=plant, record=statuses)
    assert outcome.stood
    assert not causes(outcome) & set(JOINT_TRIPS)
    assert {row.trip for row in statuses} == {Trip.NONE}


def test_a_person_who_sags_and_holds_on_is_let_down_slowly(robot: RobotConfig) -> None:
    outcome = trip_run(robot, _sags(1.1), RESTS_TWICE, start=standing_as(robot))
    heights = outcome.height[outcome.t > 1.0]
    assert fastest(heights) < 0.32
    assert min(heights) > 0.95
    assert Cause.HOLD_ALL not in causes(outcome)


def _sags(height: float) -> Scenario:
    """Return a stand at a height, m, and 100 N asked for within 0.2 s: 200 are rested."""
    return led_to((2.0, height), (2.5, height), (2.7, height, 0.0, 100.0), duration=6.0)


def test_a_torso_that_is_thrown_about_is_held(robot: RobotConfig) -> None:
    """1.2 rad of pitch in 0.6 s; a person takes 2 s."""
    frames = tuple(Keyframe(at=at, height=1.1, pitch=1.2 * (at > 1.5)) for at in (0.0, 1.0, 1.6))
    outcome = trip_run(robot, variant("stand", duration=3.0, keyframe=frames))
    assert Cause.HOLD_ALL in causes(outcome)
    assert not causes(outcome) & set(JOINT_TRIPS)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("height", "pitch", "ways_s"),
    [(0.85, 0.0, 1.5), (1.29, 0.0, 1.5), (0.79, 1.2, 2.0), (0.7, 0.0, 3.0)],
)
def test_a_fast_lead_and_one_beyond_what_legs_reach_are_followed(
    robot: RobotConfig, height: float, pitch: float, ways_s: float
) -> None:
    """0.34 m in 1.5 s; to straight legs; the crawl in 2 s; below the knees' stop."""
    way = ((0.5, 1.188), (0.5 + ways_s, height, pitch))
    outcome = trip_run(robot, led_to(*way, duration=ways_s + 1.0))
    assert not outcome.lockstep.events, "all six track on"


def lean(newtons: float, at: float = 2.8) -> Push:
    return Push(at=at, duration=3.0, force=(0.0, newtons, 0.0))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("delay_ms", [1.0, 10.0])
@pytest.mark.parametrize(
    ("height", "pitch", "newtons"), [(1.188, 0.0, 60.0), (0.79, 1.2, 85.0), (0.95, 0.0, 65.0)]
)
def test_leaned_on_from_the_side_it_holds_and_is_led_again(
    robot: RobotConfig, height: float, pitch: float, newtons: float, delay_ms: float
) -> None:
    """Led on, it fell from 50 N on (squat 55, crawl 70)."""
    said = Heard(PlannerStatus)
    leant = led_to((2.5, height, pitch), duration=9.0, push=(lean(newtons),))
    outcome = run(robot, leant, delay_ms=delay_ms, record=said)
    assert outcome.stood
    assert {Trip(status.trip) for status in said} - {Trip.NONE} in ({Trip.EDGE}, {Trip.TIPPING})
    assert outcome.status.mode == PlannerMode.LEADING


def lean_slowly(newtons: float) -> tuple[Push, ...]:
    """Return a push from the side that rises in 20 steps from 2.5 s to 5.5 s, until 9.5 s."""
    starts = [2.5 + 3.0 * step / 20 for step in range(20)]
    return tuple(Push(at=at, duration=9.5 - at, force=(0.0, newtons / 20, 0.0)) for at in starts)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("height", "newtons"), [(1.188, 55.0), (1.188, -50.0), (0.95, 55.0)])
def test_leaned_on_slowly_it_is_led_on_and_comes_back_and_killed_then_it_stands(
    robot: RobotConfig, height: float, newtons: float
) -> None:
    """The push goes on while the planner dies, and ends afterwards."""
    led: list[float] = []

    def look(fleet: Lockstep, truth: SimTruth) -> None:
        if truth.scenario_s < 8.0:
            led.append(truth.com[1])
            assert set(modes_of(fleet)) == {Mode.TRACK}

    leant = still(11.0, height, push=lean_slowly(newtons), kill=kill(8.0))
    outcome = run(robot, leant, each=look)
    assert outcome.stood
    assert abs(led[-1]) < 0.8 * max(map(abs, led))


def test_leaned_on_by_30_newtons_it_is_led_on(robot: RobotConfig) -> None:
    outcome = run(robot, variant("stand", duration=4.0, push=(lean(30.0, at=0.3),)))
    assert outcome.stood
    assert Cause.HOLD_ALL not in causes(outcome)
