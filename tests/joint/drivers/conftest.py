"""A CAN driver on an emulated drive (`rig`), and on buses that the test writes (`bench`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from services.joint.drivers.odrive_can import OdriveCan
from tests.joint.drivers.can_bench import Bench
from tests.joint.drivers.rig import Rig, Shed


@pytest.fixture
def shed(short_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shed]:
    """Return what makes emulated drives and drivers."""
    shed = Shed(short_dir / "can.sock", monkeypatch)
    yield shed
    shed.close()


@pytest.fixture
def rig(shed: Shed) -> Rig:
    """Return an emulated drive on a bus."""
    return shed.rig()


@pytest.fixture
def driver(rig: Rig, shed: Shed) -> OdriveCan:
    """Return a driver that has found the rig's drive."""
    return shed.connected(rig)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Return a driver on a bus whose every frame the test writes."""
    bench = Bench(monkeypatch)
    yield bench
    bench.driver.close()
    assert all(bus.closed == 1 for bus in bench.buses)
