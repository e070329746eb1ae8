from __future__ import annotations

from typing import Any

import pytest

from tools.lab.studies.sweeps import kill
from tools.sim.lockstep import Lockstep, begin_standing


@pytest.fixture
def on_its_feet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trials begin on their feet: one robot on one plant is let down from its hoist once."""

    def standing(*arguments: Any, **named: Any) -> Lockstep:
        fleet = Lockstep(*arguments, **named)
        begin_standing(fleet)
        return fleet

    monkeypatch.setattr(kill, "Lockstep", standing)
