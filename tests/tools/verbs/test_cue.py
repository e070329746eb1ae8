"""What the wearer is told of the robot's state."""

from __future__ import annotations

import pytest

from shared.bus.messages import Mode, PlannerMode
from tools.verbs.cue import Cue, cue_of

TRACKS = [Mode.TRACK] * 6


@pytest.mark.parametrize(
    ("modes", "planner", "cue"),
    [
        (TRACKS, PlannerMode.LEADING, Cue.FOLLOWS),
        (TRACKS, PlannerMode.TRIPPED, Cue.HOLDS),
        (TRACKS, None, Cue.HOLDS),
        ([*TRACKS[:5], Mode.HOLD], PlannerMode.LEADING, Cue.HOLDS),
        ([*TRACKS[:5], None], PlannerMode.LEADING, Cue.HOLDS),
        ([None] * 6, None, Cue.HOLDS),
        ([*TRACKS[:5], Mode.DAMP], PlannerMode.LEADING, Cue.SINKS),
        ([Mode.DAMP] * 6, PlannerMode.FALLEN, Cue.FALLEN),
    ],
)
def test_the_wearer_is_told_that_it_follows_only_if_all_of_it_does(
    modes: list[int | None], planner: int | None, cue: Cue
) -> None:
    assert cue_of(modes, planner) is cue
