"""A host whose .bashrc prints: only the output of our own commands is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tests.tools.hosts.places import make_hosts
from tools.hosts import hosts_file, layout
from tools.hosts.remote import Remote

NOISE = 'echo "Welcome to $1"; echo "17"; printf "no end of line> "'


@pytest.fixture
def base(short_dir: Path) -> Path:
    make_hosts(short_dir)
    return short_dir


def have_shells_print(base: Path, noise: str = NOISE) -> None:
    """Have every host's shell print before it runs a command."""
    ssh = base / "bin" / "ssh"
    first, _, rest = ssh.read_text(encoding="utf-8").partition("\n")
    ssh.write_text(f"{first}\n{noise}\n{rest}", encoding="utf-8")


@pytest.fixture
def remote(base: Path, robot: RobotConfig) -> Remote:
    have_shells_print(base)
    hosts = hosts_file.load(base / "hosts.toml", robot)
    return Remote(hosts, hosts.host[0])


def test_a_commands_output_is_its_own(remote: Remote) -> None:
    assert remote.must("echo", "a b") == "a b\n"
    assert remote.run("sh", "-c", "cat; exit 3", content=b"in")[:2] == (3, "in")
    told: list[str] = []
    remote.follow("printf", "one\\ntwo\\n", tell=told.append)
    assert told == ["body: one", "body: two"]
    assert layout.is_up(remote) is False


def test_a_shell_that_does_not_run_the_command_is_an_error(base: Path, robot: RobotConfig) -> None:
    have_shells_print(base, "echo this account is not available; exit 0")
    hosts = hosts_file.load(base / "hosts.toml", robot)
    with pytest.raises(FleetError, match="did not run the command: this account is not available"):
        Remote(hosts, hosts.host[0]).must("true")
