"""`xrl up`: keys by which no link comes and a record that cannot be, told before it starts."""

from __future__ import annotations

import datetime as dt
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, RunError
from shared.mcap_log.files import FIRST
from shared.places import DEFAULT_CONFIG
from tests.certified import certified
from tests.tools.exit_codes import exit_code
from tools import cli
from tools.fleet.supervise import SupervisedFleet
from tools.keys import authority as authority_module
from tools.live.experiment import FAILED_START, make_out, record_of_start
from tools.verbs import up


@pytest.fixture
def not_valid_yet(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> RobotConfig:
    """Return a robot whose host's clock is before its certificates' time."""
    later = dt.datetime.now(dt.UTC) + dt.timedelta(days=30)
    clock = SimpleNamespace(UTC=dt.UTC, datetime=SimpleNamespace(now=lambda _zone: later))
    monkeypatch.setattr(authority_module, "dt", clock)
    return certified(robot, tmp_path)[0]


def test_nothing_starts_while_the_clock_is_before_the_certificates_time(
    not_valid_yet: RobotConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, run_dir = tmp_path / "robot.toml", tmp_path / "run"
    config.write_text(config_file.to_toml(not_valid_yet), encoding="utf-8")
    schedule = DEFAULT_CONFIG.with_suffix(".gains.json")
    (tmp_path / "robot.gains.json").write_bytes(schedule.read_bytes())
    where = ["--config", str(config), "--run-dir", str(run_dir), "--out", str(tmp_path / "out")]
    assert cli.main(["up", *where]) == 2
    assert re.search("not valid before .*set the clock", capsys.readouterr().err)
    assert not run_dir.exists()


def test_where_nobody_looks_on_the_services_start_without_keys_and_without_a_record(
    not_valid_yet: RobotConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    up._check_keys(not_valid_yet, must=False)
    assert "links over TLS will fail: " in capsys.readouterr().err
    taken = tmp_path / "out"
    taken.write_text("a file", encoding="utf-8")
    up._make_record_folder(taken / "now", must=False)
    assert "not recorded: " in capsys.readouterr().err
    with pytest.raises(RunError, match="cannot create it"):
        up._make_record_folder(taken / "now", must=True)


@pytest.mark.parametrize(("service", "recorded"), [("recorder", True), ("planner", False)])
def test_a_host_without_a_recorder_gets_no_folder_for_a_record_and_no_failed_start_leaves_one(
    service: str, recorded: bool, run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, made = tmp_path / "out", []

    def fail(*_: object) -> None:
        made.append(out.exists())
        raise FleetError("it is not to be started here")

    monkeypatch.setattr(SupervisedFleet, "start", fail)
    words = ["up", "--run-dir", run_dir, "--out", out, "--only", service]
    assert exit_code(words) == 2
    assert made == [recorded]
    assert not out.exists()
    out.mkdir()  # somebody else's stays
    assert exit_code(words) == 2
    assert out.exists()


def fail_after_recording(out: Path, record: bytes, ending: type[BaseException]) -> None:
    with record_of_start(out):
        (out / FIRST).write_bytes(record)
        raise ending


@pytest.mark.parametrize("ending", [FleetError, KeyboardInterrupt])
def test_the_record_of_a_failed_start_does_not_keep_the_next_from_its_folder(
    ending: type[BaseException], tmp_path: Path
) -> None:
    for record in (b"first", b"second"):
        out = make_out(tmp_path / "out", "up")
        with pytest.raises(ending):
            fail_after_recording(out, record, ending)
        assert (out / FAILED_START).read_bytes() == record


def test_a_failed_start_leaves_the_record_of_an_earlier_run_where_it_is(tmp_path: Path) -> None:
    """A disarmed start begins in a folder that holds one."""
    (tmp_path / FIRST).write_bytes(b"a run")
    with pytest.raises(FleetError), record_of_start(tmp_path):
        raise FleetError
    assert [path.name for path in tmp_path.iterdir()] == [FIRST]
