from __future__ import annotations

import contextlib
import io
from pathlib import Path

import pytest

from tests.tools.once import once
from tools import cli


@pytest.fixture(scope="session")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the record of a short run: its planner is killed, and events are in it."""

    def make(folder: Path) -> None:
        words = ["sim", "--duration", "1.5", "--kill", "planner@0.5", "--out", str(folder)]
        with contextlib.redirect_stdout(io.StringIO()):
            assert cli.main(words) == 0

    return once(tmp_path_factory, "exported", make) / "run.mcap"
