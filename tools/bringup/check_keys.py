"""Checks of who may link to the bus, and of this host's keys."""

from __future__ import annotations

from typing import Final

from shared.bus.credentials import keys_folder
from shared.config.robot_config import RobotConfig
from shared.exceptions import XrlError
from tools.bringup.rows import Finding, ok, warning, wrong
from tools.keys.inspection import KeyRow, inspect_keys

SUBJECT: Final = "bus"


def security_rows(robot: RobotConfig) -> list[Finding]:
    """Check `bus.security`, and under `mtls` each certificate that this host holds."""
    mode = robot.bus.security.mode
    if mode == "open":
        fix = 'mode = "mtls", or "local" for one host (docs/security.md)'
        why = "anyone who reaches a port commands the robot"
        return [warning(SUBJECT, "security", mode, "mtls or local", fix, why)]
    if mode == "local":
        return [ok(SUBJECT, "security", mode, "who may link: this user alone")]
    try:
        rows = inspect_keys(keys_folder(robot), robot)
    except XrlError as error:
        return [wrong(SUBJECT, "keys", str(error), "this host's own", "`xrl keys pack`")]
    return [_row(row) for row in rows]


def _row(row: KeyRow) -> Finding:
    what, wanted = f"key of {row.name}", "valid"
    if row.wrong:
        return wrong(SUBJECT, what, row.wrong, wanted, "`xrl keys check`", "no link")
    if row.warning:
        why = "then no new link: those that stand stay"
        return warning(SUBJECT, what, row.warning, wanted, "`xrl keys renew`", why)
    return ok(SUBJECT, what, f"from {row.begins} until {row.expires}", wanted)
