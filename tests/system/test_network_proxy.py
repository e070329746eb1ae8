"""The network proxy as a process, between two real sessions of the bus.

One is shared by all tests that leave it as they found it.
"""

from __future__ import annotations

import math
import resource
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.config.scenarios import Inject
from shared.links import ATTITUDES
from tests.system.proxied import Heard, Proxied, proxied
from tools import cli

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

BESIDE = ATTITUDES
"""A link that no test impairs: what is told of it comes after all that was told before."""
SPARE = 12
"""Descriptors beyond those of the links that are up; each dial takes two."""


@pytest.fixture(scope="module")
def shared() -> Iterator[Proxied]:
    with proxied("knee_left") as links:
        yield links


@pytest.fixture
def rig(shared: Proxied) -> Iterator[Proxied]:
    """Return links to which nothing is done, neither before nor after."""
    shared.wait(shared.linked)
    yield shared
    shared.client.clear("all")
    shared.client.begin(Inject(link=BESIDE, at=0.0, delay_ms=1.0))
    shared.client.clear("all")
    shared.wait(lambda: any(not event.active and event.link == BESIDE for event in shared.told))
    shared.told.clear()


@pytest.fixture
def own() -> Iterator[Proxied]:
    """Return links that a test may harm."""
    with proxied("knee_left") as links:
        yield links


def inject(rig: Proxied, **what: float | bool | str) -> None:
    rig.client.begin(Inject(link="joints->planner", at=0.0, **what))  # type: ignore[arg-type]


def numbers(rows: Heard) -> list[int]:
    return [number for number, _ in rows]


def descriptors(rig: Proxied) -> int:
    return len(list(Path(f"/proc/{rig.proxy.pid}/fd").iterdir()))


def test_unimpaired_nothing_is_lost_and_with_a_delay_it_comes_so_much_later(rig: Proxied) -> None:
    near = list(rig.send_to_the_last(200))
    assert len(near) == 200
    inject(rig, delay_ms=25.0)
    far = rig.send_to_the_last(200)
    assert len(far) == 200
    assert numbers(far) == sorted(numbers(far))
    assert min(delay for _, delay in far) >= 25.0
    added = statistics.median(d for _, d in far) - statistics.median(d for _, d in near)
    assert 20.0 < added < 35.0


def test_the_requested_fraction_is_lost_and_reported(rig: Proxied) -> None:
    """Those that are sent at once travel as one: counted is what travels."""
    inject(rig, loss=0.3)
    rig.send(500)
    rig.client.clear("all")
    ended = rig.ended()
    counted = ended.lost + ended.passed
    assert 100 < counted <= 500
    assert abs(ended.lost / counted - 0.3) < 4.5 * math.sqrt(0.3 * 0.7 / counted)
    heard = rig.heard[rig.first]
    rig.wait(lambda: len(heard) >= ended.passed)
    assert len(heard) <= 500 - ended.lost
    assert len(rig.send_to_the_last(100)) == 100


def test_a_duplicate_is_received_once_and_an_overtaken_message_not_at_all(rig: Proxied) -> None:
    """Zenoh's own sequence numbers: doubles and what is overtaken are dropped."""
    inject(rig, duplicate=0.5)
    heard = rig.send_to_the_last(200)
    assert numbers(heard) == list(range(rig.sent - 199, rig.sent + 1))
    rig.client.clear("all")
    inject(rig, delay_ms=20.0, jitter_ms=20.0)
    jumbled = numbers(rig.send_to_the_last(400))
    assert jumbled == sorted(set(jumbled)), "never an older one after a newer"
    assert 40 < len(jumbled) < 400
    rig.client.clear("all")
    assert len(rig.send_to_the_last(100)) == 100


def test_a_stream_keeps_the_order_and_loses_nothing(rig: Proxied) -> None:
    inject(rig, delay_ms=20.0, jitter_ms=20.0, ordered=True)
    rows = rig.send_to_the_last(300)
    assert numbers(rows) == list(range(rig.sent - 299, rig.sent + 1))


@pytest.mark.parametrize("ordered", [False, True], ids=["datagrams", "stream"])
def test_a_partition_is_total_and_once_it_is_over_the_link_is_whole_again(
    ordered: bool, rig: Proxied
) -> None:
    """Longer than the lease: Zenoh gives the link up and dials again through the proxy.

    What a partition held on a stream that is given up counts as lost.
    """
    inject(rig, partition=True, ordered=ordered)
    assert rig.send(500) == []
    rig.client.clear("all")
    ended = rig.ended()
    assert ended.passed == 0
    assert ended.lost > 50
    rig.wait(rig.linked)
    assert len(rig.send_to_the_last(100)) == 100


def test_a_partition_may_last_though_all_dial_again_and_again(own: Proxied) -> None:
    """Both ways, with few descriptors, for many dials: it neither ends early nor kills."""
    full = descriptors(own) + SPARE
    resource.prlimit(own.proxy.pid, resource.RLIMIT_NOFILE, (full, full))
    begun = time.monotonic()
    own.client.begin(Inject(link="all", at=0.0, duration=12.0, partition=True))
    most = 0
    while time.monotonic() < begun + 10.0:
        arrived = list(own.send(100))
        assert not arrived or time.monotonic() > begun + 12.0
        most = max(most, descriptors(own))
    assert most < full, "none was turned away for want of one"
    assert own.proxy.poll() is None
    own.wait(own.linked)
    assert time.monotonic() > begun + 12.0
    assert len(own.send_to_the_last(100)) == 100


def test_an_injector_that_is_killed_and_started_again_links_anew_and_does_nothing(
    own: Proxied,
) -> None:
    inject(own, loss=1.0)
    own.kill()
    assert own.send(20) == []
    own.start()
    own.wait(own.linked)
    assert own.client.list() == ()
    assert len(own.send_to_the_last(100)) == 100


def test_an_impairment_that_lasts_is_reported_with_its_counts_when_the_injector_stops(
    own: Proxied,
) -> None:
    inject(own, loss=0.5)
    own.send(100)
    own.stop()
    ended = own.ended()
    assert ended.passed > 0
    assert ended.lost > 0


def test_an_action_is_published_on_the_bus_and_shown_by_the_verb(
    rig: Proxied, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--run-dir", str(rig.run_dir)]
    assert cli.main(["inject", "--link", "joints->planner", "--loss", "0.5", *words]) == 0
    rig.send(100)
    assert cli.main(["inject", "--list", *words]) == 0
    assert "loss=50%" in capsys.readouterr().out
    assert cli.main(["inject", "--clear", *words]) == 0
    assert "nothing is done" in capsys.readouterr().out
    rig.wait(lambda: len(rig.told) == 12)
    assert [event.active for event in rig.told] == [True] * 6 + [False] * 6
