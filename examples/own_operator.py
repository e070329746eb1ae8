"""A simulated operator of your own: a hand that leads with at most 12 N along z.

The shipped hand is the class `Operator`; this script replaces its method `force`. Controllers
receive only the resulting wrench at the harness. Run: python examples/own_operator.py
"""

from __future__ import annotations

import math

from services.simulator.physics.operator import HandForce, Operator
from shared.config.files import load
from shared.config.scenarios import Keyframe, Lead, Scenario
from shared.places import DEFAULT_CONFIG
from tools.sim.lockstep import Lockstep, begin_standing

LIMIT = 12.0  # N


class GentleHand(Operator):
    """The shipped hand with a soft limit on its force along z."""

    def force(
        self, wanted: Lead, height: float, rate: float, pitch: float, pitch_rate: float
    ) -> HandForce:
        """Return the hand's force; see `Operator.force`."""
        firm = super().force(wanted, height, rate, pitch, pitch_rate)
        return HandForce(LIMIT * math.tanh(firm.force_z / LIMIT), firm.moment_pitch)


def main() -> None:
    """Lead a squat with each hand; print its peak force and the torso's final height."""
    robot = load(DEFAULT_CONFIG)
    down = (Keyframe(at=0.0, height=1.188), Keyframe(at=2.5, height=0.988))
    scenario = Scenario(name="gentle", about="down by 0.2 m", duration=3.5, keyframe=down)
    for name, hand in (("shipped", Operator), ("gentle", GentleHand)):
        fleet = Lockstep(robot, scenario, seed=1)
        begin_standing(fleet)
        fleet.world.outside.operator = hand(robot.simulation.operator, robot.geometry.harness_point)
        rows = [row for row in fleet.run() if row.scenario_s >= 0.0]
        peak = max(abs(row.operator_force[2]) for row in rows)
        print(f"{name:8} hand: {peak:5.1f} N at most, torso at {rows[-1].torso[2]:.3f} m")


if __name__ == "__main__":
    main()
