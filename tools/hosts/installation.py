"""Brings each host's files there, and looks whether they are as they should be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.bus.credentials import NAMES
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tools.hosts.hosts_file import Host, Hosts, principals_on
from tools.hosts.layout import (
    FIREWALL,
    KEYS,
    NFT,
    ROBOT_FILE,
    RUN_DIR,
    SCHEDULE,
    UNIT,
    firewall,
    robot_on_hosts,
    unit,
)
from tools.hosts.probe import Probe, digest
from tools.hosts.remote import Remote
from tools.keys.authority import Authority, bundle

_AT_REST: Final = ("inactive", "failed", "unknown")
"""States of a unit whose services are down."""
_UNIT_FOLDER: Final = "/etc/systemd/system"


class HostFile(NamedTuple):
    """One file of a host."""

    path: str
    content: bytes
    of_service: bool = False
    """True: it belongs to who runs the services, and is theirs alone; else to root."""


class HostRow(NamedTuple):
    """One host in the table of `xrl hosts check`."""

    name: str
    reached: bool = False
    revision: str = ""
    unit: str = "-"
    """State of its unit by systemd."""
    made_from: tuple[str, str] = ("", "")
    """Hash of the lock file, and Python's version."""
    wrong: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def files_of(
    hosts: Hosts, host: Host, robot: RobotConfig, schedule: bytes, authority: Authority | None
) -> list[HostFile]:
    """Return what a host has to have; without an authority all but its keys."""
    spread = robot_on_hosts(robot, hosts)
    folder = hosts.folder
    files = [
        HostFile(f"{folder}/{ROBOT_FILE}", config_file.to_toml(spread).encode()),
        HostFile(f"{folder}/{SCHEDULE}", schedule),
        HostFile(f"{folder}/{FIREWALL}", firewall(spread).encode()),
        HostFile(f"{_UNIT_FOLDER}/{UNIT}", unit(hosts, host).encode()),
    ]
    if authority is not None:
        keys = bundle(authority, principals_on(host))
        files += [
            HostFile(f"{folder}/{KEYS}/{n}", text, of_service=True) for n, text in keys.items()
        ]
    return files


def update(hosts: Hosts, remote: Remote, files: list[HostFile], *, while_up: bool) -> str:
    """Bring files to a host, and take away keys that it is not to have; a start takes them."""
    if not while_up:
        _refuse_up(remote)
    folder = hosts.folder
    keys = f"{folder}/{KEYS}"
    remote.must("install", "-d", "-m", "755", folder)
    remote.must("install", "-d", "-m", "700", "-o", hosts.user, keys)
    for file in files:
        remote.write(file.path, file.content, private=file.of_service)
    names = [Path(file.path).name for file in files if file.of_service]
    others = [word for name in names for word in ("!", "-name", name)]
    remote.must(
        "find", keys, "-maxdepth", "1", "(", "-name", "*.pem", "-o", "-name", "*.key", ")",
        *others, "-delete", as_user=True,
    )  # fmt: skip
    remote.must("systemctl", "daemon-reload")
    remote.must("systemctl", "enable", "--quiet", UNIT)
    return f"{len(files)} files"


def is_up(remote: Remote) -> bool:
    """Return True unless a host's services are known to be down."""
    return _state(remote) not in _AT_REST


def _refuse_up(remote: Remote) -> None:
    """Refuse new files while a host's services are up."""
    state = _state(remote)
    if state not in _AT_REST:
        raise FleetError(
            f"{remote.host.name}: its unit is {state}: a service that crashes would come back with "
            "the new files beside the old; `xrl hosts down` first, or --while-up"
        )


def check(hosts: Hosts, remote: Remote, files: list[HostFile]) -> HostRow:
    """Look at a host, and compare it with what it has to have."""
    python, config = f"{hosts.checkout}/.venv/bin/python", f"{hosts.folder}/{ROBOT_FILE}"
    # the module is found in the installed package, wherever the command starts
    words = ("-P", "-m", "tools.hosts.probe", "--config", config, "--run-dir", RUN_DIR)
    line = remote.must(python, *words, as_user=True)
    try:
        probe = msgspec.json.decode(line.encode(), type=Probe)
    except msgspec.DecodeError:
        raise FleetError(f"{remote.host.name}: {hosts.checkout} is of another version") from None
    wanted = {Path(file.path).name: digest(file.content) for file in files if not file.of_service}
    wrong = list(probe.wrong)
    if probe.robot != wanted[ROBOT_FILE]:
        wrong.append("another robot file; `xrl hosts update`")
    if probe.schedule != wanted[SCHEDULE]:
        wrong.append("another gain schedule; `xrl hosts update`")
    wrong += _about_keys(probe, {Path(f.path).name: f.content for f in files if f.of_service})
    if digest(remote.run("cat", f"{_UNIT_FOLDER}/{UNIT}").out.encode()) != wanted[UNIT]:
        wrong.append(f"another {UNIT}; `xrl hosts update`")
    state, warnings = _state(remote), list(probe.warnings)
    if state not in _AT_REST and remote.run(NFT, "list", "table", "inet", "xrl").code:
        warnings.append(f"no firewall at its ports: `nft -f {hosts.folder}/{FIREWALL}`")
    if not probe.revision:
        wrong.append(f"of no known version: {hosts.checkout} is no git checkout that can be read")
    if probe.revision.endswith("+"):
        warnings.append(f"{hosts.checkout} has changes of its own")
    return HostRow(
        name=remote.host.name,
        reached=True,
        revision=probe.revision,
        unit=state,
        made_from=(probe.lock, probe.python),
        wrong=tuple(wrong),
        warnings=tuple(warnings),
    )


def _about_keys(probe: Probe, wanted: dict[str, bytes]) -> list[str]:
    """Return what is wrong with a host's keys against those that it is to have."""
    wrong = []
    wanted_now = {name: digest(content) for name, content in wanted.items()}
    other = sorted(n for n, found in wanted_now.items() if probe.keys.get(n) != found)
    extra = sorted(set(probe.keys) - set(wanted))
    if NAMES in other:
        wrong.append("lets in other generations than the authority; `xrl hosts update`")
        other.remove(NAMES)
    if other:
        wrong.append(f"other keys than the authority's: {', '.join(other)}; `xrl hosts update`")
    if wanted and extra:
        wrong.append(f"keys that it is not to have: {', '.join(extra)}; `xrl hosts update`")
    return wrong


def _state(remote: Remote) -> str:
    return remote.run("systemctl", "is-active", UNIT).out.strip() or "no systemd"


def disagreements(rows: list[HostRow]) -> list[str]:
    """Return what is not the same on all hosts that were reached."""
    wrong = []
    for word, value_of in _SAME_ON_ALL.items():
        found = {row.name: value_of(row) for row in rows if row.reached}
        if len(set(found.values())) > 1:
            rest = ", ".join(f"{name} {value or 'none'}" for name, value in found.items())
            wrong.append(f"several {word}: {rest}")
    return wrong


_SAME_ON_ALL: Final[dict[str, Callable[[HostRow], str]]] = {
    "versions": lambda row: row.revision,
    "lock files": lambda row: row.made_from[0],
    "Pythons": lambda row: row.made_from[1],
}
