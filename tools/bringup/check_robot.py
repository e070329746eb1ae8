"""Checks of the robot file and of where the services will meet: schedule, endpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from shared.bus import security
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import FleetError
from shared.joints import MODULES
from tools.bringup.rows import Finding, judged, ok, warning, wrong
from tools.fleet import process_table
from tools.fleet.process_table import ListenPoint

SUBJECT: Final = "robot file"


def robot_rows(robot: RobotConfig, path: Path) -> list[Finding]:
    """Check the robot file; that it can be read at all is known by now."""
    count = len(robot.assumed)
    found = f"{count} values assumed" if count else "all values measured"
    if count and process_table.is_simulated(robot):
        assumed = ok(SUBJECT, "assumed", f"{found}; the drives are emulated by them")
    elif count:
        fix = f"measure {', '.join(robot.assumed)}; then take them off `assumed`"
        assumed = warning(SUBJECT, "assumed", found, "none", fix)
    else:
        assumed = ok(SUBJECT, "assumed", found, "none")
    rows = [ok(SUBJECT, "read", str(path)), assumed]
    if robot.law.split == "certified":
        stale = gain_schedule.why_stale(robot)
        fix = f"`xrl gains --config {path}`"
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


def joint_services(services: tuple[str, ...]) -> tuple[str, ...]:
    """Return which of these services have drives."""
    return tuple(service for service in services if service in MODULES)


def endpoint_rows(robot: RobotConfig, run_dir: Path, *, fleet_is_up: bool) -> list[Finding]:
    """Check that the endpoints of the bus are free, or the fleet's."""
    up = services_up(robot, run_dir)
    if fleet_is_up:
        found = f"{len(up)} of {len(robot.services)} listen"
        if len(joint_services(up)) in (0, len(MODULES)):
            return [ok("bus", "endpoints", found, "the fleet's")]
        silent = [module for module in MODULES if module not in up]
        return [
            wrong(
                "bus", "endpoints", found, "all six modules",
                f"`xrl status` says why {', '.join(silent)} is not there",
            )
        ]  # fmt: skip
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
        fix = "`xrl down`, or another --run-dir"
        return [wrong("bus", "endpoints", str(error), "free", fix)]
    return [ok("bus", "endpoints", f"{len(listeners)} free", "free")]
