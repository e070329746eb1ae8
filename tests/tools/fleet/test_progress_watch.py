"""How long a start may take: as long as it goes on."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from tools.fleet import supervise
from tools.fleet.supervise import START_MAX_S, _ProgressWatch

TIMEOUT_S = 30.0

GivenUp = Callable[[Callable[[float], float], Callable[[float], int]], tuple[float, str]]


@pytest.fixture
def given_up(monkeypatch: pytest.MonkeyPatch) -> GivenUp:
    """Return what gives the time at which a start is given up, and why.

    It takes the processor time used, and the number of services that are not up, each by the time.
    """

    def run(used_s: Callable[[float], float], waiting: Callable[[float], int]) -> tuple[float, str]:
        now_s = 0.0
        monkeypatch.setattr(supervise, "time", SimpleNamespace(monotonic=lambda: now_s))
        watch = _ProgressWatch(TIMEOUT_S, lambda _: used_s(now_s))
        while not (why := watch.look(["x"] * waiting(now_s))):
            now_s += 0.1
        return now_s, why

    return run


@pytest.mark.parametrize(
    ("used_s", "waiting", "at_s", "why"),
    [
        (lambda _: 0.0, lambda _: 9, TIMEOUT_S, "no progress for 30 s"),
        (lambda t: min(t, 100.0) / 200, lambda _: 9, 100 + TIMEOUT_S, "no progress for 30 s"),
        (lambda _: 0.0, lambda t: 9 - int(t > 25), 25 + TIMEOUT_S, "no progress for 30 s"),
        (lambda t: 0.0005 * t, lambda _: 9, TIMEOUT_S, "no progress for 30 s"),
        (lambda t: t, lambda _: 9, START_MAX_S, "not up after 600 s"),
    ],
    ids=["nothing moves", "a busy machine", "one comes up", "a wait", "it never ends"],
)
def test_a_start_is_given_up_when_it_makes_no_progress(
    given_up: GivenUp,
    used_s: Callable[[float], float],
    waiting: Callable[[float], int],
    at_s: float,
    why: str,
) -> None:
    ended_s, said = given_up(used_s, waiting)
    assert ended_s == pytest.approx(at_s, abs=12.0)
    assert why in said
