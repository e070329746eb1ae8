"""`xrl drive can`: bring the CAN buses up, listen to them."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Mapping
from typing import Annotated, Final

from rich import box
from rich.table import Table
from rich.text import Text

from shared.can.cansimple import AxisState
from shared.config.files import load
from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from shared.exceptions import FAULT_EXIT_CODE, FleetError
from shared.places import FILES
from tools.bringup.can_monitor import (
    BusTraffic,
    bus_config,
    bus_nodes,
    listen_to,
    mean_ms,
)
from tools.bringup.check_host import interfaces_of, setup_commands
from tools.bringup.drive_access import drives_within_reach
from tools.flags import Arg, ConfigFlags, Duration, RunDirFlags, option
from tools.terminal import Console, marked

COMMAND_S: Final = 10.0
SILENT: Final = Text("silent", "red")


EXAMPLES: Final = """
xrl drive can setup --config lab.toml             # prints the commands
sudo xrl drive can setup --config lab.toml --apply
xrl drive can test --config lab.toml --for 5      # listens, sends nothing
"""


class CanFlags(ConfigFlags, RunDirFlags):
    """Which buses."""

    bus: Annotated[str | None, Arg(metavar="NAME")] = None
    """only this bus of the robot file"""


class SetUpFlags(ConfigFlags):
    """Whether it is done."""

    apply: bool = False
    """run the commands, as root; without it they are only printed"""


class TestFlags(CanFlags):
    """How long."""

    for_s: Annotated[Duration | None, option("--for")] = None
    """how long to listen"""


def set_up(flags: SetUpFlags) -> int:
    """Print the commands, or run them; a fault if one failed."""
    names = interfaces_of(load(flags.config))
    if not names:
        print("nothing to bring up: no bus of this robot file is a socketcan interface")
        return 0
    for name in names:
        for words in setup_commands(name):
            print(shlex.join(words))
            if flags.apply and not _ran(words):
                return FAULT_EXIT_CODE
    if not flags.apply:
        print(
            f"# printed only; --apply runs them, as root. {FILES}/udev/92-can.rules does it at boot"
        )
    return 0


def test(flags: TestFlags) -> int:
    """Listen; a drive or sensor that is missing is a fault."""
    robot = load(flags.config)
    buses = _buses(robot, flags.bus)
    with drives_within_reach(robot, flags.config, flags.run_dir):
        return _listen(robot, flags, buses)


def _buses(robot: RobotConfig, only: str | None) -> Mapping[str, tuple[int, ...]]:
    """Return the nodes of each bus that is asked for."""
    known = bus_nodes(robot)
    if only is None:
        return known
    if only not in known:
        raise FleetError(f"--bus {only}: the robot has {', '.join(known)}")
    return {only: known[only]}


def _ran(words: list[str]) -> bool:
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=COMMAND_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise FleetError(f"{shlex.join(words)}: {error}; package iproute2 has `ip`") from None
    if done.returncode != 0:
        Console(stderr=True).print(
            marked("[red]{}[/]; run as root, and check that it is plugged in", done.stderr.strip())
        )
    return done.returncode == 0


def _listen(robot: RobotConfig, flags: TestFlags, buses: Mapping[str, tuple[int, ...]]) -> int:
    console, complete = Console(), True
    for name, nodes in buses.items():
        bus = bus_config(robot, name, flags.run_dir)
        traffic = listen_to(robot, name, flags.run_dir, poll_nodes=False, seconds=flags.for_s)
        console.print(_heading(name, bus, traffic), highlight=False, soft_wrap=True)
        if traffic.trouble:
            complete = False
            continue
        if nodes:
            console.print(_node_table(robot, traffic))
        complete &= all(traffic.nodes[node].heartbeats_s for node in nodes)
        if name == robot.harness.bus:
            console.print("  load cells:", _rate(traffic.cells.times_s, traffic.seconds))
            complete &= bool(traffic.cells.times_s)
        if robot.imu.fitted and name == robot.imu.bus:
            console.print("  IMU:", _rate(traffic.imu.times_s, traffic.seconds))
            complete &= bool(traffic.imu.times_s)
    return 0 if complete else FAULT_EXIT_CODE


def _heading(name: str, bus: CanConfig, traffic: BusTraffic) -> Text:
    which = marked("[bold]{}[/] ({} {})", name, bus.interface, bus.channel)
    if traffic.trouble:
        return marked("{}: [red]{}[/]", which, traffic.trouble)
    rate = marked("{}: {:.0f} frames/s", which, traffic.frames / traffic.seconds)
    errors = traffic.error_frames
    return marked("{}, [red]{} error frames[/]", rate, errors) if errors else rate


def _node_table(robot: RobotConfig, traffic: BusTraffic) -> Table:
    owners = {
        node: f"{module.name}.axis{axis}"
        for module in robot.module
        for axis, node in enumerate(module.node_ids)
    }
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("node", "axis", "state", "heartbeat ms", "estimates ms", "turns"):
        table.add_column(heading, no_wrap=True)
    for node, axis in sorted(traffic.nodes.items()):
        state = SILENT
        if axis.heartbeat is not None:
            known = axis.heartbeat.axis_state in set(AxisState)
            state = Text(AxisState(axis.heartbeat.axis_state).name if known else "?")
        turns = "-" if axis.pos_turns is None else f"{axis.pos_turns:.3f}"
        owner = owners.get(node, Text("nobody's", "red"))
        periods = (
            f"{mean_ms(times):.1f}" if len(times) > 1 else "-"
            for times in (axis.heartbeats_s, axis.estimates_s)
        )
        table.add_row(str(node), owner, state, *periods, turns)
    return table


def _rate(times_s: list[float], seconds: float) -> Text:
    return Text(f"{len(times_s) / seconds:.0f} Hz") if times_s else SILENT
