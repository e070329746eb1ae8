"""The command line on a fleet of a test's own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def xrl(*arguments: str, run_dir: Path) -> subprocess.CompletedProcess[str]:
    """Run a verb to its end on the fleet of a run directory."""
    return subprocess.run(
        [sys.executable, "-m", "tools.cli", *arguments, "--run-dir", str(run_dir)],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
