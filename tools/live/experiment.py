"""Scenario and robot file of an experiment, with the flags applied to them.

The verbs that run scenarios share this code, so the flags mean the same everywhere.
"""

from __future__ import annotations

import argparse
import contextlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_type_hints

import msgspec

from services.simulator.physics import plant
from services.simulator.physics.plant import NAMED, PlantConfig
from shared.atomic_file import replace_file
from shared.config import checks as config_check
from shared.config import files as config_file
from shared.config import gain_schedule, scenarios
from shared.config.robot_config import SERVICES, RobotConfig
from shared.config.scenarios import (
    FAULT_KINDS,
    SIGNALS,
    Fault,
    Inject,
    Kill,
    Push,
    Restart,
    Scenario,
)
from shared.config.sections import LawConfig
from shared.exceptions import FleetError, RunError
from shared.joints import MODULES
from shared.mcap_log.files import FIRST
from shared.places import DEFAULT_CONFIG, SCENARIOS
from tools.flags import Arg, ConfigFlags, Duration, Flags, Natural, parsed
from tools.guarded_streams import printable
from tools.live.describe_inject import in_words_of, parse_inject
from tools.output import make_folder
from tools.terminal import Console, marked

PLANT_FILE = "plant.toml"
"""Name of the plant's file among a run's results and in its log."""

FAILED_START: Final = "failed-start.mcap"
"""Name of the record of the newest start that failed."""

UNJUDGED = ("simulator", "recorder")
"""Services without which a run cannot be judged."""

_NUMBER = r"\d+(?:\.\d*)?"


def choices(field: str) -> tuple[str, ...]:
    """Return the values of a `[law]` key, for the flag with the same name."""
    return get_args(get_type_hints(LawConfig)[field])


class PlantFlags(Flags):
    """Differences of the simulated robot from its robot file."""

    plant: Annotated[
        tuple[str, ...],
        Arg(
            metavar="NAME|FILE|KEY=VALUE",
            help="how the simulated robot differs from its robot file: "
            f"{', '.join(NAMED)} (default: realistic), a TOML file, or one value, such as "
            "floor.slope=[0.03,0.0]; repeatable: a name or file replaces earlier words "
            "(deploy/plants/README.md)",
        ),
    ] = ()


class ControllerFlags(Flags):
    """A controller that replaces the law."""

    controller: Annotated[str | None, Arg(metavar="FILE.py[:NAME]")] = None
    """your own controller in place of the law; certificate, age rule and limits stay
    (docs/own-controller.md)"""


class ImuFlags(Flags):
    """An IMU, regardless of the robot file."""

    imu: bool = False
    """add an IMU and its service, so that the robot stands on slopes (sets imu.fitted)"""


def _refused(text: str, form: str, **known: Iterable[str]) -> argparse.ArgumentTypeError:
    names = "".join(f"; {what}: {', '.join(names)}" for what, names in known.items())
    return argparse.ArgumentTypeError(f"{text!r}; write {form}{names}")


def _parse_kill(text: str) -> Kill:
    """Parse SERVICE@T[:SIGNAL]."""
    match = re.fullmatch(rf"(\w+)@({_NUMBER})(?::(?:SIG)?(\w+))?", text)
    if match is None or match[1] not in SERVICES or (match[3] or "KILL") not in SIGNALS:
        form = "SERVICE@SECONDS or SERVICE@SECONDS:SIGNAL, for example planner@10:STOP"
        raise _refused(text, form, services=SERVICES, signals=SIGNALS)
    if match[1] in UNJUDGED:
        raise argparse.ArgumentTypeError(
            f"{text!r}: without the {match[1]} the run cannot be judged; to see what the fleet "
            "does without it, use `xrl up` and `xrl kill`"
        )
    row = {"service": match[1], "at": float(match[2]), "signal": match[3] or "KILL"}
    return msgspec.convert(row, Kill)


def _parse_restart(text: str) -> Restart:
    """Parse SERVICE@T."""
    match = re.fullmatch(rf"(\w+)@({_NUMBER})", text)
    if match is None or match[1] not in SERVICES:
        raise _refused(text, "SERVICE@SECONDS, for example planner@9", services=SERVICES)
    return Restart(service=match[1], at=float(match[2]))


