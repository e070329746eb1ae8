"""Train a controller in a Gymnasium environment on lockstep.

A step is 10 ms of virtual time. The action is added to each joint's reference and coupled torque; a
zero action is the shipped law. Certificate, age rule and envelope stay active: the joint services
refuse a bad action, and the robot holds. Run: python examples/gym_environment.py
"""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
import numpy as np

from services.planner.controller import Action, Observation
from shared.arrays import Array
from shared.config.files import load
from shared.config.scenarios import load as load_scenario
from shared.places import DEFAULT_CONFIG, SCENARIOS
from tools.sim.lockstep import Lockstep, begin_standing

OFFSET, TORQUE = 0.01, 20.0  # added by an action of 1; rad and N m
LIMIT, FALL = 50.0, -100.0  # limit of an observation's elements; reward of a fall


class Residual:
    """Controller that adds an action to the shipped law."""

    action = np.zeros(24)
    seen = np.zeros(48)

    def reset(self, seen: Observation) -> None:
        """Store the observation while the planner does not lead."""
        parts = seen.q, seen.v / 5.0, seen.tau / 100.0, seen.p, seen.pdot
        self.seen = np.clip(np.concatenate(parts), -LIMIT, LIMIT)

    def step(self, seen: Observation) -> Action:
        """Return the law's action plus the action of this step."""
        self.reset(seen)
        law, (offset, torque) = Action.from_law(seen.law), self.action.reshape(2, 12)
        return law._replace(
            q_ref=law.q_ref + OFFSET * offset, tau_coupled=law.tau_coupled + TORQUE * torque
        )


class BalanceEnv(gymnasium.Env[Array, Array]):
    """Balance task over a scenario; an episode ends with a fall or with the scenario."""

    observation_space = gymnasium.spaces.Box(-LIMIT, LIMIT, (48,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (24,), np.float64)

    def __init__(self, scenario: str = "squat", duration: float = 9.0) -> None:
        """Load the shipped robot, and a scenario of deploy/scenarios without its kill."""
        loaded = load_scenario(SCENARIOS / f"{scenario}.toml")
        self._scenario = msgspec.structs.replace(loaded, kill=(), duration=duration)
        self._robot = load(DEFAULT_CONFIG)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode with a standing robot; the seed determines the sensors' noise."""
        super().reset(seed=seed, options=options)
        noise, law = int(self.np_random.integers(1 << 30)), Residual()
        self._law = law
        fleet = Lockstep(self._robot, self._scenario, seed=noise, controller=lambda: law)
        begin_standing(fleet)
        self._rows = fleet.run()
        next(self._rows)
        return law.seen, {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply an action for 10 ms; the reward is at most 1, with the COM over the ankles."""
        self._law.action = np.clip(action, -1.0, 1.0)
        row = next(self._rows, None)
        if row is None:
            return self._law.seen, 0.0, False, True, {}
        reward = FALL if row.fallen else 1.0 - sum((x / 0.05) ** 2 for x in row.over)
        return self._law.seen, float(reward), row.fallen, False, {}


def main() -> None:
    """Check the environment; print the rewards of the shipped law and of random actions."""
    from gymnasium.utils.env_checker import check_env  # noqa: PLC0415 - it takes a second

    env = BalanceEnv(duration=0.5)
    check_env(env, skip_render_check=True)
    for name, size in (("shipped law", 0.0), ("random", 1.0)):
        env.reset(seed=1)
        env.action_space.seed(1)
        total, fallen, ended = 0.0, False, False
        while not (fallen or ended):
            _, reward, fallen, ended, _ = env.step(size * env.action_space.sample())
            total += reward
        print(f"{name:12} reward {total:6.2f}, {'fell' if fallen else 'stood'}")


if __name__ == "__main__":
    main()
