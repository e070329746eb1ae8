"""The harness sensor in virtual time."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from shared.bus import topics
from shared.bus.messages import Message, PlannerStatus, SimTruth, Tare, TareRequest, Wrench
from shared.bus.topics import Topic
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from tests.lockstep.runs import still, variant
from tools.sim.lockstep import Lockstep


def leaning(assist: float) -> Scenario:
    """Return a scenario in which the torso pitches while a load comes to rest on it."""
    frames = (
        Keyframe(at=0.0, height=1.188),
        Keyframe(at=2.0, height=1.1, pitch=0.4, assist=assist),
    )
    return variant("stand", duration=3.5, keyframe=frames)


def record(
    robot: RobotConfig, scenario: Scenario, delay_ms: float = 1.0, seed: int = 0
) -> tuple[Lockstep, list[Message]]:
    """Run a scenario; return every wrench, status and truth in the order of the log."""
    received: list[Message] = []

    def take(_topic: Topic, _module: str, message: Message) -> None:
        if isinstance(message, Wrench | PlannerStatus | SimTruth):
            received.append(message)

    fleet = Lockstep(robot, scenario, Impairment(delay_ms=delay_ms), seed=seed, record=take)
    for _ in fleet.run():
        pass
    return fleet, received


def of(kind: type[Message], heard: list[Message]) -> list[Message]:
    return [message for message in heard if isinstance(message, kind)]


def test_the_wrench_is_what_acts_on_the_torso_and_comes_at_its_rate(robot: RobotConfig) -> None:
    _, heard = record(robot, leaning(150.0))
    wrenches = {m.t_ns: m for m in heard if isinstance(m, Wrench)}
    stamps = sorted(wrenches)
    assert set(np.diff(stamps)) == {round(1e9 / robot.harness.rate_hz)}
    errors = []
    for truth in heard:
        if isinstance(truth, SimTruth) and truth.scenario_s > 3.0:
            # truth is told after the step, the sensor sampled before it: nothing moves fast
            wrench = wrenches[max(t for t in stamps if t <= truth.t_ns)]
            roll, pitch, _ = truth.angles
            x, y, z = wrench.force
            up = np.cos(roll) * (z * np.cos(pitch) - x * np.sin(pitch)) + np.sin(roll) * y
            errors.append(up + truth.harness_force_z)
            assert wrench.valid
            assert truth.harness_force_z > 100.0
            assert pitch > 0.3
    assert np.abs(np.mean(errors)) < 1.0
    assert np.abs(errors).max() < 4.0


def test_the_tare_is_done_on_the_hoist_before_anything_loads_the_harness(
    robot: RobotConfig,
) -> None:
    _, heard = record(robot, still(0.5))
    first_valid = next(m for m in heard if isinstance(m, Wrench) and m.valid)
    begin_ns = heard[0].t_ns
    assert first_valid.t_ns - begin_ns == pytest.approx(robot.harness.tare_s * 1e9, abs=5e6)
    hoisted = [m for m in heard if isinstance(m, SimTruth) and m.t_ns <= first_valid.t_ns]
    assert all(m.hoist > 0.5 and m.harness_force_z == 0.0 for m in hoisted)


def test_the_planner_receives_the_wrench_after_the_links_delay(robot: RobotConfig) -> None:
    _, heard = record(robot, still(0.5), delay_ms=8.0)
    sent = {m.seq: m.t_ns for m in heard if isinstance(m, Wrench)}
    ages_ms = [
        (m.t_ns - sent[m.wrench_seq]) / 1e6
        for m in heard
        if isinstance(m, PlannerStatus) and m.wrench_seq >= 0
    ]
    assert len(ages_ms) > 100
    assert min(ages_ms) >= 8.0
    assert max(ages_ms) < 8.0 + 2e3 / robot.planner.rate_hz


def test_the_wrench_is_bit_identical_with_the_same_seed_and_another_with_another(
    robot: RobotConfig,
) -> None:
    runs = [record(robot, still(0.3), seed=seed)[1] for seed in (4, 4, 5)]
    wrenches = [of(Wrench, heard) for heard in runs]
    assert wrenches[0] == wrenches[1]
    assert wrenches[0] != wrenches[2]


def unheeded(robot: RobotConfig) -> RobotConfig:
    """Return the robot with nothing made of the wrench."""
    law = msgspec.structs.replace(robot.law, lead_easing=0.0, load_correction=(0.0, 0.0))
    assist = msgspec.structs.replace(robot.assist, integral_max=0.0)
    return msgspec.structs.replace(robot, law=law, assist=assist)


def test_the_sensors_noise_reaches_the_robot_through_the_law_only(robot: RobotConfig) -> None:
    deaf = unheeded(robot)
    quiet = msgspec.structs.replace(robot.simulation, harness_noise=0.0)
    noiseless = msgspec.structs.replace(deaf, simulation=quiet)
    truths = [of(SimTruth, record(config, still(0.5))[1]) for config in (deaf, noiseless)]
    assert truths[0] == truths[1]


def test_a_tare_on_request_takes_what_rests_on_the_harness_for_its_zero(
    robot: RobotConfig,
) -> None:
    received: list[Wrench] = []

    def take(_topic: Topic, _module: str, message: Message) -> None:
        if isinstance(message, Wrench):
            received.append(message)

    fleet = Lockstep(unheeded(robot), leaning(150.0), record=take)
    loaded: Wrench | None = None
    for truth in fleet.run():
        if loaded is None and truth.scenario_s >= 2.7:
            loaded = received[-1]
            fleet.harness.tare(TareRequest(t_ns=fleet.now_ns, seq=1, source="a test"))
    assert loaded is not None
    assert loaded.valid
    assert np.linalg.norm(loaded.force) > 100.0
    after = received[received.index(loaded) + 1 :]
    assert {m.tare for m in after if not m.valid} == {Tare.RUNNING}
    assert received[-1].valid
    assert np.linalg.norm(received[-1].force) < 10.0


def test_the_topic_of_the_wrench_is_recorded(robot: RobotConfig) -> None:
    seen: set[tuple[str, str]] = set()
    fleet = Lockstep(
        robot, still(1.0), record=lambda topic, module, _: seen.add((topic.name, module))
    )
    for _ in range(20):
        fleet.advance()
    assert (topics.WRENCH.name, "") in seen
