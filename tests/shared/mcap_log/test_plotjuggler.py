"""Our files held against the rules by which PlotJuggler reads them (`plotjuggler.py`).

The rules are those of PlotJuggler 3 (3.9 to 3.17: DataLoadMCAP, nlohmann_parsers) and 4 (plugins
data_load_mcap 1.2, parser_json 1.1.1). A run in virtual time is opened as it was recorded, as
recovered after a cut, and as exported with its scene (the last second of it, for speed); and a
file with a message of every topic. Foxglove's own library takes every schema in
tests/tools/judge/reports/test_scene.py.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.bus import topics
from shared.joints import MODULES
from tests.shared.mcap_log import runs, sample_logs
from tests.shared.mcap_log.mcap_doctor import Examined
from tests.shared.mcap_log.plotjuggler import LAST, Opened, Refused, opened_by_3, opened_by_4
from tests.shared.mcap_log.runs import OFFSET_NS, STATE_KEY, item
from tests.shared.mcap_log.sample_logs import write_one
from tools.logs.run_log import RunLog, read_run

VERSIONS = (opened_by_3, opened_by_4)
KEPT_OUT = {"not chosen: no messages"}
SCENE = {"scene/frames", "scene/links", "scene/state", "robot_description"}
"""What an exported copy has more: protobuf, and for Rerun a text of ROS 2 in CDR."""
OTHER_PARSERS = {opened_by_3: {"protobuf", "ros2msg"}, opened_by_4: {"protobuf", "cdr"}}
MADE = ("whole", "recovered", "exported", "every")
Reader = Callable[[Path], Opened]
Open = Callable[[Reader, str], Opened]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    recorded = sample_logs.record(tmp_path_factory.mktemp("elsewhere"))
    return sample_logs.make(recorded, tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="module")
def log(files: dict[str, Path]) -> RunLog:
    return read_run(files["whole"])


@pytest.fixture(scope="module")
def opened(files: dict[str, Path]) -> Open:
    """Return how a version opens a file; each is opened once."""
    return functools.cache(lambda reader, name: reader(files[name]))


def typed(log: RunLog) -> Iterator[tuple[str, list[Any]]]:
    """Yield (key, messages) of all that has messages."""
    for topic in topics.TOPICS:
        for module in MODULES if topic.per_module else ("",):
            if messages := log.messages(topic, module):
                yield topic.key(log.robot, module), messages


def leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield (path, value) of every value of a message."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from leaves(entry, f"{path}/{name}")
    elif isinstance(value, list | tuple):
        for number, entry in enumerate(value):
            yield from leaves(entry, f"{path}[{number}]")
    else:
        yield path, value


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("reader", VERSIONS)
def test_every_message_of_every_file_is_read_and_no_array_is_cut(
    files: dict[str, Path], opened: Open, reader: Reader, name: str
) -> None:
    """The scene's channels are no JSON: PlotJuggler's own parser of protobuf reads them."""
    found, log = opened(reader, name), read_run(files[name])
    left = {f"xrl/{log.robot}/{key}" for key in SCENE} if name == "exported" else set()
    assert set(found.left) == left
    assert not left or set(found.left.values()) == OTHER_PARSERS[reader]
    keys = set(log.keys()) - left
    assert found.messages == {key: log.count(key) for key in keys}
    assert not found.cut
    assert not found.refused
    assert set(found.unread.values()) <= KEPT_OUT


def test_every_number_and_flag_of_a_run_is_a_point_and_only_text_is_not(
    log: RunLog, opened: Open
) -> None:
    """Both versions have the same values: every one that was sent, to the last bit."""
    sent: dict[str, list[Any]] = {}
    texts: Counter[str] = Counter()
    for key, messages in typed(log):
        for message in messages:
            for path, value in leaves(msgspec.to_builtins(message), key):
                if isinstance(value, str):
                    texts[path] += 1
                else:
                    sent.setdefault(path, []).append(value)
    assert len(sent) > 1000
    for reader in VERSIONS:
        found = opened(reader, "whole")
        assert not found.holes
        points = {
            name: [value for _, value in row]
            for name, row in found.points.items()
            if LAST not in name and not isinstance(row[0][1], str)
        }
        assert points == sent, reader.__name__
        assert set(found.words) <= set(texts)
    assert opened(opened_by_3, "whole").words == texts


def test_integers_keep_their_value_as_doubles(opened: Open) -> None:
    """PlotJuggler keeps 53 bits of an integer."""
    exact = opened(opened_by_4, "whole").points
    whole = {name for name, row in exact.items() if type(row[0][1]) is int}
    assert any(name.endswith("/session") for name in whole)
    for name in whole:
        assert all(int(float(value)) == value for _, value in exact[name]), name


@pytest.mark.parametrize("reader", VERSIONS)
def test_points_a_millisecond_apart_stay_apart_in_seconds_since_1970(
    tmp_path: Path, reader: Reader
) -> None:
    found = reader(runs.write(tmp_path, [item(seq) for seq in range(500)]))
    times = [t_s for t_s, _ in found.points[f"{STATE_KEY}/q[0]"]]
    assert len(set(times)) == 500
    assert times == sorted(times)
    # publish times; the first is before the file's first log time, which version 4 then takes
    off_s = [t_s - (OFFSET_NS + 1_000_000 * seq) * 1e-9 for seq, t_s in enumerate(times)]
    assert max(map(abs, off_s[1:])) < 1e-6
    assert abs(off_s[0]) < 2e-6


def test_what_is_cut_off_by_a_kill_needs_its_recovery(files: dict[str, Path]) -> None:
    with pytest.raises(Refused, match="no summary"):
        opened_by_3(files["cut"])
    assert set(opened_by_4(files["recovered"]).unread.values()) <= KEPT_OUT


@pytest.mark.parametrize("name", ["recorded", *MADE])
def test_the_formats_own_doctor_finds_no_error(files: dict[str, Path], name: str) -> None:
    """What it warns of is meant: see the docstrings of `mcap_log` and `scene`."""
    found = Examined(files[name])
    assert found.errors == []
    log = read_run(files[name])
    assert found.messages == sum(log.count(key) for key in log.keys())  # noqa: SIM118
    meant = {
        "profile 'xrl' is not a well-known one",
        "Schema described twice",
        "Channel described twice",
    }
    if name == "exported":
        meant.add("a message's log time is before an earlier one's")
    assert set(found.warnings) <= meant


def test_the_doctor_finds_what_is_wrong(files: dict[str, Path], tmp_path: Path) -> None:
    assert any("no Footer" in error for error in Examined(files["cut"]).errors)
    bad = tmp_path / "bad.mcap"
    data = files["every"].read_bytes()
    bad.write_bytes(data.replace(b'"title":"Wrench"', b'"title":"Wrunch"', 1))
    assert any("described in two ways" in error for error in Examined(bad).errors)


def test_the_rules_notice_what_would_be_lost(tmp_path: Path) -> None:
    """A test that could not fail would hold nothing."""
    path = tmp_path / "one.mcap"
    three = opened_by_3(write_one(path, [{"mode": "HOLD", "v": [], "w": None, "n": 1}]))
    assert three.words == {"a/b/mode": 1}
    assert three.holes == {"a/b/v": 1, "a/b/w": 1}
    assert set(three.points) == {"a/b/n"}
    long = opened_by_4(write_one(path, [{"v": list(range(600)), "text": "t" * 100, "s": "short"}]))
    assert long.cut == {"a/b/v": 100}
    assert long.words == {"a/b/text": 1}
    assert "a/b/v[499]" in long.points
    assert "a/b/v[500]" not in long.points
    assert opened_by_4(write_one(path, [{"x": 1}, {"x": 1.5}])).refused == {"a/b/x": 1}
    assert opened_by_3(write_one(path, [{"x": 1}], encoding="flatbuffer")).unread
    assert opened_by_4(write_one(path, [{"x": 1}], encoding="flatbuffer")).unread
    for reader in VERSIONS:
        strange = reader(write_one(path, [b"\x08\x01"], encoding="protobuf"))
        assert (strange.left, strange.messages) == ({"a/b": "protobuf"}, {})
    assert opened_by_4(write_one(path, [{"x": 1}], with_schema=False)).messages == {"a/b": 1}
    with pytest.raises(Refused, match="schema 0 is not there"):
        opened_by_3(path)
    for broken in (b'{"x":NaN}', b'{"x":'):
        with pytest.raises(Refused, match="no JSON"):
            opened_by_3(write_one(path, [broken]))