def _parse_push(text: str) -> Push:
    """Parse T:DUR:FX,FY,FZ."""
    signed = rf"(-?{_NUMBER})"
    match = re.fullmatch(rf"({_NUMBER}):({_NUMBER}):{signed},{signed},{signed}", text)
    if match is None:
        raise _refused(text, "START:DURATION:FX,FY,FZ in s and N, for example 12:0.3:40,0,0")
    t, duration, x, y, z = map(float, match.groups())
    return Push(at=t, duration=duration, force=(x, y, z))


def parse_fault(text: str) -> Fault:
    """Parse MODULE[.AXIS]:KIND@T[:DUR]."""
    match = re.fullmatch(rf"(\w+)(?:\.([01]))?:(\w+)@({_NUMBER})(?::({_NUMBER}))?", text)
    if match is None or match[1] not in MODULES or match[3] not in FAULT_KINDS:
        form = "MODULE:KIND@SECONDS, for example knee_left:encoder@8, or knee_left.1:encoder@8:0.5"
        raise _refused(text, form, modules=MODULES, kinds=FAULT_KINDS)
    axis = int(match[2]) if match[2] else None
    duration = float(match[5]) if match[5] else None
    row = {"module": match[1], "kind": match[3], "at": float(match[4])}
    return msgspec.convert({**row, "axis": axis, "duration": duration}, Fault)


class LawFlags(ConfigFlags, ImuFlags):
    """Changes to the robot's law for one run."""

    split: Annotated[str | None, Arg(choices=choices("split"))] = None
    """local gains: the certified schedule, or the paper's diag(K_q) (default: law.split)"""
    jacobian: Annotated[str | None, Arg(choices=choices("jacobian"))] = None
    """load sharing between the legs (default: law.jacobian); average has no certified gains, so it
    implies --split diagonal"""


class ExperimentFlags(LawFlags, PlantFlags, ControllerFlags):
    """The flags of an experiment."""

    scenario: Annotated[str, Arg(metavar="NAME|FILE")] = "squat"
    """file, or name of a scenario, shipped or in scenarios/ beside the robot file (default: squat,
    the paper's Fig. 7)"""
    duration: Duration | None = None
    """scenario time to run, s"""
    kill: Annotated[
        tuple[Kill, ...] | None,
        parsed(
            _parse_kill,
            "SERVICE@T[:SIGNAL]",
            help=f"send a signal ({', '.join(SIGNALS)}; default KILL) at scenario time T; "
            "replaces the scenario's kills and restarts; repeatable",
        ),
    ] = None
    restart: Annotated[tuple[Restart, ...] | None, parsed(_parse_restart, "SERVICE@T")] = None
    """restart a killed service, or continue a stopped one, at scenario time T; replaces the
    scenario's restarts; repeatable"""
    push: Annotated[tuple[Push, ...] | None, parsed(_parse_push, "T:DUR:FX,FY,FZ")] = None
    """push the torso with a force, N, from T for DUR s; replaces the scenario's pushes;
    repeatable"""
    fault: Annotated[
        tuple[Fault, ...] | None,
        parsed(
            parse_fault,
            "MODULE:KIND@T",
            help="fail a module's drive at scenario time T, with a KIND from `xrl faults`; "
            "MODULE.1 selects the second axis, @T:DUR a duration, s; replaces the scenario's "
            "faults; repeatable",
        ),
    ] = None
    inject: Annotated[tuple[Inject, ...] | None, parsed(parse_inject, "'LINK KEY=VALUE ...'")] = (
        None
    )
    """impair a link as `xrl inject` does, but with at in scenario time, such as 'planner->joints
    delay=30 jitter=10 at=3 for=4'; replaces the scenario's impairments; repeatable"""
    seed: Natural = 0
    """seed of sensor noise, network losses and delays"""


ROW_FIELDS: Final = ("kill", "restart", "push", "fault", "inject")
"""Rows of a scenario that the flags of the same names replace."""
SHOWN: Final = 12
"""Maximum number of actions in the first line of a run."""


def scenario_file(name: str, config: Path = DEFAULT_CONFIG) -> Path:
    """Return the absolute path of a scenario's file; `name` is a path to a .toml file, or a name.

    A name stands for a file in `scenarios` beside the robot file, or else for a shipped one.
    """
    folders = (config.parent / SCENARIOS.name, SCENARIOS)
    paths = [Path(name)] if name.endswith(".toml") else [at / f"{name}.toml" for at in folders]
    for path in paths:
        if path.is_file():
            return path.absolute()
    known = ", ".join(sorted({file.stem for at in folders for file in at.glob("*.toml")}))
    raise FleetError(f"no scenario {name!r}; must be one of {known}, or a path to a .toml file")


