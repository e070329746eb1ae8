"""A squat in virtual time, in which the planner is killed on the way down and restarted.

`Lockstep` steps world, drives, six joint controllers, harness and planner in one process. Every run
is bit-identical. Run: python examples/virtual_planner.py
"""

from __future__ import annotations

from pathlib import Path

from shared.bus.messages import Mode
from shared.config.files import load
from shared.config.scenarios import Keyframe, Kill, Restart, Scenario
from shared.places import DEFAULT_CONFIG
from tools.sim.lockstep import Lockstep

SQUAT = Scenario(
    name="example",
    about="down by 0.15 m and up again",
    duration=6.0,
    keyframe=(
        Keyframe(at=0.0, height=1.188),
        Keyframe(at=2.0, height=1.038),
        Keyframe(at=5.0, height=1.188),
    ),
    kill=(Kill(service="planner", at=1.2),),
    restart=(Restart(service="planner", at=2.0),),
)


def main(config: Path = DEFAULT_CONFIG) -> None:
    """Run the squat; print height, hand force and modes every half second."""
    fleet = Lockstep(load(config), SQUAT, seed=1)
    for truth in fleet.run():
        if truth.scenario_s >= 0.0 and round(truth.scenario_s * 100) % 50 == 0:
            modes = "".join(Mode(c.failsafe.mode).name[0] for c in fleet.controllers)
            print(
                f"{truth.scenario_s:4.1f} s  height {truth.torso[2]:.3f} m"
                f"  hand {truth.operator_force[2]:6.1f} N  {modes}"
            )
    print("fell" if fleet.world.truth(fleet.now_ns, 1.0, 0.0).fallen else "stood")


if __name__ == "__main__":
    main()
