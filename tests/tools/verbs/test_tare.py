"""`xrl drive tare` against a harness service that the test plays."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from shared.bus.messages import Tare, TareRequest, Wrench
from shared.exceptions import FleetError
from tests.messages import sample
from tools.verbs.drive import tare


def wrench(up: float = 0.0, state: Tare = Tare.DONE, *, saturated: bool = False) -> Wrench:
    valid = state is Tare.DONE and not saturated
    return sample(Wrench, force=(0.0, 0.0, up), valid=valid, saturated=saturated, tare=state)


class Service:
    """Says what `answer` makes of the number of requests and the number of looks."""

    def __init__(self, answer: Callable[[int, int], Wrench | None]) -> None:
        self.requests: list[TareRequest] = []
        self._answer = answer
        self._looks = 0

    def put(self, message: TareRequest) -> bool:
        self.requests.append(message)
        return True

    def take(self) -> Wrench | None:
        self._looks += 1
        return self._answer(len(self.requests), self._looks)


@pytest.fixture(autouse=True)
def virtual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [0.0]

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    clock = SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep)
    monkeypatch.setattr(tare, "time", clock)


def test_it_asks_until_the_tare_has_begun_and_waits_until_it_is_done() -> None:
    begun_at = 0

    def answer(requests: int, looks: int) -> Wrench:
        nonlocal begun_at
        if requests < 3:  # two requests are lost
            return wrench(4.0)
        begun_at = begun_at or looks
        return wrench(4.0, Tare.RUNNING) if looks < begun_at + 5 else wrench()

    service = Service(answer)
    assert tare.tare(service, service, anyway=False).force[2] == 4.0
    assert [request.seq for request in service.requests] == [1, 2, 3]


@pytest.mark.parametrize(("up", "refused"), [(29.9, False), (-29.9, False), (30.1, True)])
def test_a_harness_that_is_held_is_not_tared(up: float, refused: bool) -> None:
    def answer(requests: int, looks: int) -> Wrench:
        return wrench(up, Tare.DONE if looks == 1 or looks > 3 else Tare.RUNNING)

    service = Service(answer)
    if refused:
        with pytest.raises(FleetError, match=r"30\.1 N.*unload it.*--anyway"):
            tare.tare(service, service, anyway=False)
        assert service.requests == []
    service = Service(answer)
    tare.tare(service, service, anyway=refused)
    assert service.requests


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (None, "no wrench"),
        (wrench(), "did not begin"),
        (wrench(0.0, Tare.UNSTEADY), "the forces vary"),
        (wrench(0.0, Tare.RUNNING, saturated=True), "end of its range"),
        (wrench(0.0, Tare.RUNNING), "do not send steadily"),
    ],
)
def test_a_tare_that_does_not_come_names_the_reason(said: Wrench | None, words: str) -> None:
    service = Service(lambda _requests, _looks: said)
    with pytest.raises(FleetError, match=words):
        tare.tare(service, service, anyway=False)