def make_scenario(flags: ExperimentFlags) -> Scenario:
    """Return the scenario with the flags applied.

    A shorter duration drops the file's later rows. A flag with a time after the end is
    refused.
    """
    path = scenario_file(flags.scenario, flags.config)
    scenario = scenarios.load(path)
    duration = flags.duration if flags.duration is not None else scenario.duration
    rows: dict[str, tuple[Any, ...]] = {}
    for field in ROW_FIELDS:
        given = getattr(flags, field)
        own = () if field == "restart" and flags.kill else getattr(scenario, field)
        rows[field] = tuple(given or (row for row in own if row.at < duration))
    scenario = msgspec.structs.replace(scenario, duration=duration, **rows)
    given_flags = (flags.duration, *(getattr(flags, field) for field in ROW_FIELDS))
    has_flags = any(flag is not None for flag in given_flags)
    by_flags = " with the flags of this command" if has_flags else ""
    scenarios.check(f"{path}{by_flags}", scenario)
    return scenario


def describe(scenario: Scenario) -> str:
    """Return the scenario's actions as a clause for the first line of a run."""
    done = [f"{row.service} {row.signal} at {row.at:g} s" for row in scenario.kill]
    done += [f"{row.service} restarted at {row.at:g} s" for row in scenario.restart]
    done += [f"{row.module} {row.kind} at {row.at:g} s" for row in scenario.fault]
    done += [in_words_of(row) for row in scenario.inject]
    done += ["push {:g},{:g},{:g} N at {:g} s".format(*row.force, row.at) for row in scenario.push]
    if len(done) > SHOWN:
        done[SHOWN:] = [f"and {len(done) - SHOWN} more"]
    return f"; {', '.join(done)}" if done else ""


def introduce(scenario: Scenario, console: Console) -> None:
    """Print the name of the scenario and its actions."""
    about = printable(f"{scenario.about}{describe(scenario)}")
    console.print(marked("[bold]{}[/]: {}", scenario.name, about))


def make_robot(flags: LawFlags) -> RobotConfig:
    """Return the robot with the flags applied."""
    law = (("split", flags.split), ("jacobian", flags.jacobian))
    changes = {key: value for key, value in law if value is not None}
    if changes.get("jacobian") == "average" and "split" not in changes:
        changes["split"] = "diagonal"  # no local gains certify it, so it has no schedule
    return load_robot(flags.config, imu=flags.imu, **changes)


def load_robot(path: Path, *, imu: bool = False, **law: str) -> RobotConfig:
    """Return the robot of a file, ready to run."""
    robot = config_file.load(path)
    robot = msgspec.structs.replace(robot, law=msgspec.structs.replace(robot.law, **law))
    if imu:
        robot = msgspec.structs.replace(robot, imu=msgspec.structs.replace(robot.imu, fitted=True))
        config_check.check(str(path), robot)
    gain_schedule.require(robot, path)
    return robot


def make_out(out: Path | None, verb: str) -> Path:
    """Make the directory of a run's results; the default name has the verb and the time."""
    out = make_folder(out, verb)
    if (out / FIRST).exists():
        raise RunError(f"{out}: already contains a run; choose another --out, or remove the run")
    return out


@contextlib.contextmanager
def record_of_start(out: Path) -> Iterator[None]:
    """Rename the record of a failed start, so that it does not block this folder."""
    record = out / FIRST
    is_new = not record.exists()
    try:
        yield
    except BaseException:
        if is_new:
            with contextlib.suppress(OSError):
                record.replace(out / FAILED_START)
        raise


def write_inputs(
    out: Path, robot: RobotConfig, scenario: Scenario, true_plant: PlantConfig
) -> tuple[Path, ...]:
    """Write robot, scenario, plant and any gain schedule beside the results; return the paths."""
    robot_path, scenario_path, plant_path = (
        out / name for name in ("robot.toml", "scenario.toml", PLANT_FILE)
    )
    replace_file(plant_path, plant.to_toml(true_plant).encode())
    replace_file(robot_path, config_file.to_toml(robot).encode())
    replace_file(scenario_path, scenarios.to_toml(scenario).encode())
    if robot.gain_schedule is None:
        return robot_path, scenario_path, plant_path
    schedule_path = gain_schedule.path_beside(robot_path)
    gain_schedule.write(schedule_path, robot.gain_schedule)
    return robot_path, scenario_path, plant_path, schedule_path
