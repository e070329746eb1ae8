"""What the status line says of a planner that was started again."""

from __future__ import annotations

from shared.bus.messages import Mode, PlannerMode, PlannerStatus
from shared.bus.traces import SimTruth
from tests.messages import sample
from tools.live.planner_return import PlannerReturn

HELD, LED = [int(Mode.HOLD)] * 6, [int(Mode.TRACK)] * 6


class Statuses:
    def __init__(self) -> None:
        self.waiting: list[PlannerStatus] = []

    def take(self) -> PlannerStatus | None:
        return self.waiting.pop() if self.waiting else None


def truth(t_s: float) -> SimTruth:
    found: SimTruth = sample(SimTruth, t_ns=round(t_s * 1e9))
    return found


def test_it_says_what_the_planner_waits_for_and_how_long_until_all_six_track() -> None:
    statuses = Statuses()
    planner = PlannerReturn(statuses)
    assert planner.waits(truth(1.0), HELD) == ""
    planner.start(truth(2.0))
    statuses.waiting.append(sample(PlannerStatus, t_ns=1, why="of the planner before"))
    assert planner.waits(truth(2.5), HELD) == "starting for 0.5 s"
    for wait_s, why, words in ((0.0, "hot", "hot"), (1.5, "", "1.5 s more after drop-outs")):
        statuses.waiting.append(
            sample(
                PlannerStatus, t_ns=3_000_000_000, mode=int(PlannerMode.ALIGNING),
                wait_s=wait_s, why=why,
            )
        )  # fmt: skip
        assert planner.waits(truth(3.25), HELD) == f"ALIGNING for 1.2 s: {words}"
    assert planner.waits(truth(3.5), LED) == ""
    assert planner.waits(truth(3.6), HELD) == "", "it has led"
