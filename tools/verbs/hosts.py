"""`xrl hosts`: operates a robot whose services run on several hosts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from rich import box
from rich.table import Table
from rich.text import Text

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, FleetError, RunError
from tools.flags import ConfigFlags, Duration, Folder, option, positional
from tools.fleet.status_table import tables
from tools.hosts import hosts_file, layout, running
from tools.hosts.hosts_file import Hosts
from tools.hosts.layout import HostFile, HostRow
from tools.hosts.remote import Remote, on_all
from tools.keys import authority as authorities
from tools.keys.authority import Authority
from tools.output import write_atomically
from tools.terminal import Console, marked

DEFAULT_HOSTS: Final = Path("hosts.toml")
EXAMPLES: Final = """
xrl hosts files -o out/hosts               # to inspect them
xrl keys make --hosts hosts.toml           # once
xrl hosts update
xrl hosts check
xrl hosts up
xrl hosts status
xrl hosts estop
xrl hosts down                             # lower the robot, wait for the hoist
xrl hosts down --limp
"""


class HostsFlags(ConfigFlags):
    """Hosts to act on."""

    names: Annotated[tuple[str, ...], positional("HOST")] = ()
    """only these hosts (default: all)"""
    hosts: Path = DEFAULT_HOSTS
    """file that lists each host's services"""
    authority: Folder | None = None
    """folder of the certificate authority (default: ~/.config/xrl/ROBOT/authority)"""


class FilesFlags(HostsFlags):
    """Folder to write to."""

    out: Annotated[Path, option("-o", "--out", metavar="DIR")]
    """output folder"""


class UpdateFlags(HostsFlags):
    """Permission to update while services run."""

    while_up: bool = False
    """update even while services run; a service that crashes restarts with the new files"""


class HostsUpFlags(HostsFlags):
    """State in which the drives start."""

    disarmed: bool = False
    """arm no drive until a person requests it (`xrl kill MODULE`), but take over holding drives"""


class HostsDownFlags(HostsFlags):
    """Handling of a robot that stands on its legs."""

    limp: bool = False
    """idle the drives at once, under any load: a standing robot falls"""
    wait: Duration = 60.0
    """timeout for a hoist or stand to take the lowered robot's weight, s"""


class _Given(NamedTuple):
    """Inputs of every verb.

    Each verb reads only the files it needs: a stop must not fail because of the gain schedule.
    """

    flags: HostsFlags
    hosts: Hosts
    robot: RobotConfig
    remotes: list[Remote]

    def files(self) -> dict[str, list[HostFile]]:
        """Return the files by host name; without an authority, the keys are missing."""
        config = self.flags.config
        gain_schedule.require(self.robot, config)
        try:
            schedule = gain_schedule.path_beside(config).read_bytes()
        except OSError as error:
            raise RunError(f"{gain_schedule.path_beside(config)}: {error.strerror}") from None
        authority = self.authority()
        return {
            remote.host.name: layout.files_of(
                self.hosts, remote.host, self.robot, schedule, authority
            )
            for remote in self.remotes
        }

    def authority(self) -> Authority | None:
        """Return the authority of this robot's keys, or None if it does not exist yet."""
        folder = self.flags.authority or authorities.default_folder(self.robot)
        return Authority(folder) if folder.is_dir() else None


def _given(flags: HostsFlags) -> _Given:
    robot = config_file.load(flags.config)
    hosts = hosts_file.load(flags.hosts, robot)
    return _Given(flags, hosts, robot, [Remote(hosts, host) for host in hosts.named(flags.names)])


def files(flags: FilesFlags) -> int:
    """Write each host's files into a folder."""
    given = _given(flags)
    out = flags.out
    for remote in given.remotes:
        for file in given.files()[remote.host.name]:
            path = out / remote.host.name / file.path.lstrip("/")
            try:
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            except OSError as error:
                raise RunError(
                    f"{path.parent}: cannot be created: {error.strerror}; choose another --out"
                ) from None
            write_atomically(path, file.content, private=file.of_service)
        print(f"{out / remote.host.name}: {', '.join(remote.host.services)}")
    if given.authority() is None:
        print("without keys: there is no authority yet; run `xrl keys make --hosts FILE`")
    return 0


