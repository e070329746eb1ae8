"""The Gymnasium environment: the same robot, behind the same certificate."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from services.planner.law.certificate import Certificate
from shared.bus import topics
from shared.bus.messages import JointCommand, JointState, Message
from shared.bus.topics import Topic
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.lockstep.runs import still
from tools.lab.design.poses import Poses
from tools.lab.learning.environment import FALLEN, BalanceEnv, standing_reward
from tools.lab.learning.policy import ACTIONS, OBSERVED, PolicyController
from tools.sim.lockstep import Lockstep, begin_standing


@pytest.fixture
def env() -> Iterator[BalanceEnv]:
    made = BalanceEnv(still(0.5))
    yield made
    made.close()


def test_it_passes_gymnasiums_checker(env: BalanceEnv) -> None:
    check_env(env, skip_render_check=True)


def test_with_zeros_it_is_the_shipped_law_and_stands_to_the_end(env: BalanceEnv) -> None:
    observation, info = env.reset(seed=1)
    assert observation.shape == (OBSERVED,)
    steps, rewards, done = 0, 0.0, False
    while not done:
        observation, reward, fallen, done, info = env.step(np.zeros(ACTIONS))
        steps, rewards = steps + 1, rewards + reward
        assert not fallen
        assert env.observation_space.contains(observation)
    assert steps == pytest.approx(125, abs=2), "a step is 4 ms"
    assert rewards > 0.9 * steps
    assert info["led"]
    assert info["why"] == ""


def test_a_policy_runs_in_the_planner_as_in_the_environment_to_the_last_bit(
    env: BalanceEnv, robot: RobotConfig
) -> None:
    weights = 0.02 * np.random.default_rng(5).standard_normal((ACTIONS, OBSERVED))
    here: list[np.ndarray] = []

    def policy(observation: np.ndarray) -> np.ndarray:
        here.append(observation)
        return np.tanh(weights @ observation) * 0.01

    fleet = Lockstep(robot, still(0.5), seed=1, controller=lambda: PolicyController(policy))
    begin_standing(fleet)
    for _ in fleet.run():
        pass
    observation, _ = env.reset(seed=1)
    there = [observation]
    while True:
        observation, _, fallen, done, _ = env.step(np.tanh(weights @ observation) * 0.01)
        if fallen or done:
            break
        there.append(observation)
    assert np.array_equal(np.array(here), np.array(there))


def test_two_episodes_of_one_seed_are_equal_and_of_two_seeds_are_not(env: BalanceEnv) -> None:
    def episode(seed: int) -> np.ndarray:
        first, _ = env.reset(seed=seed)
        return np.array([first, *(env.step(np.zeros(ACTIONS))[0] for _ in range(30))])

    assert np.array_equal(episode(3), episode(3))
    assert not np.array_equal(episode(3), episode(4)), "the sensors' noise is of the seed"


def test_who_steps_before_the_reset_or_closes_twice_is_told(env: BalanceEnv) -> None:
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(ACTIONS))
    env.reset(seed=1)
    env.close()
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(ACTIONS))


def test_after_the_end_it_asks_for_a_reset_and_does_not_wait(env: BalanceEnv) -> None:
    env.reset(seed=1)
    while not env.step(np.zeros(ACTIONS))[3]:
        pass
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(ACTIONS))
    env.reset(seed=2)


@pytest.mark.parametrize("action", [np.zeros(35), np.full(ACTIONS, np.nan), np.zeros((1, ACTIONS))])
def test_an_action_that_is_none_raises_and_the_episode_goes_on(
    env: BalanceEnv, action: np.ndarray
) -> None:
    env.reset(seed=1)
    with pytest.raises(InvalidAction):
        env.step(action)
    env.step(np.zeros(ACTIONS))


@pytest.mark.sampled(10)
@pytest.mark.parametrize("number", range(100))
def test_no_random_policy_gets_an_uncertified_gain_to_a_drive_and_the_robot_stands(
    robot: RobotConfig, number: int
) -> None:
    """The gains that a module uses are judged here once more, at the measured joints."""
    dice = np.random.default_rng(number)
    reach = 10.0 ** dice.uniform(-3.0, 0.0)
    states: dict[str, JointState] = {}
    commands: dict[tuple[str, int], JointCommand] = {}
    used: list[tuple[np.ndarray, np.ndarray]] = []

    def record(topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointCommand):
            commands[module, message.seq] = message
        elif topic is topics.JOINT_STATE and isinstance(message, JointState):
            states[module] = message

    def policy(_observation: np.ndarray) -> np.ndarray:
        return reach * dice.uniform(-1.0, 1.0, ACTIONS)

    fleet = Lockstep(
        robot, still(1.0), seed=1, record=record, controller=lambda: PolicyController(policy)
    )
    begin_standing(fleet)
    for number_of, truth in enumerate(fleet.run()):
        assert not truth.fallen
        if number_of % 10 == 0 and len(states) == len(MODULES):
            held = [commands.get((name, states[name].command_seq)) for name in MODULES]
            if all(command is not None for command in held):
                D = np.array([gain for c in held if c is not None for gain in c.k_p])
                used.append((np.array([a for name in MODULES for a in states[name].q]), D))
    poses, certificate, margins = Poses(robot), Certificate(robot), list[float]()
    for q, D in used:
        node = poses.node_at(q)
        certificate.at(node.T, node.hessians[0])
        margins.append(certificate.margins(D).service)
    least = 0.93 * robot.certificate.margin_min
    assert min(margins) > least, "the pose of the certificate is the reference, not q"


def test_a_fall_is_worth_less_than_any_stand(robot: RobotConfig) -> None:
    fleet = Lockstep(robot, still(0.1))
    begin_standing(fleet)
    truth = next(fleet.run())
    assert FALLEN < standing_reward(truth, led=False) < standing_reward(truth, led=True) <= 1.0
