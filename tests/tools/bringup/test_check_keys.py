"""The doctor's rows on who may link to the bus."""

from __future__ import annotations

from pathlib import Path

import msgspec

from shared.config.robot_config import RobotConfig
from tests.certified import certified, opened
from tools.bringup.check_keys import security_rows
from tools.bringup.rows import FindingKind


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
    assert len(security_rows(own)) == len(authority.names.generations)
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
