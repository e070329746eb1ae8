"""Why a link over TLS does not come is told, by the peer and the reason."""

from __future__ import annotations

import datetime as dt
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from shared.bus.credentials import Credentials, read_credentials
from shared.bus.session import open_session
from shared.bus.tls_probe import LinkWatch, own_fault, refusal
from shared.config.robot_config import RobotConfig
from tests.certified import certified, install_all
from tools.keys import certificates
from tools.keys.authority import Authority
from tools.keys.certificates import Issued


class Pair(NamedTuple):
    """The keys of two hosts: one has the planner, the other the left knee."""

    robot: RobotConfig
    authority: Authority
    folder: Path

    def host(self, name: str) -> RobotConfig:
        security = msgspec.structs.replace(self.robot.bus.security, keys=str(self.folder / name))
        bus = msgspec.structs.replace(self.robot.bus, security=security)
        return msgspec.structs.replace(self.robot, bus=bus)

    def own(self, name: str) -> Credentials:
        return read_credentials(self.host(name), name)

    def replace(self, name: str, *, from_day: int = 0, days: int = 90, host: str = "") -> None:
        """Give a host a certificate whose time begins a day before `from_day` from today."""
        key = (self.authority.folder / "authority.key").read_bytes()
        signer = Issued(self.authority.certificate, key)
        self.write(name, signer, from_day, days, host or "127.0.0.1")

    def write(self, name: str, signer: Issued, from_day: int, days: int, host: str) -> None:
        now = dt.datetime.now(dt.UTC) + dt.timedelta(days=from_day)
        made = certificates.issue(signer, f"{name}.1", (host,), now, days)
        (self.folder / name / f"{name}.pem").write_bytes(made.certificate)
        (self.folder / name / f"{name}.key").write_bytes(made.key)


@pytest.fixture
def pair(robot: RobotConfig) -> Iterator[Pair]:
    with tempfile.TemporaryDirectory(prefix="xrl-t-", dir="/tmp") as text:
        own, authority = certified(robot, Path(text))
        for name in ("planner", "knee_left"):
            install_all(authority, Path(text) / name, name)
        yield Pair(own, authority, Path(text))


def _foreign(pair: Pair, name: str) -> None:
    signer = certificates.make_authority("xrl", dt.datetime.now(dt.UTC))
    pair.write(name, signer, 0, 90, "127.0.0.1")


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
        lambda p: _foreign(p, "knee_left"),
        "its certificate is of another authority",
    ),
    "its host": (lambda p: p.replace("knee_left", host="10.1.1.1"), "is another host's"),
    "our certificate is old": (
        lambda p: p.replace("planner", from_day=-40, days=20),
        "by its clock our certificate has expired, or is not valid yet",
    ),
    "our clock, or its": (
        lambda p: p.replace("planner", from_day=10),
        "by its clock our certificate has expired, or is not valid yet",
    ),
    "our authority": (lambda p: _foreign(p, "planner"), "our certificate"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_why_a_link_does_not_come_is_told_truly(pair: Pair, fault: str) -> None:
    spoil, words = FAULTS[fault]
    spoil(pair)
    endpoint = pair.robot.bus.endpoints["knee_left"]
    with open_session(pair.host("knee_left"), "knee_left", pair.folder):
        why = refusal(pair.own("planner"), endpoint)
    assert words in why
    assert bool(words) is bool(why)
    assert refusal(pair.own("planner"), endpoint) == "Connection refused"


@pytest.mark.parametrize(
    ("from_day", "days", "words"),
    [(0, 90, ""), (10, 90, "is not valid yet, by this host's clock"), (-40, 20, "has expired")],
)
def test_a_certificate_that_this_hosts_clock_does_not_believe_is_told(
    pair: Pair, from_day: int, days: int, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    pair.replace("planner", from_day=from_day, days=days)
    found = own_fault(pair.own("planner"))
    assert words in found
    assert bool(words) is bool(found)
    with open_session(pair.host("planner"), "planner", pair.folder):
        assert ("no link over TLS" in caplog.text) is bool(words)


def test_a_certificate_of_another_authority_is_told(pair: Pair) -> None:
    _foreign(pair, "planner")
    assert own_fault(pair.own("planner")).startswith("is of another authority")


def waits_for(condition: Callable[[], bool], limit_s: float = 8.0) -> bool:
    deadline = time.monotonic() + limit_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


def test_a_service_logs_a_refused_link_once_and_that_it_came(
    pair: Pair, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    linked: set[str] = set()
    endpoint = pair.robot.bus.endpoints["knee_left"]
    watch = LinkWatch(pair.own("planner"), {"knee_left": endpoint}, linked.__contains__, 0.02)
    refused = f"no link with knee_left at {endpoint}: Connection refused"
    assert waits_for(lambda: refused in caplog.text)
    time.sleep(0.2)
    assert caplog.text.count("Connection refused") == 1
    linked.add(endpoint)
    assert waits_for(lambda: "link with knee_left is there" in caplog.text)
    watch.end()


def test_a_session_knows_which_of_its_tls_links_are_there(pair: Pair) -> None:
    endpoints = pair.robot.bus.endpoints
    with open_session(pair.host("planner"), "planner", pair.folder) as planner:
        with open_session(pair.host("knee_left"), "knee_left", pair.folder):
            assert waits_for(lambda: planner.is_linked(endpoints["knee_left"]))
            assert not planner.is_linked(endpoints["hip_left"])
        assert waits_for(lambda: not planner.is_linked(endpoints["knee_left"]))
