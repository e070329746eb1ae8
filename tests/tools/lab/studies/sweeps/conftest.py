from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest

from shared.bus.traces import SimTruth
from tools.lab.studies.sweeps import kill
from tools.lab.studies.sweeps.figures import run_fleet
from tools.sim.lockstep import Lockstep, begin_standing


class StandingFleet(Lockstep):
    """One robot on one plant is let down from its hoist once."""

    def run(self) -> Iterator[SimTruth]:
        begin_standing(self)
        return super().run()


@pytest.fixture
def on_its_feet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trials begin on their feet."""
    monkeypatch.setattr(kill, "run_fleet", partial(run_fleet, fleet_type=StandingFleet))
