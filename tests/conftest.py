from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, settings

from shared.config import files as config_file
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.run_directory import live_dir

# A shell without job control starts its background with SIGINT ignored, and every program that a
# test starts would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no failed claim: no time limit for one example.
settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")
# A mutant is to fail, no matter by which example.
settings.register_profile(
    "mutants",
    deadline=None,
    database=None,
    derandomize=True,
    phases=(Phase.explicit, Phase.generate),
)

SLOWEST = (
    "test_study.py", "test_assist.py", "test_estop.py",
    "test_uneven.py", "test_split_program.py", "test_dead_services.py", "test_faults.py",
    "test_squat.py", "test_sim.py", "test_run_log.py", "test_certificate.py",
    "test_robust.py", "test_actuation.py", "test_sampled_loop.py",
)  # fmt: skip
"""Files begun with, so that none of them is left to one core in the end."""

ROBOT_FILE = Path(__file__).parents[1] / "deploy" / "robot.toml"


@pytest.fixture
def short_dir() -> Iterator[Path]:
    """Return a folder whose path is short: sockets are in it."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as path:
        yield Path(path)
        remove_live_dirs(Path(path))


@pytest.fixture(autouse=True, scope="session")
def _nothing_left_in_memory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    yield
    remove_live_dirs(tmp_path_factory.getbasetemp())


def remove_live_dirs(root: Path) -> None:
    """Remove the live directories of all run directories below a folder."""
    for folder, _, _ in os.walk(root):
        if (live := live_dir(Path(folder))) != Path(folder):
            shutil.rmtree(live, ignore_errors=True)


@pytest.fixture
def run_dir(short_dir: Path) -> Path:
    """Return where a fleet may run."""
    return short_dir / "r"


def pytest_sessionstart() -> None:
    """Forget what is made once in a process: mutants are tried in forks of one that ran tests."""
    made: Any = sys.modules.get("services.planner.law.certificate")
    if made is not None:
        made._graph.cache_clear()


def pytest_collection_finish() -> None:
    """Spare the collector a million objects that stay."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slowest files, the order within a file stays; mark what is wide.

    Raises:
        UsageError: a file does not say itself that its tests are `system`; see `tools.dev.checks`.
    """
    for path in {item.path for item in items if item.get_closest_marker("system")}:
        if "pytest.mark.system" not in path.read_text("utf-8"):
            raise pytest.UsageError(f"{path} has tests marked system, and no pytest.mark.system")
    met: Counter[str] = Counter()
    for item in items:
        mark = item.get_closest_marker("sampled")
        if mark is not None:
            claim = item.nodeid.partition("[")[0]
            if met[claim] % mark.args[0]:
                item.add_marker(pytest.mark.wide)
            met[claim] += 1
    place = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(SLOWEST)))


@pytest.fixture(scope="session")
def robot() -> RobotConfig:
    """Return the shipped robot; it is frozen, so every test may share it."""
    return config_file.load(ROBOT_FILE)


@pytest.fixture(scope="session")
def schedule(robot: RobotConfig) -> GainSchedule:
    """Return its gain schedule."""
    assert robot.gain_schedule is not None
    return robot.gain_schedule
