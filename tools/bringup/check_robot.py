"""Checks of the robot file and of the bus: schedule, endpoints, who may link, this host's keys."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

from shared.bus import security
from shared.bus.credentials import keys_folder
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import FleetError, XrlError
from shared.joints import MODULES
from tools.bringup.findings import Finding, judged, ok, warning, wrong
from tools.fleet import process_table
from tools.fleet.process_table import ListenPoint
from tools.keys.inspection import KeyRow, inspect_keys

SUBJECT: Final = "robot file"


def robot_rows(robot: RobotConfig, path: Path) -> list[Finding]:
    """Check the robot file; that it can be read at all is known by now."""
    count = len(robot.assumed)
    found = f"{count} values assumed" if count else "all values measured"
    if count and process_table.is_simulated(robot):
        assumed = ok(SUBJECT, "assumed", f"{found}; the drives are emulated by them")
    elif count:
        fix = f"measure {', '.join(robot.assumed)}; then remove them from `assumed`"
        assumed = warning(SUBJECT, "assumed", found, "none", fix)
    else:
        assumed = ok(SUBJECT, "assumed", found, "none")
    rows = [ok(SUBJECT, "read", str(path)), assumed]
    if robot.law.split == "certified":
        stale = gain_schedule.why_stale(robot)
        fix = f"`xrl gains --config {shlex.quote(str(path))}`"
        rows.append(judged(not stale, SUBJECT, "gain schedule", stale or "fits", "fits", fix))
    return rows


def services_up(robot: RobotConfig, run_dir: Path) -> tuple[str, ...]:
    """Return the services that listen on their endpoints, whoever started them."""
    here = security.services_here(robot)
    return tuple(
        service
        for service in robot.services
        if process_table.is_listening(expand(security.endpoint_here(robot, service, here), run_dir))
    )


def joint_services_up(robot: RobotConfig, run_dir: Path) -> tuple[str, ...]:
    """Return which of these have drives."""
    return tuple(service for service in services_up(robot, run_dir) if service in MODULES)


def endpoint_rows(robot: RobotConfig, run_dir: Path, *, fleet_is_up: bool) -> list[Finding]:
    """Check that the endpoints of the bus are free, or the fleet's."""
    what = "endpoints"
    if fleet_is_up:
        up = services_up(robot, run_dir)
        found = f"{len(up)} of {len(robot.services)} listen"
        silent = [module for module in MODULES if module not in up]
        if len(silent) in (0, len(MODULES)):
            return [ok("bus", what, found, "the fleet's")]
        fix = f"`xrl status` says why {', '.join(silent)} is not there"
        return [wrong("bus", what, found, "all six modules", fix)]
    here = security.services_here(robot)
    listeners = [
        ListenPoint(service, f"bus.endpoints.{service}", expand(endpoint, run_dir))
        for service in robot.bus.endpoints
        for endpoint in security.listening(robot, service, here)
        if not process_table.is_elsewhere(expand(endpoint, run_dir))
    ]
    try:
        process_table.check_free(listeners)
    except FleetError as error:
        return [wrong("bus", what, str(error), "free", "`xrl down`, or another --run-dir")]
    return [ok("bus", what, f"{len(listeners)} free", "free")]


def security_rows(robot: RobotConfig) -> list[Finding]:
    """Check `bus.security`, and under `mtls` each certificate that this host holds."""
    mode = robot.bus.security.mode
    if mode == "open":
        fix = 'mode = "mtls", or "local" for one host (docs/security.md)'
        why = "anyone who reaches a port commands the robot"
        return [warning("bus", "security", mode, "mtls or local", fix, why)]
    if mode == "local":
        return [ok("bus", "security", mode, "only this user may link")]
    try:
        return [_key_row(row) for row in inspect_keys(keys_folder(robot), robot)]
    except XrlError as error:
        return [wrong("bus", "keys", str(error), "this host's own", "`xrl keys pack`")]


def _key_row(row: KeyRow) -> Finding:
    what, wanted = f"key of {row.name}", "valid"
    if row.wrong:
        return wrong("bus", what, row.wrong, wanted, "`xrl keys check`", "no link")
    if row.warning:
        why = "then no new links; existing links stay"
        return warning("bus", what, row.warning, wanted, "`xrl keys renew`", why)
    return ok("bus", what, f"from {row.begins} until {row.expires}", wanted)
