"""The robot of `xrl view --sim`: what a page asks of it, it does, and no more.

One robot for all of it: each test leaves it tracking, but for the last.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from shared.bus.messages import Mode
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tools.live.experiment import load_robot
from tools.view.frame import Frame, Order
from tools.view.lockstep import LockstepSource

LIMIT_S = 100.0


@pytest.fixture(scope="module")
def source() -> Iterator[LockstepSource]:
    made = LockstepSource(load_robot(DEFAULT_CONFIG))
    until(made, lambda frame: frame.modes == (Mode.TRACK,) * 6)
    yield made
    made.close()


def until(source: LockstepSource, holds: Callable[[Frame], bool]) -> Frame:
    """Wait for a frame, and return it."""
    deadline = time.monotonic() + LIMIT_S
    while True:
        frame = source.frame()
        if frame is not None and holds(frame):
            return frame
        assert time.monotonic() < deadline, frame
        time.sleep(0.005)


def test_it_follows_the_hand_and_is_pushed(source: LockstepSource) -> None:
    for wanted in (0.95, 1.15):
        assert source.carry_out(Order(order="hand", height=wanted)) == ""
        frame = until(source, lambda f, w=wanted: abs(f.torso[2] - w) < 0.01)  # type: ignore[misc]
        assert frame.modes == (Mode.TRACK,) * 6
    source.carry_out(Order(order="push", force=(0.0, 40.0, 0.0)))
    assert until(source, lambda frame: any(frame.push)).push == (0.0, 40.0, 0.0)
    until(source, lambda frame: not any(frame.push))


def test_a_killed_planner_is_held_and_a_started_one_leads(source: LockstepSource) -> None:
    until(source, lambda frame: frame.planner is not None and frame.planner.mode == "LEADING")
    source.carry_out(Order(order="kill", service="planner"))
    frame = until(source, lambda f: f.modes == (Mode.HOLD,) * 6)
    frame = until(source, lambda f: f.planner is None)
    assert frame.q_ref == ()
    source.carry_out(Order(order="start", service="planner"))
    until(source, lambda f: f.modes == (Mode.TRACK,) * 6)


def test_a_leg_that_is_cut_off_makes_all_hold_and_comes_back(source: LockstepSource) -> None:
    assert "one of left leg" in source.carry_out(Order(order="cut", service="cable"))
    assert source.carry_out(Order(order="cut", service="left leg")) == ""
    cut = until(source, lambda frame: frame.network != ())
    assert cut.network == ("planner->left: partition", "left->planner: partition")
    until(source, lambda frame: frame.modes == (Mode.HOLD,) * 6)
    until(source, lambda frame: frame.network == ())
    until(source, lambda frame: frame.modes == (Mode.TRACK,) * 6)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (Order(order="dance"), "'dance' is not an order; must be one of hand, push"),
        (Order(order="kill", service="simulator"), "'simulator' has no process here"),
        (Order(order="start"), "'' has no process here"),
    ],
)
def test_what_it_cannot_do_is_refused_in_words(
    source: LockstepSource, order: Order, words: str
) -> None:
    assert source.carry_out(order).startswith(words)


def test_its_model_has_every_body_and_joint(source: LockstepSource) -> None:
    model = source.model()
    assert set(model.joints) == set(MODULES)
    assert {body.frame for body in model.bodies} == {"torso", *MODULES}
    assert model.end_s == model.begin_s, "it has no timeline"
    assert np.all(np.array(model.foot) > 0.0)


def test_an_emergency_stop_sinks_it(source: LockstepSource) -> None:
    source.carry_out(Order(order="estop"))
    stopped = until(source, lambda frame: frame.modes == (Mode.DAMP,) * 6)
    until(source, lambda frame: frame.torso[2] < stopped.torso[2] - 0.05)
    assert not any("xrl " in way for way in stopped.ways_out), "there is no fleet to kill in"
