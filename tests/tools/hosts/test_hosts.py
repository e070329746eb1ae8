"""`xrl hosts`: the file, what each host gets, and what is told of a host that is not right."""

from __future__ import annotations

import re
import shutil
import stat
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from shared import scheduling
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from shared.joints import MODULES
from shared.places import DEFAULT_CONFIG
from tests.tools.hosts.places import LEGS, SHARED, complaints_about, make_hosts
from tools import cli
from tools.hosts import hosts_file, layout
from tools.hosts.hosts_file import Hosts, principals_on
from tools.hosts.probe import probe
from tools.keys.authority import principals_of


@pytest.fixture
def base(short_dir: Path) -> Path:
    return short_dir


@pytest.fixture
def file(base: Path) -> Path:
    return make_hosts(base)


@pytest.fixture
def hosts(file: Path, robot: RobotConfig) -> Hosts:
    return hosts_file.load(file, robot)


def xrl(order: str, base: Path, *words: str, verb: str = "hosts") -> int:
    where = ["--hosts", str(base / "hosts.toml"), "--authority", str(base / "authority")]
    return cli.main([verb, order, *words, *where])


def told_of(base: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return what is told of hosts that are not right."""
    capsys.readouterr()
    assert xrl("check", base) == 3
    return " ".join(capsys.readouterr().out.split())


def make_keys(base: Path) -> None:
    assert xrl("make", base, verb="keys") == 0


def changed(file: Path, **changes: Any) -> Path:
    """Change the hosts file; `services0` is a key of the first host."""
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    for key, value in changes.items():
        found = re.fullmatch(r"([a-z]+)(\d)", key)
        if found:
            table["host"][int(found[2])][found[1]] = value
        else:
            table[key] = value
    file.write_text(tomli_w.dumps(table), encoding="utf-8")
    return file


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a host without services": ({"services0": []}, "at least one"),
    "a service nowhere": ({"services0": ["planner", "harness"]}, "no host runs recorder"),
    "a service twice": ({"services0": ["planner", "harness", "recorder", "knee_left"]}, "on body"),
    "an unknown service": ({"services0": ["planner", "cook"]}, "no service 'cook'"),
    "a simulator": ({"services0": ["simulator"]}, "no service 'simulator'"),
    "a split leg": (
        {"services1": [*LEGS["right"], "hip_left"], "services2": ["ankle_left", "knee_left"]},
        "the left leg's services are on several hosts",
    ),
    "a name for an address": ({"address0": "body.local"}, "an IP address"),
    "an address of all": ({"address0": "0.0.0.0"}, "of one host"),  # noqa: S104 - refused
    "an address twice": ({"address0": "127.0.0.3"}, "is used twice"),
    "a name twice": ({"name0": "right"}, "is used twice"),
    "a name with a slash": ({"name0": "../x"}, "letters, digits"),
    "an option as a host": ({"ssh0": "-oProxyCommand=x"}, "an ssh destination"),
    "an unknown tool": ({"tools0": ["root"]}, "one of operator, viewer"),
    "processors": ({"processors0": "all; x"}, "systemd's notation"),
    "a relative checkout": ({"checkout": "xrl"}, "an absolute path"),
    "a folder with a quote": ({"folder": "/etc/x'"}, "an absolute path"),
    "a name that is allowed": ({"allow": ["laptop"]}, "an IP address"),
    "a user": ({"user": "a b"}, "a user's name"),
    "an unknown key": ({"colour": "red"}, "colour"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_hosts_file_that_cannot_be_right_is_refused(
    file: Path, robot: RobotConfig, fault: str
) -> None:
    changes, words = REFUSED[fault]
    with pytest.raises(ConfigError, match=words):
        hosts_file.load(changed(file, **changes), robot)


def test_each_service_is_dialled_at_its_hosts_address_and_the_file_is_one_that_loads(
    hosts: Hosts, robot: RobotConfig, tmp_path: Path
) -> None:
    spread = layout.robot_on_hosts(robot, hosts)
    path = tmp_path / "robot.toml"
    path.write_text(config_file.to_toml(spread), encoding="utf-8")
    assert config_file.load(path).bus.security.mode == "mtls"
    for host in hosts.host:
        for service in host.services:
            assert spread.bus.endpoints[service].startswith(f"tls/{host.address}:")
    assert len(set(spread.bus.endpoints.values())) == len(spread.bus.endpoints)


def test_a_host_gets_the_keys_of_what_it_runs_and_of_nothing_else(
    hosts: Hosts, robot: RobotConfig
) -> None:
    held = {host.name: set(principals_on(host)) for host in hosts.host}
    assert held["body"] == {"planner", "harness", "recorder", "operator"}
    assert held["left"] == {*LEGS["left"], "viewer"}
    assert set.union(*held.values()) == set(principals_of(robot)) - {"simulator"}


def test_a_host_without_a_tools_key_keeps_no_record_and_its_file_stays_right(
    file: Path, robot: RobotConfig
) -> None:
    hosts = hosts_file.load(changed(file, tools1=[]), robot)
    assert hosts.host[1].processes == hosts.host[1].services
    assert "host_recorder" in hosts.host[2].processes


def test_systemd_takes_the_unit_and_it_arms_nothing(hosts: Hosts, tmp_path: Path) -> None:
    for host in hosts.host:
        text = layout.unit(hosts, host)
        assert "--disarmed" in text
        own = "" if "recorder" in host.services else ",host_recorder"
        assert f"--only {','.join(host.services)}{own}\n" in text
        restarts_buses = "AmbientCapabilities=CAP_NET_ADMIN\n" in text
        assert restarts_buses is bool({*MODULES} & {*host.services})
        # what systemd cannot look for on this machine: the user, and the program's file
        text = text.replace("User=xrl", "User=root")
        text = re.sub(r"^(Exec\w+=)\S+", r"\1/bin/true", text, flags=re.MULTILINE)
        unit = tmp_path / "xrl.service"
        unit.write_text(text, encoding="utf-8")
        assert complaints_about(unit) == []


def test_laptops_are_let_in_beside_the_hosts(file: Path, robot: RobotConfig) -> None:
    hosts = hosts_file.load(changed(file, allow=["10.0.0.9"]), robot)
    assert layout.robot_on_hosts(robot, hosts).bus.security.allow == ("10.0.0.9",)


def test_files_are_written_as_they_will_be_and_private_keys_for_their_owner_alone(
    file: Path, base: Path
) -> None:
    assert xrl("files", base, "-o", str(base / "without")) == 0
    assert not list((base / "without").rglob("*.key")), "there is no authority yet"
    make_keys(base)
    assert xrl("files", base, "-o", str(base / "out")) == 0
    body = base / "out" / "body"
    keys = {path.name for path in (body / "etc/xrl/keys").glob("*.key")}
    assert keys == {"planner.key", "harness.key", "recorder.key", "operator.key"}
    for path in body.rglob("*.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert (body / "etc/systemd/system/xrl.service").is_file()
    assert (body / "etc/xrl/robot.gains.json").read_bytes() == (
        DEFAULT_CONFIG.with_suffix(".gains.json").read_bytes()
    )


def test_update_brings_all_and_check_then_tells_what_somebody_changed(
    file: Path, base: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert xrl("update", base) == 2
    assert "create it with `xrl keys make --hosts FILE`" in capsys.readouterr().err
    make_keys(base)
    assert xrl("update", base) == 0
    for host in ("body", "right", "left"):
        keys = base / host / "etc/xrl/keys"
        assert stat.S_IMODE(keys.stat().st_mode) == 0o700
        assert stat.S_IMODE((keys / "names.toml").stat().st_mode) == 0o600
        assert not (keys / "authority.key").exists()
        calls = (base / host / "calls").read_text()
        assert "systemctl daemon-reload" in calls
    said = told_of(base, capsys)
    # the probe looks for the keys where the robot file says, which is no place of this machine
    assert all(word in said for word in ("body", "right", "left", "inactive", "/etc/xrl/keys"))
    assert "differs" not in said
    robot = base / "left/etc/xrl/robot.toml"
    robot.write_text(robot.read_text().replace("payload = ", "payload = 1"), encoding="utf-8")
    (base / "right/etc/systemd/system/xrl.service").write_text("[Unit]\n")
    said = told_of(base, capsys)
    assert "robot file differs" in said
    assert "xrl.service differs" in said


@pytest.mark.parametrize("pause_ms", [0.0, 50.0])
def test_a_host_whose_kernel_stops_what_fills_a_processor_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pause_ms: float
) -> None:
    monkeypatch.setattr(scheduling, "real_time_pause_ms", lambda: pause_ms)
    warnings = " ".join(probe(tmp_path / "robot.toml", tmp_path).warnings)
    assert ("of each second; run `sysctl kernel." in warnings) is (pause_ms > 0.0)


def test_a_host_that_is_not_reached_is_told_and_the_others_go_on(
    file: Path, base: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_keys(base)
    shutil.rmtree(base / "left")
    capsys.readouterr()
    assert xrl("update", base) == 3
    said = " ".join(capsys.readouterr().out.split())
    assert "left: left cannot be reached: ssh: connect to host left: No route to host" in said
    assert "body: " in said
    assert (base / "body/etc/xrl/robot.toml").is_file()
    assert xrl("status", base, "left") == 3
    assert xrl("up", base, "elsewhere") == 2
    assert "no such host; use one of body, right, left" in capsys.readouterr().err


def test_down_stops_no_host_before_one_of_them_has_lowered_the_robot(
    file: Path, base: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = base / "told"
    program = base / "co/.venv/bin/xrl"
    program.write_text(
        f"#!/bin/bash\necho $ROOT $* >>{told}\n"
        "[[ $* == *--lower-only* ]] || exit 0\n"
        'echo "going down"; echo "xrl: it still holds: --limp" >&2; exit 2\n',
        encoding="utf-8",
    )
    for host in ("body", "left"):
        run_dir = base / host / "var/lib/xrl/run"
        run_dir.mkdir(parents=True)
        (run_dir / "supervisord.pid").touch()
    assert xrl("down", base, "left", "--wait", "5") == 2
    said = capsys.readouterr()
    assert said.out == "body: going down\n"
    assert "nothing was stopped: body: xrl: it still holds" in said.err
    (line,) = told.read_text(encoding="utf-8").splitlines()
    assert line.startswith(f"{base}/body down --lower-only --wait 5 ")
    assert "stop" not in (base / "left/calls").read_text(encoding="utf-8")
    assert xrl("down", base, "left", "--limp") == 0
    assert "systemctl stop xrl.service" in (base / "left/calls").read_text(encoding="utf-8")
    shutil.rmtree(base / "right")
    assert xrl("down", base) == 2, "a host that is not reached may hold a leg"


def test_a_key_that_is_lost_is_told_until_every_host_knows(
    base: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_hosts(base, running=True)
    make_keys(base)
    assert xrl("update", base) == 0
    assert xrl("check", base) == 0, capsys.readouterr().out
    assert xrl("revoke", base, "operator", verb="keys") == 0
    said = told_of(base, capsys)
    assert said.count("accepts key generations that are not the authority's") == 3
    assert "keys differ from the authority's: operator.key, operator.pem" in said
    assert xrl("update", base) == 0
    keys = base / "left" / SHARED / "keys"
    shutil.copy(base / "authority" / "planner.key", keys)
    said = told_of(base, capsys)
    assert "keys that it must not have: planner.key" in said
    assert "other" not in said, "every host knows"
    assert xrl("update", base, "left") == 0
    assert not (keys / "planner.key").exists()
    assert xrl("check", base, "left") == 0, capsys.readouterr().out
