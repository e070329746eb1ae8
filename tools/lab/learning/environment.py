"""A Gymnasium environment: the robot in virtual time, a policy in the planner's place.

A step is one tick in which the planner leads, 4 ms: the policy sees what the planner sees and its
action goes into the commands of the same tick. While all hold, as after a refused action, time goes
on without asking. The needed package is the extra `learn`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, Final

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces

from services.planner.controller import Action, Observation
from services.simulator.physics.plant import PlantConfig
from shared.arrays import Array
from shared.bus.messages import Mode
from shared.bus.traces import SimTruth
from shared.config.files import load
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.config.scenarios import load as load_scenario
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tools.lab.learning.policy import ACTIONS, LARGEST, OBSERVED, acted, observed
from tools.lab.studies.sweeps import plants
from tools.live.experiment import scenario_file
from tools.sim.lockstep import Lockstep, begin_standing

FALLEN: Final = -100.0
"""Reward of a fall."""
_SWAY: Final = 0.05
"""m; a COM that far off the ankles costs as much as standing gives."""
_HAND: Final = 100.0
"""N"""

Reward = Callable[[SimTruth, bool], float]
"""Takes the world and whether all six modules track."""


def standing_reward(truth: SimTruth, led: bool) -> float:
    """Return 1 for a robot that stands over its ankles with a light hand, less for any other."""
    x, y = truth.over
    sway = (x / _SWAY) ** 2 + (y / _SWAY) ** 2
    hand = sum(abs(part) for part in truth.operator_force) / _HAND
    return float(np.clip(1.0 - sway - hand - (0.0 if led else 1.0), -1.0, 1.0))


class BalanceEnv(gymnasium.Env[Array, Array]):
    """The balance task.

    Observation (56,) and action (36,) are those of `tools.lab.learning.policy`; an action of zeros
    is the shipped law. An episode ends with a fall, or with the scenario.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(
        self,
        scenario: Scenario | str = "squat",
        *,
        robot: RobotConfig | None = None,
        drawn: bool = False,
        reward: Reward = standing_reward,
    ) -> None:
        """Set the task up.

        Args:
            scenario: what the person does and what happens, or a name from deploy/scenarios; its
                kills are left out.
            robot: ready to run; None: the shipped one.
            drawn: a plant with drawn errors for each episode, by its seed; else the realistic one.
            reward: of a step.
        """
        named = load_scenario(scenario_file(scenario)) if isinstance(scenario, str) else scenario
        self._scenario = msgspec.structs.replace(named, kill=(), restart=())
        self._robot = robot if robot is not None else load(DEFAULT_CONFIG)
        self._drawn, self._reward = drawn, reward
        self.observation_space = spaces.Box(-LARGEST, LARGEST, (OBSERVED,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float64)
        self._episode: _Episode | None = None
        self._seed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode where the robot stands and is led; without a seed, the next one."""
        super().reset(seed=seed, options=options)
        self.close()
        self._seed = seed if seed is not None else self._seed + 1
        plant = plants.draw(f"episode {self._seed}") if self._drawn else PlantConfig()
        self._episode = _Episode(self._robot, self._scenario, plant, self._seed)
        if not self._episode.await_turn():
            raise gymnasium.error.ResetNeeded("this plant was never led; take another seed")
        return self._episode.seen, self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Act at this tick and go on to the next one that is asked about."""
        episode = self._episode
        if episode is None or episode.over:
            raise gymnasium.error.ResetNeeded("reset() comes before step(), and after an end")
        given = np.array(action, float)
        if given.shape != (ACTIONS,) or not np.isfinite(given).all():
            raise gymnasium.error.InvalidAction(f"an action is {ACTIONS} finite numbers")
        episode.act(given)
        asked = episode.await_turn()
        truth = episode.truth
        fallen = truth is not None and truth.fallen
        reward = FALLEN if fallen else 0.0 if truth is None else self._reward(truth, episode.led)
        return episode.seen, reward, fallen, not asked and not fallen, self._info()

    def close(self) -> None:
        """End the episode."""
        if self._episode is not None:
            self._episode.close()
            self._episode = None

    def _info(self) -> dict[str, Any]:
        episode = self._episode
        truth = episode.truth if episode is not None else None
        if episode is None or truth is None:
            return {}
        return {"scenario_s": truth.scenario_s, "led": episode.led, "why": episode.why}


class _Closed(BaseException):
    """Leaves the run; no `except Exception` on the way keeps it."""


class _Episode:
    """A run in a thread of its own that takes turns with the environment: never both at once."""

    def __init__(
        self, robot: RobotConfig, scenario: Scenario, plant: PlantConfig, seed: int
    ) -> None:
        self.seen: Array = np.zeros(OBSERVED)
        self.truth: SimTruth | None = None
        self.over = False
        """Nobody asks for an action any more."""
        self._actions: SimpleQueue[Array | None] = SimpleQueue()
        self._turns: SimpleQueue[BaseException | bool] = SimpleQueue()
        self._fleet = Lockstep(robot, scenario, seed=seed, plant=plant, controller=lambda: self)
        self._begun = begin_standing(self._fleet)
        self._thread = threading.Thread(target=self._run, name="episode", daemon=True)
        self._thread.start()

    @property
    def led(self) -> bool:
        """True if all six modules track."""
        return all(one.failsafe.mode is Mode.TRACK for one in self._fleet.controllers)

    @property
    def why(self) -> str:
        """Why the policy is not followed, in words; "" if it is."""
        for name, one in zip(MODULES, self._fleet.controllers, strict=True):
            outside = one.failsafe.current_outside(self._fleet.now_ns, one.timing)
            if outside:
                return f"{name} refuses {outside.name.lower()}"
        planner = self._fleet.planner
        return "" if planner is None else planner.status(self._fleet.now_ns, 0.0).why

    def await_turn(self) -> bool:
        """Wait until an action is asked for; False: the run is over."""
        turn = self._turns.get()
        self.over = turn is not True
        if isinstance(turn, BaseException):
            raise turn
        return turn

    def act(self, action: Array) -> None:
        """Give the action that is asked for."""
        self._actions.put(action)

    def close(self) -> None:
        """Leave the run."""
        self._actions.put(None)
        self._thread.join()

    def reset(self, seen: Observation) -> None:
        """As a controller: the planner does not lead."""

    def step(self, seen: Observation) -> Action:
        """As a controller: hand what is seen over, and wait for the action."""
        self.seen = observed(seen)
        self._turns.put(True)
        action = self._actions.get()
        if action is None:
            raise _Closed
        return acted(action, seen)

    def _run(self) -> None:
        try:
            for truth in self._fleet.run():
                self.truth = truth
                if truth.fallen:
                    break
        except _Closed:
            return
        except BaseException as error:  # noqa: BLE001 - told to whoever waits
            self._turns.put(error)
            return
        self._turns.put(False)
