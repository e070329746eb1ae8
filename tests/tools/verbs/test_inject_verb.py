"""`xrl inject`: what it asks of the network proxy, and what it shows."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.config.scenarios import Inject
from shared.links import COMMANDS
from shared.network.proxy_protocol import RequestedImpairment
from tools import cli
from tools.verbs import inject

BEGUN = RequestedImpairment(1, "planner->joints", "delay=30ms", None, 10, 0, hidden=COMMANDS[:3])
COMING = RequestedImpairment(2, "all", "loss=100%", 7.0, 0, 0, in_s=2.0)


class FakeProxy:
    """In place of the client of one that is there."""

    began: tuple[Inject, float] | None = None
    cleared = ""

    def __init__(self, run_dir: Path) -> None:
        pass

    def begin(self, what: Inject, in_s: float) -> tuple[RequestedImpairment, ...]:
        FakeProxy.began = (what, in_s)
        return (BEGUN, COMING)

    def clear(self, link: str) -> tuple[RequestedImpairment, ...]:
        FakeProxy.cleared = link
        return (COMING,)

    def list(self) -> tuple[RequestedImpairment, ...]:
        return (BEGUN, COMING)


@pytest.fixture(autouse=True)
def proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inject, "ProxyClient", FakeProxy)
    monkeypatch.setattr(FakeProxy, "began", None)


def test_the_words_state_what_where_and_when() -> None:
    assert cli.main(["inject", "all loss=20% at=2 for=3"]) == 0
    assert FakeProxy.began == (Inject(link="all", at=2.0, duration=3.0, loss=0.2), 2.0)


def test_clearing_reports_what_it_ended_with_its_counts_and_what_is_left(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for words, link in (("--clear all", "all"), ("--clear planner->left", "planner->left")):
        assert cli.main(["inject", *words.split()]) == 0
        assert FakeProxy.cleared == link
        ended, left = capsys.readouterr().out.split("\n", 1)
        assert ended == "ended: planner->joints delay=30ms; 10 passed, 0 lost"
        assert "loss=100%" in left


def test_the_list_shows_what_is_hidden_and_by_which_rule_and_what_is_to_come(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["inject", "--list"]) == 0
    shown = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "planner->joints delay=30ms hidden on 3 of 6 until --clear 10 0" in shown
    assert "all loss=100% in 2.0 s 5.0 s 0 0" in shown
    assert f"hidden: {inject.RULE}" in shown
