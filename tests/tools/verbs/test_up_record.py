"""`xrl up`: a folder for the record that cannot be made."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.exceptions import RunError
from tools.verbs import up


def test_where_nobody_looks_on_a_robot_starts_without_its_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "out"
    taken.write_text("a file", encoding="utf-8")
    up._make_record_folder(taken / "now", must=False)
    assert "not recorded: " in capsys.readouterr().err
    with pytest.raises(RunError, match="cannot be made"):
        up._make_record_folder(taken / "now", must=True)
