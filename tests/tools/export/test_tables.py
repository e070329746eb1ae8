"""`xrl log export --csv`: every number of the log, and nothing made up."""

from __future__ import annotations

import csv
from pathlib import Path

import msgspec
import pytest

from shared.bus import topics
from shared.bus.messages import JointState
from shared.bus.topics import TOPICS
from shared.clock import NS_PER_S
from shared.joints import MODULES
from tools import cli
from tools.export.tables import FOR_REEXECUTION, HELD_S, columns_of
from tools.judge.run_parts import zero_ns
from tools.logs.run_index import RunIndex
from tools.logs.run_log import read_run


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_message_of_every_key_is_in_the_file_of_its_key(
    run_file: Path, tmp_path: Path
) -> None:
    assert cli.main(["log", "export", str(run_file), "--csv", str(tmp_path / "csv")]) == 0
    log = read_run(run_file)
    prefix = f"xrl/{log.robot}/"
    wanted = {
        key.removeprefix(prefix).replace("/", "."): log.count(key)
        for key, topic in topics.all_keys(log.robot).items()
        if log.count(key) and topic not in FOR_REEXECUTION
    }
    led = [row for row in log.messages(topics.PLANNER_STATUS) if row.commands]
    wanted |= {f"joint.{module}.command": len(led) for module in MODULES}
    found = {path.stem: len(rows_of(path)) for path in (tmp_path / "csv").iterdir()}
    assert found == wanted
    assert len(found) > 20


def test_a_row_is_the_message_with_time_zero_at_the_scenarios_start(
    run_file: Path, tmp_path: Path
) -> None:
    words = ["--topic", "joint/knee_left/state", "--topic", "planner/status"]
    assert cli.main(["log", "export", str(run_file), "--csv", str(tmp_path / "t"), *words]) == 0
    assert {path.name for path in (tmp_path / "t").iterdir()} == {
        "joint.knee_left.state.csv", "planner.status.csv",
    }  # fmt: skip
    zero = zero_ns(RunIndex(run_file))
    states: list[JointState] = read_run(run_file).messages(topics.JOINT_STATE, "knee_left")
    rows = rows_of(tmp_path / "t" / "joint.knee_left.state.csv")
    for state, row in zip(states, rows, strict=True):
        if state.t_ns:
            assert float(row["time_s"]) == (state.t_ns - zero) / NS_PER_S
        assert (float(row["q[0]"]), float(row["q[1]"])) == state.q
        assert (int(row["mode"]), row["ready"]) == (state.mode, str(state.ready))
    assert list(rows[0])[:3] == ["time_s", "t_ns", "seq"]


def test_on_a_grid_each_cell_is_the_newest_message_and_empty_once_its_sender_is_silent(
    run_file: Path, tmp_path: Path
) -> None:
    """The planner dies at 0.5 s."""
    words = ["--rate", "50", "--from", "0", "--to", "1.4", "--topic", "planner/status"]
    words += ["--topic", "sim/truth", "--topic", "run/event"]
    out = tmp_path / "t"
    assert cli.main(["log", "export", str(run_file), "--csv", str(out), *words]) == 0
    rows = rows_of(out / "run.csv")
    times = [float(row["time_s"]) for row in rows]
    assert times == [pytest.approx(number / 50) for number in range(70)]
    for at, row in zip(times, rows, strict=True):
        if abs(at - 0.5 - HELD_S) > 0.05:
            assert (row["planner/status.mode"] != "") is (at < 0.5 + HELD_S)
        seen = float(row["sim/truth.scenario_s"])
        assert at < 0.02 or at - 0.021 < seen <= at + 1e-6
    assert not any(name.startswith("run/event") for name in rows[0]), "events have no rate"


def test_the_columns_of_a_type_are_all_of_its_fields_each_element_one() -> None:
    for topic in TOPICS:
        columns = columns_of(topic.type)
        fields = [field.name for field in msgspec.structs.fields(topic.type)]
        fields = [name for name in fields if name != "commands"]  # they have tables of their own
        assert list(dict.fromkeys(name.partition("[")[0] for name in columns)) == sorted(
            fields, key=lambda name: name not in ("t_ns", "seq")
        )


def test_an_earlier_export_is_replaced_only_with_force(run_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "t"
    words = ["log", "export", str(run_file), "--csv", str(out), "--topic"]
    assert cli.main([*words, "run/event"]) == 0
    assert cli.main([*words, "planner/status"]) == 2
    assert cli.main([*words, "planner/status", "--force"]) == 0
    assert [path.name for path in out.iterdir()] == ["planner.status.csv"]


@pytest.mark.parametrize("mine", ["notes.txt", "run.mcap", "deeper/x.csv"])
def test_what_is_not_of_an_export_is_never_taken_away(
    run_file: Path, tmp_path: Path, mine: str
) -> None:
    kept = tmp_path / "t" / mine
    kept.parent.mkdir(parents=True)
    kept.write_text("mine", encoding="utf-8")
    for flag in ("--csv", "--ros2bag"):
        words = ["log", "export", str(run_file), flag, str(tmp_path / "t"), "--force"]
        assert cli.main(words) == 2
        assert kept.read_text(encoding="utf-8") == "mine"


def test_the_folder_of_the_record_is_refused_whatever_it_is_called(
    run_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run_file.parent)
    for out in (".", str(run_file.parent), str(run_file.parent.parent), ".."):
        assert cli.main(["log", "export", str(run_file), "--csv", out, "--force"]) == 2
    assert run_file.exists()
