"""The planner's process as joint services on its host see it: real processes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shared.places import CHECKOUT
from shared.planner_life import OwnLife, PlannerLife, if_possible, path_of
from tests.waiting import comes_true

pytestmark = [pytest.mark.system]

PLANNER = """
import sys, time
from pathlib import Path
from shared.planner_life import OwnLife
own = OwnLife(Path(sys.argv[1]))
own.announce(int(sys.argv[2]))
print("up", flush=True)
time.sleep(60)
"""


@contextmanager
def planner(run_dir: Path, session: int) -> Iterator[subprocess.Popen[str]]:
    words = [sys.executable, "-c", PLANNER, str(run_dir), str(session)]
    with subprocess.Popen(words, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "up\n"
            yield process
        finally:
            process.kill()


def told(life: PlannerLife) -> int:
    """Wait until a session has ended; return it."""
    session = 0

    def ended() -> int:
        nonlocal session
        session = life.ended()
        return session

    assert comes_true(ended)
    return session


def test_each_service_is_told_once_of_a_process_that_was_killed(short_dir: Path) -> None:
    first, second = PlannerLife(short_dir), PlannerLife(short_dir)
    assert first.ended() == 0, "there is no planner"
    with planner(short_dir, 7) as process:
        assert (first.ended(), second.ended()) == (0, 0)
        process.kill()
        assert (told(first), told(second)) == (7, 7)
        assert (first.ended(), second.ended()) == (0, 0)


def test_one_that_hangs_is_left_to_the_age_rule(short_dir: Path) -> None:
    life = PlannerLife(short_dir)
    with planner(short_dir, 7) as process:
        life.ended()
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.2)
        assert life.ended() == 0


def test_one_that_was_gone_before_is_told_too_which_concerns_nobody_who_follows_another(
    short_dir: Path,
) -> None:
    with planner(short_dir, 7) as process:
        process.kill()
    assert told(PlannerLife(short_dir)) == 7


def test_the_next_planner_and_another_session_take_its_place(short_dir: Path) -> None:
    life = PlannerLife(short_dir)
    with planner(short_dir, 7) as process:
        life.ended()
        process.kill()
        assert told(life) == 7
    with planner(short_dir, 9) as process:
        assert life.ended() == 0
        process.kill()
        assert told(life) == 9
    own = OwnLife(short_dir)
    own.announce(10)
    assert life.ended() == 0
    own.announce(11)
    assert life.ended() == 0, "the process goes on in another session"


def test_without_shared_memory_a_service_does_without(
    short_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for end in (OwnLife, PlannerLife):
        assert if_possible(end, short_dir) is not None
    path_of(short_dir / "other").mkdir(parents=True)  # in the way
    for end in (OwnLife, PlannerLife):
        assert if_possible(end, short_dir / "other") is None
    assert caplog.text.count("a planner's end is seen by the age of its commands") == 2
