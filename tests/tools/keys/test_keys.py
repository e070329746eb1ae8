"""`xrl keys`: the authority stays, each host gets its own, and what is wrong is told."""

from __future__ import annotations

import datetime as dt
import stat
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from shared.bus.credentials import read_names
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.config.sections import BusSecurityConfig
from tests.certified import give, signer_of, tls_endpoints
from tools import cli
from tools.keys import certificates
from tools.keys.authority import Authority


class Place(NamedTuple):
    """Where one robot's keys are."""

    config: Path
    authority: Path
    keys: Path

    def xrl(self, order: str, *words: str) -> int:
        where = ["--config", str(self.config), "--authority", str(self.authority)]
        return cli.main(["keys", order, *words, *where])

    def check(self) -> int:
        return cli.main(["keys", "check", "--config", str(self.config)])


@pytest.fixture
def place(robot: RobotConfig, tmp_path: Path) -> Place:
    keys = tmp_path / "keys"
    security = BusSecurityConfig(mode="mtls", keys=str(keys))
    bus = msgspec.structs.replace(robot.bus, endpoints=tls_endpoints(), security=security)
    config = tmp_path / "robot.toml"
    certified = msgspec.structs.replace(robot, bus=bus)
    config.write_text(config_file.to_toml(certified), encoding="utf-8")
    return Place(config, tmp_path / "authority", keys)


@pytest.fixture
def made(place: Place) -> Place:
    assert place.xrl("make") == 0
    assert place.xrl("pack", "--install") == 0
    return place


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_every_file_is_its_owners_alone(made: Place) -> None:
    for folder in (made.authority, made.keys):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        for path in folder.iterdir():
            assert stat.S_IMODE(path.stat().st_mode) == 0o600, path


def test_openssl_agrees_that_the_authority_signed_each_certificate(made: Place) -> None:
    for path in sorted(made.keys.glob("*.pem")):
        words = ["openssl", "verify", "-CAfile", str(made.keys / "authority.pem"), str(path)]
        said = subprocess.run(words, capture_output=True, text=True, check=False)
        assert said.returncode == 0, said.stderr
    text = subprocess.run(
        ["openssl", "x509", "-noout", "-text", "-in", str(made.keys / "planner.pem")],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert "CN=planner.1" in text.replace(" = ", "=")
    assert "prime256v1" in text
    assert "IP Address:127.0.0.1" in text
    assert "CA:FALSE" in text


def test_a_bundle_holds_what_its_host_runs_and_never_the_authoritys_key(
    made: Place, tmp_path: Path
) -> None:
    out = tmp_path / "leg.tar"
    assert made.xrl("pack", "knee_left", "hip_left", "-o", str(out)) == 0
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    with tarfile.open(out) as tar:
        assert {entry.mode for entry in tar} == {0o600}
        tar.extractall(tmp_path / "host")  # noqa: S202 - its own; Python 3.11.2 knows no filter
    assert set(contents(tmp_path / "host" / "keys")) == {
        "authority.pem", "names.toml",
        "knee_left.pem", "knee_left.key", "hip_left.pem", "hip_left.key",
    }  # fmt: skip
    assert "authority.key" in contents(made.authority)
    assert "authority.key" not in contents(made.keys)


def test_a_second_authority_is_refused_and_the_first_stays(made: Place, capsys: object) -> None:
    before = contents(made.authority)
    assert made.xrl("make") == 2
    assert contents(made.authority) == before


def test_a_robot_without_tls_endpoints_gets_no_authority_at_all(
    place: Place, robot: RobotConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    place.config.write_text(config_file.to_toml(robot), encoding="utf-8")
    assert place.xrl("make") == 2
    assert "must be tls/HOST:PORT" in capsys.readouterr().err
    assert not place.authority.exists()


def test_renewing_keeps_the_generation_and_revoking_goes_on_to_the_next(made: Place) -> None:
    before = (made.authority / "planner.pem").read_bytes()
    assert made.xrl("renew", "planner", "--days", "90") == 0
    renewed = (made.authority / "planner.pem").read_bytes()
    assert renewed != before
    assert certificates.read(renewed).common_name == "planner.1"
    assert made.check() == 0, "the earlier one is let in until it is packed again"
    assert made.xrl("revoke", "planner") == 0
    assert certificates.read((made.authority / "planner.pem").read_bytes()).common_name == (
        "planner.2"
    )
    assert read_names(made.authority).generations["planner"] == 2
    assert read_names(made.authority).generations["harness"] == 1
    assert made.xrl("pack", "--install") == 0
    assert made.check() == 0


def _give(place: Place, **how: Any) -> None:
    give(signer_of(Authority(place.authority)), place.keys, "planner", **how)


def _another_authority(place: Place) -> None:
    give(certificates.make_authority("xrl", dt.datetime.now(dt.UTC)), place.keys, "planner")


def _another_key(place: Place) -> None:
    (place.keys / "planner.key").write_bytes((place.keys / "harness.key").read_bytes())


FAULTS: dict[str, tuple[Callable[[Place], object], int, str]] = {
    "not valid yet": (lambda p: _give(p, from_day=40), 3, "not valid before"),
    "expired": (lambda p: _give(p, from_day=-40, days=10), 3, "expired"),
    "expires soon": (lambda p: _give(p, days=20), 0, "expires in 19 days"),
    "an earlier generation": (lambda p: _give(p, generation=0), 3, "planner.0"),
    "another host's": (lambda p: _give(p, host="10.1.1.1"), 3, "not for 127.0.0.1"),
    "another authority's": (_another_authority, 3, "another authority"),
    "another's key": (_another_key, 3, "its key is that of another"),
    "readable": (lambda p: (p.keys / "planner.key").chmod(0o644), 3, "chmod 600"),
    "no certificate": (lambda p: (p.keys / "planner.pem").write_bytes(b"x"), 3, "planner"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_check_tells_what_is_wrong(
    made: Place, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert made.check() == 0
    spoil, code, words = FAULTS[fault]
    spoil(made)
    capsys.readouterr()
    assert made.check() == code
    assert words in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("order", "words", "said"),
    [
        ("pack", ["cook", "-o", "x.tar"], "'cook' has no certificate here; use one of planner"),
        ("renew", ["cook"], "'cook': must be one of"),
        ("revoke", ["cook"], "'cook': must be one of"),
        ("pack", ["planner", "-o", "/dev/full"], "not a regular file"),
        ("pack", ["planner", "-o", "/no/such/place.tar"], "cannot write it"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_changes_nothing(
    made: Place, order: str, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(made.authority)
    capsys.readouterr()
    assert made.xrl(order, *words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert contents(made.authority) == before


def test_an_authority_that_is_not_there_or_another_robots_is_refused(
    made: Place, robot: RobotConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    other = config_file.load(made.config)
    made.config.write_text(
        config_file.to_toml(msgspec.structs.replace(other, name="other")), encoding="utf-8"
    )
    assert made.xrl("renew", "--all") == 2
    assert "authority of 'xrl'; give the authority of 'other'" in capsys.readouterr().err
    elsewhere = made._replace(authority=made.authority / "nowhere")
    assert elsewhere.xrl("renew", "--all") == 2
    assert "names.toml is missing" in capsys.readouterr().err
