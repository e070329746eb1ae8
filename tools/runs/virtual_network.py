"""The links of lockstep, and what a scenario does to them (docs/architecture.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from shared.bus.links import ATTITUDES, DIRECTIONS, WRENCHES
from shared.bus.messages import Attitude, JointCommand, JointState, Wrench
from shared.bus.traces import LinkEvent
from shared.config.scenarios import Inject
from shared.network.impairment import Impairment
from shared.network.impairment_schedule import ImpairmentSchedule
from shared.robot.joints import MODULES
from tools.runs.network import VirtualLink


class VirtualNetwork:
    """Every link, by direction."""

    def __init__(
        self,
        base: Impairment,
        injects: Sequence[Inject],
        seed: int,
        record: Callable[[LinkEvent], None],
    ) -> None:
        """Begin with what every link does by itself.

        Args:
            base: that.
            injects: what is done to them, and when.
            seed: of all that is decided.
            record: takes an event whenever something begins or ends.
        """
        self._links: dict[str, VirtualLink[Any]] = {
            name: VirtualLink(base, name, seed) for name in DIRECTIONS
        }
        self._injections = ImpairmentSchedule(
            {name: link.direction for name, link in self._links.items()}, record
        )
        for inject in sorted(injects, key=lambda inject: inject.at):
            self._injections.plan(inject.link, inject, inject.at, inject.until)

    def commands(self) -> list[VirtualLink[JointCommand]]:
        """Return the links from the planner, in the order of the modules."""
        return [self._links[f"planner->{module}"] for module in MODULES]

    def states(self) -> list[VirtualLink[JointState]]:
        """Return the links to the planner, in the order of the modules."""
        return [self._links[f"{module}->planner"] for module in MODULES]

    def wrenches(self) -> VirtualLink[Wrench]:
        """Return the link from the harness to the planner."""
        return self._links[WRENCHES]

    def attitudes(self) -> VirtualLink[Attitude]:
        """Return the link from the IMU to the planner."""
        return self._links[ATTITUDES]

    def advance(self, scenario_s: float, now_ns: int) -> None:
        """Begin and end what is due, and let out what was held until then."""
        if self._injections.advance(scenario_s, now_ns):
            for link in self._links.values():
                link.release(now_ns)

    def end(self, now_ns: int) -> None:
        """End all that is done, so that its counts are told: the run is over."""
        self._injections.clear("all", now_ns)
