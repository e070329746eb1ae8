"""A CAN driver on an emulated drive (`rig`), and on buses that the test writes (`bench`)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.joint.drivers.odrive_can import OdriveCan
from tests.joint.drivers.can_bench import Bench
from tests.joint.drivers.rig import Rig, connected


@pytest.fixture
def path() -> Iterator[Path]:
    """Return a socket path short enough for the kernel."""
    directory = Path(tempfile.mkdtemp(dir="/tmp"))
    yield directory / "can.sock"
    shutil.rmtree(directory)


@pytest.fixture
def rig(path: Path) -> Iterator[Rig]:
    """Return an emulated drive on a bus."""
    rig = Rig(path)
    yield rig
    rig.hub.close()


@pytest.fixture
def driver(rig: Rig, path: Path) -> Iterator[OdriveCan]:
    """Return a driver that has found the rig's drive."""
    driver = connected(rig, path)
    yield driver
    driver.close()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Return a driver on a bus whose every frame the test writes."""
    bench = Bench(monkeypatch)
    yield bench
    bench.driver.close()
    assert all(bus.closed == 1 for bus in bench.buses)
