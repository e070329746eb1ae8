"""Why a link over TLS does not come is told, by the peer and the reason."""

from __future__ import annotations

import datetime as dt
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from shared.bus.credentials import Credentials, read_credentials
from shared.bus.session import open_session
from shared.bus.tls_probe import LinkWatch, own_fault, refusal
from shared.config.robot_config import RobotConfig
from tests.certified import certified, give, install_all, signer_of, with_keys
from tests.waiting import comes_true
from tools.keys import certificates
from tools.keys.authority import Authority


class Pair(NamedTuple):
    """The keys of two hosts: one has the planner, the other the left knee."""

    robot: RobotConfig
    authority: Authority
    folder: Path

    @property
    def knee(self) -> str:
        return self.robot.bus.endpoints["knee_left"]

    def host(self, name: str) -> RobotConfig:
        return with_keys(self.robot, self.folder / name)

    def own(self, name: str) -> Credentials:
        return read_credentials(self.host(name), name)

    def replace(self, name: str, *, foreign: bool = False, **when: int | str) -> None:
        """Give a host another certificate."""
        stranger = certificates.make_authority("xrl", dt.datetime.now(dt.UTC))
        signer = stranger if foreign else signer_of(self.authority)
        give(signer, self.folder / name, name, **when)  # type: ignore[arg-type]


@pytest.fixture
def pair(robot: RobotConfig, short_dir: Path) -> Pair:
    own, authority = certified(robot, short_dir)
    for name in ("planner", "knee_left"):
        install_all(authority, short_dir / name, name)
    return Pair(own, authority, short_dir)


OUR_TIME = "by its clock our certificate has expired, or is not valid yet"
FAULTS: dict[str, tuple[Callable[[Pair], None], str]] = {
    "none": (lambda _: None, ""),
    "its clock, or ours": (
        lambda p: p.replace("knee_left", from_day=10),
        "its certificate is not valid yet, by this host's clock (20",
    ),
    "its certificate is old": (
        lambda p: p.replace("knee_left", from_day=-40, days=20),
        "its certificate has expired, by this host's clock",
    ),
    "its authority": (
        lambda p: p.replace("knee_left", foreign=True), "its certificate is of another authority",
    ),
    "its host": (lambda p: p.replace("knee_left", host="10.1.1.1"), "is another host's"),
    "our certificate is old": (lambda p: p.replace("planner", from_day=-40, days=20), OUR_TIME),
    "our clock, or its": (lambda p: p.replace("planner", from_day=10), OUR_TIME),
    "our authority": (lambda p: p.replace("planner", foreign=True), "our certificate"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_why_a_link_does_not_come_is_told_truly(pair: Pair, fault: str) -> None:
    spoil, words = FAULTS[fault]
    spoil(pair)
    with open_session(pair.host("knee_left"), "knee_left", pair.folder):
        why = refusal(pair.own("planner"), pair.knee)
    assert words in why
    assert bool(words) is bool(why)
    assert refusal(pair.own("planner"), pair.knee) == "Connection refused"


@pytest.mark.parametrize(
    ("when", "words"),
    [
        ({}, ""),
        ({"from_day": 10}, "is not valid yet, by this host's clock"),
        ({"from_day": -40, "days": 20}, "has expired"),
        ({"foreign": True}, "is of another authority"),
    ],
)
def test_a_certificate_that_this_host_does_not_believe_is_told(
    pair: Pair, when: dict[str, int], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    pair.replace("planner", **when)  # type: ignore[arg-type]
    found = own_fault(pair.own("planner"))
    assert found.startswith(words)
    assert bool(words) is bool(found)
    with open_session(pair.host("planner"), "planner", pair.folder):
        assert ("no link over TLS" in caplog.text) is bool(words)


def test_a_service_logs_a_refused_link_once_and_a_session_knows_its_links(
    pair: Pair, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    linked: set[str] = set()
    watch = LinkWatch(pair.own("planner"), {"knee_left": pair.knee}, linked.__contains__, 0.02)
    refused = f"no link with knee_left at {pair.knee}: Connection refused"
    assert comes_true(lambda: refused in caplog.text)
    time.sleep(0.2)
    assert caplog.text.count("Connection refused") == 1
    linked.add(pair.knee)
    assert comes_true(lambda: "link with knee_left is there" in caplog.text)
    watch.end()
    with open_session(pair.host("planner"), "planner", pair.folder) as planner:
        with open_session(pair.host("knee_left"), "knee_left", pair.folder):
            assert comes_true(lambda: planner.is_linked(pair.knee))
            assert not planner.is_linked(pair.robot.bus.endpoints["hip_left"])
        assert comes_true(lambda: not planner.is_linked(pair.knee))
