"""A controller of somebody's own: how it is found, what it may do, what holds all instead."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.planner.controller import Action, Observation, controller_maker
from services.planner.intents import OperatorRequest
from services.planner.law.hocca import Hocca, LawInputs, LawState
from services.planner.watch.controller_guard import SUPPORT, ControllerGuard, GuardState
from shared.bus.messages import SplitSource
from shared.exceptions import ConfigError
from shared.robot.frames import capture_point
from shared.robot.robot_model import stand_pose
from shared.state import copied
from tests.planner.states import ROBOT, Kept

GOOD = """
class Controller:
    made = 0
    def __init__(self, robot):
        self.name = robot.name
        Controller.made += 1
    def reset(self, seen): pass
    def step(self, seen): pass

def other(robot):
    return Controller(robot)
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    return tmp_path / "mine.py"


@pytest.mark.parametrize("name", ["", ":Controller", ":other"])
def test_each_planner_gets_one_of_its_own_made_of_the_robot(mine: Path, name: str) -> None:
    """The one that was looked at is the first planner's: it may have opened a device."""
    (mine.parent / "beside_my_controller.py").write_text("GAIN = 3", encoding="utf-8")
    mine.write_text(f"import beside_my_controller\n{GOOD}", encoding="utf-8")
    make: Callable[[], Any] = controller_maker(f"{mine}{name}", ROBOT)
    first = make()
    assert (first.name, type(first).made) == (ROBOT.name, 1)
    assert make() is not first
    assert type(first).made == 2


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        (GOOD, ":Absent", "has no Absent; define a class or function Absent"),
        ("def Controller(robot): return 3", "", "has no reset and no step"),
        ("class Controller:\n  def reset(self, s): pass\n  def __init__(self, r): pass", "",
         "has no step; define reset"),
        ("def Controller(): pass", "", "raised TypeError"),
        ("import nowhere_to_be_found", "", "raised ModuleNotFoundError: No module named"),
        ("def (", "", "raised SyntaxError"),
        ("1 / 0", "", "raised ZeroDivisionError"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_one_clear_line(
    mine: Path, text: str, name: str, said: str
) -> None:
    mine.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        controller_maker(f"{mine}{name}", ROBOT)
    assert said in str(caught.value)
    assert "mine.py" in str(caught.value)
    assert "\n" not in str(caught.value)


GEOMETRY = ROBOT.geometry


@pytest.fixture(scope="module")
def hocca() -> Hocca:
    return Hocca(ROBOT)


@pytest.fixture(scope="module")
def seen(hocca: Hocca) -> Observation:
    q, v = np.array(stand_pose(ROBOT, 1.1)), np.zeros(12)
    law = hocca.tick(LawState(), LawInputs(q, v, 0.004))
    J, T = hocca.measured.J.copy(), hocca.reference.T.copy()
    return Observation(
        0.0, 0.004, q, v, v, law.p, law.pdot, J, T, None, OperatorRequest(), law,
    )  # fmt: skip


class Scripted:
    """Does what a function says, and counts how often it is asked."""

    def __init__(self, act: Callable[[Observation], Any]) -> None:
        self._act = act
        self.steps = self.resets = 0
        self.times: list[float] = []

    def reset(self, _seen: Observation) -> None:
        self.resets += 1

    def step(self, seen: Observation) -> Any:
        self.steps += 1
        self.times.append(seen.time_s)
        return self._act(seen)


def changed(**parts: Any) -> Callable[[Observation], Action]:
    return lambda seen: Action.from_law(seen.law)._replace(**parts)


def scaled(scale: float) -> Callable[[Observation], Action]:
    """Return what scales the local stiffness."""
    return lambda seen: Action.from_law(seen.law)._replace(D=scale * seen.law.local.D)


def guarding(controller: Scripted, hocca: Hocca) -> Kept:
    return Kept(ControllerGuard(controller, hocca, GEOMETRY), GuardState())


def ticks_held(guard: Kept, seen: Observation) -> int:
    """Return the ticks for which all hold, without a lead."""
    count = 0
    while guard.act(seen, leads=False).local.source is SplitSource.UNCERTIFIED:
        count += 1
    return count


def test_what_is_the_shipped_laws_stays_it_to_the_last_bit(hocca: Hocca, seen: Observation) -> None:
    """One that leads at once is reset first: re-execution begins in the middle of a run."""
    mine = Scripted(changed())
    found = guarding(mine, hocca).act(seen, leads=True)
    assert (mine.resets, mine.steps) == (1, 1)
    for own, shipped in zip(Action.from_law(found), Action.from_law(seen.law), strict=True):
        assert np.array_equal(own, shipped)
    assert found.local.margins == seen.law.local.margins
    assert found.local.source is SplitSource.CONTROLLER
    assert np.array_equal(found.local.D_B, seen.law.local.D_B)


def test_unless_it_leads_the_shipped_law_counts(hocca: Hocca, seen: Observation) -> None:
    mine = Scripted(changed(tau_coupled=np.ones(12)))
    guard = guarding(mine, hocca)
    assert guard.act(seen, leads=False) is seen.law
    assert (mine.resets, mine.steps) == (1, 0)
    for _ in range(3):
        assert np.array_equal(guard.act(seen, leads=True).tau_coupled, np.ones(12))
    assert (mine.resets, mine.steps) == (1, 3)
    assert mine.times == pytest.approx([0.004, 0.008, 0.012])


def raises(_seen: Observation) -> Action:
    raise ZeroDivisionError("the mass is 0")


NAN = np.full(12, math.nan)
BAD = {
    "None": lambda _: None,
    "a tuple": lambda seen: tuple(Action.from_law(seen.law)),
    "raises": raises,
    "too short": changed(q_ref=np.zeros(11)),
    "a matrix": changed(D=np.ones((12, 1))),
    "a list": changed(tau_ff=[0.0] * 12),
    "whole numbers": changed(tau_ff=np.zeros(12, int)),
    "long doubles": changed(tau_ff=np.zeros(12, np.longdouble)),
    "complex": changed(v_ref=np.zeros(12, complex)),
    **{f"{part} is NaN": changed(**{part: NAN}) for part in Action._fields},
    "infinite": changed(tau_coupled=np.full(12, math.inf)),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_action_holds_all(hocca: Hocca, seen: Observation, name: str) -> None:
    """Another guard goes on from the same state, and does not ask its own either."""
    mine, other = Scripted(BAD[name]), Scripted(changed())
    guard, again = guarding(mine, hocca), guarding(other, hocca)
    for tick in range(3):
        found = (guard if tick < 2 else again).act(seen, leads=True)
        assert found.local.source is SplitSource.UNCERTIFIED
        for part, shipped in zip(Action.from_law(found), Action.from_law(seen.law), strict=True):
            assert np.array_equal(part, shipped), "nothing of it is sent"
        assert guard.state.why.startswith("the controller r")
        again.state = copied(guard.state)
    assert (mine.steps, other.steps) == (1, 0)


@pytest.mark.parametrize("scale", [0.0, 0.3, 0.6, -1.0, 1e3])
def test_gains_that_fall_are_never_sent(hocca: Hocca, seen: Observation, scale: float) -> None:
    """Each objection makes all hold twice as long; then it is asked again, at another pose."""
    soft, waits = Scripted(scaled(scale)), (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0)
    guard, seen = guarding(soft, hocca), seen._replace(dt=0.05)
    for steps, wait in enumerate(waits if scale == 0.3 else waits[:2], 1):
        found = guard.act(seen, leads=True)
        assert found.local.source is SplitSource.UNCERTIFIED
        assert np.array_equal(found.local.D, seen.law.local.D)
        assert "do not hold the robot alone" in guard.state.why
        assert seen.dt * (1 + ticks_held(guard, seen)) == pytest.approx(wait, abs=0.1)
        assert (guard.state.why, soft.steps) == ("", steps)


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_stiffer_gains_that_stand_are_sent(hocca: Hocca, seen: Observation, scale: float) -> None:
    stiff = Scripted(scaled(scale))
    found = guarding(stiff, hocca).act(seen, leads=True)
    assert found.local.source is SplitSource.CONTROLLER
    assert np.array_equal(found.local.D, scale * seen.law.local.D)
    assert found.local.margins.service >= seen.law.local.margins.service


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("part", ["p", "pdot"])
def test_near_the_edge_of_the_soles_it_is_not_followed(
    hocca: Hocca, seen: Observation, axis: int, sign: float, part: str
) -> None:
    """By the place of the COM and by its rate, up to the edge itself and beyond it."""
    half = (GEOMETRY.l_foot / 2, (GEOMETRY.w_base + GEOMETRY.w_foot) / 2)[axis]
    gain = 1.0 if part == "p" else math.sqrt(seen.p[2] / 9.81)
    for fraction, followed in ((0.99, True), (1.01, False), (5.0, False), (math.nan, False)):
        p, pdot = seen.p.copy(), np.zeros(6)
        p[:2] = 0.0
        (p if part == "p" else pdot)[axis] = sign * fraction * SUPPORT * half / gain
        guard = Kept(ControllerGuard(Scripted(changed()), hocca, GEOMETRY), GuardState())
        found = guard.act(seen._replace(p=p, pdot=pdot), leads=True)
        assert (found.local.source is SplitSource.CONTROLLER) is followed, fraction
        assert ("near the edge" in guard.state.why) is not followed


def test_on_a_slope_the_capture_point_is_against_gravity() -> None:
    p = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    assert capture_point(p, (0.0,) * 6, (0.05, -0.02)) == (-0.05, 0.02), "downhill of the ankles"


def test_what_it_sees_cannot_be_written(hocca: Hocca, seen: Observation) -> None:
    for part in ("p", "pdot", "q", "J", "T"):

        def write(shown: Observation, part: str = part) -> Action:
            getattr(shown, part)[...] = 0.0
            return Action.from_law(shown.law)

        guard = guarding(Scripted(write), hocca)
        before = getattr(seen, part).copy()
        assert guard.act(seen, leads=True).local.source is SplitSource.UNCERTIFIED
        assert "read-only" in guard.state.why
        assert np.array_equal(getattr(seen, part), before)


def test_after_the_edge_all_hold_until_it_is_calm(hocca: Hocca, seen: Observation) -> None:
    guard, p = guarding(Scripted(changed()), hocca), seen.p.copy()
    p[0] = GEOMETRY.l_foot / 2
    away = seen._replace(p=p)
    guard.act(away, leads=True)
    for _ in range(1000):
        assert guard.act(away, leads=False).local.source is SplitSource.UNCERTIFIED
    assert ticks_held(guard, seen) == pytest.approx(250, abs=2)


def test_references_off_the_soles_are_not_sent(hocca: Hocca, seen: Observation) -> None:
    """Each joint is within its bounds; held, the whole would lean by 8 cm."""
    lean = Scripted(changed(q_ref=seen.law.q_ref + 0.08 * seen.T[:, 0]))
    guard = guarding(lean, hocca)
    assert guard.act(seen, leads=True).local.source is SplitSource.UNCERTIFIED
    assert guard.state.why.startswith("the rest position in HOLD is at ")
