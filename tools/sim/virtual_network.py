"""The links of lockstep, with the scenario's impairments (docs/architecture.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from shared.bus.messages import Attitude, JointCommand, JointState, Wrench
from shared.bus.traces import LinkEvent
from shared.config.impairment import Impairment
from shared.config.scenarios import Inject
from shared.joints import MODULES
from shared.links import ATTITUDES, DIRECTIONS, WRENCHES
from shared.network.impairment_schedule import ImpairmentSchedule
from tools.sim.network import VirtualLink


class VirtualNetwork:
    """Every link, by direction."""

    def __init__(
        self,
        base: Impairment,
        injects: Sequence[Inject],
        seed: int,
        record: Callable[[LinkEvent], None],
    ) -> None:
        """Start with every link's own impairment.

        Args:
            base: the link's own impairment.
            injects: further impairments, with their times.
            seed: of all random draws.
            record: takes an event whenever an impairment starts or ends.
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
        """Start and end what is due, and release the messages held until then."""
        if self._injections.advance(scenario_s, now_ns):
            for link in self._links.values():
                link.release(now_ns)

    def cut(self, link: str, for_s: float, scenario_s: float, now_ns: int) -> None:
        """Cut links off now, for a while: somebody who looks on wants it.

        Args:
            link: of `shared.links`.
            for_s: how long, s.
            scenario_s: scenario time.
            now_ns: virtual time.
        """
        self._injections.begin(link, Impairment(partition=True), scenario_s + for_s, now_ns)

    def active(self, scenario_s: float) -> tuple[str, ...]:
        """Return the impairments that are active at a scenario time, in words."""
        return tuple(
            f"{row.link}: {row.what.describe()}"
            for row in self._injections.requested.values()
            if row.begins <= scenario_s
        )

    def end(self, now_ns: int) -> None:
        """End all impairments, so that their counts are recorded: the run is over."""
        self._injections.clear("all", now_ns)
