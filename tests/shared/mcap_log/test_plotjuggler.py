"""Our files held against the rules by which PlotJuggler reads them (`plotjuggler.py`).

A run in virtual time is opened as it was recorded and as recovered after a cut (the last second of
it, for speed); and a file with a message of every topic. Foxglove's own library takes every schema
in tests/tools/judge/reports/test_scene.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from tests.shared.mcap_log import runs, sample_logs
from tests.shared.mcap_log.mcap_doctor import Examined
from tests.shared.mcap_log.plotjuggler import ARRAY_MAX, INTEGER_MAX, Refused, opened
from tests.shared.mcap_log.runs import OFFSET_NS, item
from tests.shared.mcap_log.sample_logs import write_one
from tools.logs.run_log import read_run

MADE = ("whole", "recovered", "every")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    recorded = sample_logs.record(tmp_path_factory.mktemp("elsewhere"))
    return sample_logs.make(recorded, tmp_path_factory.mktemp("made"))


@pytest.mark.parametrize("name", MADE)
def test_every_message_of_every_file_is_read_and_nothing_but_text_is_lost(
    files: dict[str, Path], name: str
) -> None:
    found, log = opened(files[name]), read_run(files[name])
    assert found.left == {}
    assert found.messages == {key: log.count(key) for key in log.keys()}  # noqa: SIM118
    assert found.lost == {}


def test_points_a_millisecond_apart_stay_apart_in_seconds_since_1970(tmp_path: Path) -> None:
    with runs.write(tmp_path, [item(seq) for seq in range(500)]).open("rb") as file:
        times = [m.publish_time * 1e-9 for _, _, m in make_reader(file).iter_messages()]
    assert times == sorted(set(times))
    off_s = [t_s - (OFFSET_NS + 1_000_000 * seq) * 1e-9 for seq, t_s in enumerate(times)]
    assert max(map(abs, off_s)) < 1e-6


def test_what_is_cut_off_by_a_kill_needs_its_recovery(files: dict[str, Path]) -> None:
    with pytest.raises(Refused, match="no summary"):
        opened(files["cut"])


@pytest.mark.parametrize("name", ["recorded", *MADE])
def test_the_formats_own_doctor_finds_no_error(files: dict[str, Path], name: str) -> None:
    """What it warns of is meant: see the docstrings of `mcap_log`."""
    found = Examined(files[name])
    assert found.errors == []
    log = read_run(files[name])
    assert found.messages == sum(log.count(key) for key in log.keys())  # noqa: SIM118
    meant = {
        "profile 'xrl' is not a well-known one",
        "Schema described twice",
        "Channel described twice",
    }
    assert set(found.warnings) <= meant


def test_the_doctor_finds_what_is_wrong(files: dict[str, Path], tmp_path: Path) -> None:
    assert any("no Footer" in error for error in Examined(files["cut"]).errors)
    bad = tmp_path / "bad.mcap"
    data = files["every"].read_bytes()
    bad.write_bytes(data.replace(b'"title":"Wrench"', b'"title":"Wrunch"', 1))
    assert any("described in two ways" in error for error in Examined(bad).errors)


LOST: dict[str, tuple[list[Any], set[str]]] = {
    "nothing": ([{"mode": "HOLD", "n": 1, "v": [[True], [0.5]]}, {"mode": "", "n": 2}], set()),
    "an empty array": ([{"v": []}], {"a/b/v"}),
    "an empty object": ([{"v": {}}], {"a/b/v"}),
    "null": ([{"w": None, "n": 1}], {"a/b/w"}),
    "the end of an array": ([{"v": [0] * (ARRAY_MAX + 1)}], {"a/b/v"}),
    "an integer that was a float": ([{"x": [1.5]}, {"x": [1]}], {"a/b/x[0]"}),
    "a flag that was a number": ([{"x": 1}, {"x": True}], {"a/b/x"}),
    "an integer": ([{"n": INTEGER_MAX, "m": -INTEGER_MAX - 1}], {"a/b/m"}),
}


@pytest.mark.parametrize(("payloads", "lost"), LOST.values(), ids=LOST)
def test_the_rules_notice_what_would_be_lost(
    tmp_path: Path, payloads: list[Any], lost: set[str]
) -> None:
    """A test that could not fail would hold nothing."""
    found = opened(write_one(tmp_path / "one.mcap", payloads))
    assert (set(found.lost), found.messages) == (lost, {"a/b": len(payloads)})


def test_the_rules_know_which_channels_are_read(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    assert opened(write_one(path, [{"x": 1}], encoding="flatbuffer")).lost == {"a/b": "no parser"}
    strange = opened(write_one(path, [b"\x08\x01"], encoding="protobuf"))
    assert (strange.left, strange.messages) == ({"a/b": ("protobuf", "protobuf")}, {})
    with pytest.raises(Refused, match="schema 0 is not there"):
        opened(write_one(path, [{"x": 1}], with_schema=False))
    for broken in (b'{"x":NaN}', b'{"x":'):
        with pytest.raises(Refused, match="no JSON"):
            opened(write_one(path, [broken]))