def update(flags: UpdateFlags) -> int:
    """Send each host its files."""
    given = _given(flags)
    if given.authority() is None:
        raise RunError("there is no authority yet; create it with `xrl keys make --hosts FILE`")
    files = given.files()

    def one(remote: Remote) -> str:
        mine = files[remote.host.name]
        return layout.update(given.hosts, remote, mine, while_up=flags.while_up)

    return _each(given, one)


def up(flags: HostsUpFlags) -> int:
    """Start and check the hosts, and only then arm: a stop on one host applies to all."""
    given = _given(flags)
    failed_to_start = _each(given, running.start)
    if failed_to_start or flags.disarmed:
        return failed_to_start
    found = on_all(given.remotes, lambda remote: running.heard(given.hosts, remote))
    failed = [one for one in found.values() if isinstance(one, FleetError)]
    statuses = {name: one for name, one in found.items() if not isinstance(one, FleetError)}
    for error in failed:
        _tell("", error)
    stopped = running.stopped_in(statuses.values())
    if stopped:
        who = next((name for name in stopped.values() if name), "somebody")
        words = f"an emergency stop by {who} is in force on {', '.join(stopped)}; no drive was "
        _tell("", FleetError(f"{words}armed. To end it, run `xrl hosts down`, then `xrl hosts up`"))
    if failed or stopped:
        return FAULT_EXIT_CODE
    return _each(given, lambda r: running.arm(given.hosts, r, statuses[r.host.name]))


def estop(flags: HostsFlags) -> int:
    """Stop every module on the selected hosts."""
    given = _given(flags)
    failed = _each(given, lambda remote: running.estop(given.hosts, remote))
    if failed:
        Console().print(marked("[bold red]not all modules have stopped: cut the power[/]"))
    return failed


def down(flags: HostsDownFlags) -> int:
    """Lower the robot from one of all hosts, then stop the selected hosts' services."""
    given = _given(flags)
    if not flags.limp:
        everyone = [Remote(given.hosts, host) for host in given.hosts.host]
        running.lower(given.hosts, everyone, partial(print, flush=True), wait_s=flags.wait)
    return _each(given, lambda remote: running.down(given.hosts, remote))


def status(flags: HostsFlags) -> int:
    """Show the services of the selected hosts in one table."""
    given = _given(flags)
    found = on_all(given.remotes, lambda remote: running.status(given.hosts, remote))
    good = {name: one for name, one in found.items() if not isinstance(one, FleetError)}
    if good:
        Console().print(tables(running.joined(good)))
    for name, one in found.items():
        if isinstance(one, FleetError):
            _tell(name, one)
    return 0 if len(good) == len(found) else FAULT_EXIT_CODE


def check(flags: HostsFlags) -> int:
    """Check the hosts; return the exit code of a fault if one has a fault or they disagree."""
    given = _given(flags)
    files = given.files()
    found = on_all(
        given.remotes,
        lambda remote: layout.check(given.hosts, remote, files[remote.host.name]),
    )
    rows = [
        HostRow(name, wrong=(str(row),)) if isinstance(row, FleetError) else row
        for name, row in found.items()
    ]
    console = Console()
    console.print(_table(rows))
    others = layout.disagreements(rows)
    for text in others:
        console.print(marked("[bold red]{}[/]", text))
    return FAULT_EXIT_CODE if others or any(row.wrong for row in rows) else 0


def _each(given: _Given, work: Callable[[Remote], str]) -> int:
    """Run a function for the hosts; print each result as it arrives; return 0 if all succeeded."""
    found = on_all(given.remotes, work, _tell)
    failed = any(isinstance(result, FleetError) for result in found.values())
    return FAULT_EXIT_CODE if failed else 0


def _tell(name: str, result: str | FleetError) -> None:
    bad = isinstance(result, FleetError)
    text = str(result) if bad else f"{name}: {result}"
    style = "bold red" if bad else None
    Console().print(text, style=style, highlight=False, soft_wrap=True)


def _table(rows: list[HostRow]) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("host", "version", "unit", ""):
        table.add_column(heading, no_wrap=heading != "")
    for row in rows:
        words = [Text(text, "bold red") for text in row.wrong]
        words += [Text(text, "yellow") for text in row.warnings]
        table.add_row(
            row.name,
            row.revision or "-",
            row.unit,
            Text("\n").join(words) or "ok",
        )
    return table
