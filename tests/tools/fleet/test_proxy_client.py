"""What is said where no network proxy answers: why not, and the way out."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared.exceptions import FleetError
from shared.places import DEFAULT_CONFIG
from tools.fleet.process_table import TABLE, make_plan
from tools.fleet.proxy_client import ProxyClient
from tools.fleet.run_dir import RunDir


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as parent:
        yield Path(parent)


def pretend_up(run_dir: Path, *, injected: bool) -> None:
    plan = make_plan(
        DEFAULT_CONFIG, run_dir, overrides={}, services=None, simulation=True,
        injected=injected, table_path=TABLE,
    )  # fmt: skip
    folder = RunDir(run_dir)
    folder.prepare(plan)
    folder.supervisor_socket.touch()


def test_without_a_fleet_it_names_how_to_start_one(run_dir: Path) -> None:
    with pytest.raises(FleetError, match=r"no fleet is up in .*; `xrl up --injectable` starts one"):
        ProxyClient(run_dir).list()


def test_a_fleet_without_injector_has_to_go_down_first(run_dir: Path) -> None:
    pretend_up(run_dir, injected=False)
    with pytest.raises(FleetError, match="without a network proxy; `xrl down`, then"):
        ProxyClient(run_dir).list()


def test_an_injector_that_is_down_is_reported_with_the_impairments_that_ended(
    run_dir: Path,
) -> None:
    pretend_up(run_dir, injected=True)
    with pytest.raises(FleetError, match="every impairment is over; `xrl status`"):
        ProxyClient(run_dir).list()
