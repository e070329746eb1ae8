"""`xrl view` as a process: it prints its address, serves, and ends with Ctrl-C."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from shared.places import CHECKOUT
from tests.tools.exit_codes import exit_code
from tests.tools.view.test_record_source import LOG
from tools import cli


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_record_is_served_until_it_is_interrupted(number: signal.Signals) -> None:
    command = [sys.executable, "-m", "tools.cli", "view", str(LOG), "--port", "0"]
    with subprocess.Popen(
        command, cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            found = re.match(r"(http://127\.0\.0\.1:\d+/\S+/)", process.stdout.readline())
            assert found is not None
            with urllib.request.urlopen(found[1], timeout=20) as page:  # noqa: S310 - its own
                assert b"<title>XRL</title>" in page.read()
            process.send_signal(number)
            _, error = process.communicate(timeout=20)
        finally:
            process.kill()
    assert (process.returncode, error) == (0, "")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no-such-file.mcap"], "no-such-file.mcap"),
        (["--port", "70000", "--sim"], "at most 65535"),
        ([str(LOG), "--sim"], "do not go together"),
        ([str(LOG), "--act"], "--act is for the fleet that is up"),
        (["--html", "run.html"], "--html is for a record"),
        (["--sim", "--act"], "--act is for the fleet that is up"),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert exit_code(["view", *words, "--run-dir", str(tmp_path / "r")]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_without_a_fleet_it_says_how_to_start_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main(["view", "--run-dir", str(tmp_path / "r")]) == 2
    assert "`xrl up` starts one" in capsys.readouterr().err
