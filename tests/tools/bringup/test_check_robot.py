"""The doctor's rows on who may link to the bus."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from tests.certified import certified, opened
from tools.bringup.check_host import security_rows
from tools.bringup.findings import FindingKind
from tools.keys import authority as authority_module


def verdicts(robot: RobotConfig) -> set[FindingKind]:
    return {row.verdict for row in security_rows(robot)}


def test_sockets_of_one_host_are_ok_and_an_open_port_is_told(robot: RobotConfig) -> None:
    assert verdicts(robot) == {FindingKind.OK}
    (row,) = security_rows(opened(robot, robot.bus.endpoints))
    assert row.verdict is FindingKind.WARNING
    assert "anyone" in row.why


def test_each_key_of_a_certified_host_has_its_row(robot: RobotConfig, tmp_path: Path) -> None:
    own, authority = certified(robot, tmp_path)
    assert verdicts(own) == {FindingKind.OK}
    assert len(security_rows(own)) == 1 + len(authority.names.generations), "and the authority's"
    authority.renew(own, ["planner"], days=20)
    (tmp_path / "keys" / "planner.pem").write_bytes(
        (tmp_path / "authority" / "planner.pem").read_bytes()
    )
    wrong = [row for row in security_rows(own) if row.verdict is FindingKind.WRONG]
    assert [row.what for row in wrong] == ["key of planner.1"], "a certificate without its key"
    (tmp_path / "keys" / "planner.key").write_bytes(
        (tmp_path / "authority" / "planner.key").read_bytes()
    )
    assert verdicts(own) == {FindingKind.OK, FindingKind.WARNING}


def test_a_host_without_keys_is_wrong(robot: RobotConfig, tmp_path: Path) -> None:
    own, _ = certified(robot, tmp_path)
    security = msgspec.structs.replace(own.bus.security, keys=str(tmp_path / "nowhere"))
    bus = msgspec.structs.replace(own.bus, security=security)
    assert verdicts(msgspec.structs.replace(own, bus=bus)) == {FindingKind.WRONG}


@pytest.mark.parametrize(("days", "told"), [(30, "not valid before"), (-4000, "expired at")])
def test_a_clock_outside_the_time_of_the_authority_and_its_certificates_is_told(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int, told: str
) -> None:
    """As on a board whose clock has lost its battery: it is before, or long after, their time."""
    made = dt.datetime.now(dt.UTC) + dt.timedelta(days=days)
    clock = SimpleNamespace(UTC=dt.UTC, datetime=SimpleNamespace(now=lambda _zone: made))
    monkeypatch.setattr(authority_module, "dt", clock)
    own, authority = certified(robot, tmp_path)
    rows = security_rows(own)
    assert len(rows) == 1 + len(authority.names.generations)
    assert all(row.verdict is FindingKind.WRONG and told in row.found for row in rows)
