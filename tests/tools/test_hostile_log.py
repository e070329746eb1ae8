"""A log that a stranger made: what it holds is data to every verb, to a terminal and to a page."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

import pytest

from shared.exceptions import RunError
from tests.tools.exit_codes import exit_code
from tests.tools.logs.reexecution.test_golden import GOLDEN
from tests.tools.test_bad_input import made_up
from tools.judge import verdict
from tools.logs.run_log import read_run

SCRIPT: Final = "<script>alert(1)</script>"
HOSTILE: Final = f'[/b][bold red][link=x]\x1b]0;owned\x07\x1b[2J\x9b31m\u202e\r\nSTOOD {SCRIPT}&"'
"""Rich's tags, a window's title, a cleared screen, C1, a turned and a forged line, a script."""
CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]")

RECORDS: Final = {
    "run": ("scenario", "lockstep", "cpu_model", "started", "thread_env", "git_commit",
            "git_dirty", "python", "platform", "cpu_count", HOSTILE),
    "clock": ("rule",),
    "split": ("run", "number", "snapshot"),
    "recorder": ("flush_ms",),
    "recovered": ("from",),
    "packages": ("xrl", HOSTILE),
    HOSTILE: (HOSTILE,),
}  # fmt: skip
"""Metadata that a verb prints."""
REQUIRED: Final = (
    ("run", "robot"), ("run", "schema_version"), ("run", "pace"), ("run", "of"),
    ("clock", "offset_ns"), ("lockstep", "seed"),
)  # fmt: skip
"""Metadata that a verb computes with."""
VERBS: Final = (
    ("log info",), ("log info", "--full"), ("log info", "--json"), ("log explain",),
    ("log report", "--open", "no"),
    ("log resim", "--service", "knee_left"), ("log recover", "--force"),
    ("log export", "--csv", "csv"), ("log export", "--ros2bag", "bag"),
    ("view", "--html", "view.html"),
    ("log play", "--rate", "100", "--duration", "0.1"),
)  # fmt: skip


def with_hostile_words(_key: str, t_ns: int, data: bytes) -> tuple[int, bytes]:
    """Replace each text of a message, but for the snapshots, which are read again."""

    def changed(value: Any) -> Any:
        if isinstance(value, str):
            return HOSTILE if len(value) < 200 else value
        if isinstance(value, list):
            return [changed(part) for part in value]
        if isinstance(value, dict):
            return {name: changed(part) for name, part in value.items()}
        return value

    return t_ns, json.dumps(changed(json.loads(data))).encode()


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> str:
    robot = read_run(GOLDEN).robot
    return made_up(
        tmp_path_factory.mktemp("hostile") / "run.mcap",
        {name: dict.fromkeys(fields, HOSTILE) for name, fields in RECORDS.items()},
        {HOSTILE: b"x", f"{HOSTILE}.toml": HOSTILE.encode()},
        with_hostile_words,
        [HOSTILE, f"xrl/{robot}/{HOSTILE}", f"xrl/{robot}/joint/{HOSTILE}/state"],
        most=200,
    )


def assert_harmless(
    words: list[str], codes: tuple[int, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(words) in codes
    said = "".join(capsys.readouterr())
    assert not CONTROL.search(said), CONTROL.findall(said)
    assert "Traceback" not in said


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_nothing_of_a_hostile_log_is_obeyed(
    words: tuple[str, ...], hostile: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    codes = (0, 2, 3) if words[0] == "log resim" else (0, 2)  # 3: another output than recorded
    assert_harmless([*words[0].split(), hostile, *words[1:]], codes, capsys)
    for page in (*tmp_path.glob("*.html"), *Path(hostile).parent.glob("*.html")):
        assert SCRIPT not in page.read_text(encoding="utf-8")
        page.unlink()


@pytest.mark.parametrize("value", [HOSTILE, "", "nan", "-1", "9" * 400])
@pytest.mark.parametrize(("record", "field"), REQUIRED)
def test_metadata_that_is_computed_with_is_checked(
    record: str, field: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made_up(tmp_path / "run.mcap", {record: {field: value}}, most=20)
    for verb in (["log info"], ["log report", "--open", "no"]):
        assert_harmless([*verb[0].split(), path, *verb[1:]], (0, 2), capsys)


@pytest.mark.parametrize("value", ["fast", "nan", "0", "1e400"])
def test_a_pace_that_is_none_is_told(value: str, tmp_path: Path) -> None:
    log = read_run(Path(made_up(tmp_path / "run.mcap", {"run": {"pace": value}}, most=1)))
    with pytest.raises(RunError, match=f"run.pace is {value!r}; it must be above 0"):
        verdict._pace(log)
