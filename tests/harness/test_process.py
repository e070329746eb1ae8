from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.simulator.fronts.sensor_fronts import HarnessFront
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus import topics
from shared.bus.messages import Tare, TareRequest, Wrench
from shared.bus.session import open_session
from shared.clock import now_ns
from tests.harness.helpers import ROBOT

pytestmark = pytest.mark.system


@pytest.fixture
def run_dir() -> Iterator[Path]:
    directory = tempfile.mkdtemp(dir="/tmp")
    yield Path(directory)
    shutil.rmtree(directory)


def retared(taken: list[Wrench]) -> bool:
    """Return True once a tare has begun after a wrench was valid."""
    states = [wrench.tare for wrench in taken]
    return Tare.DONE in states and Tare.RUNNING in states[states.index(Tare.DONE) :]


def test_the_service_publishes_the_operators_wrench_tares_on_request_and_stops_on_request(
    run_dir: Path,
) -> None:
    command = [sys.executable, "-m", "services.harness", "--run-dir", str(run_dir)]
    taken: list[Wrench] = []
    with (
        UnixCanHub(run_dir / "can_harness.sock") as hub,
        open_session(ROBOT, "test", run_dir) as session,
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service,
    ):
        try:
            wrenches = session.latest(topics.WRENCH, Wrench)
            front = HarnessFront(ROBOT, hub, seed=1)
            give_up = time.monotonic() + 20.0
            requests = session.publisher(topics.HARNESS_TARE, TareRequest)
            loaded_for = 0
            while loaded_for < 100 and time.monotonic() < give_up:
                tared = bool(taken) and taken[-1].valid
                loaded_for += tared
                front.send([0.0, 0.0, 100.0 if tared else 0.0], [0.0, 0.0, 0.0])
                newest = wrenches.take()
                if newest is not None:
                    taken.append(newest)
                time.sleep(0.004)
            loaded = taken[-1]
            while not (retared(taken) and taken[-1].valid):
                assert time.monotonic() < give_up, taken[-1]
                front.send([0.0, 0.0, 100.0], [0.0, 0.0, 0.0])
                if not retared(taken):
                    requests.put(TareRequest(t_ns=now_ns(), seq=0, source="a test"))
                newest = wrenches.take()
                if newest is not None:
                    taken.append(newest)
                time.sleep(0.004)
            service.terminate()
            log = service.communicate(timeout=10.0)[1]
        finally:
            service.kill()
    assert service.returncode == 0, log
    assert "stopped:" in log
    assert not taken[0].valid
    assert loaded.force[2] == pytest.approx(100.0, abs=5.0)
    assert taken[-1].force[2] == pytest.approx(0.0, abs=5.0), "asked to, it took that for zero"
    numbers = [message.seq for message in taken]
    assert numbers == sorted(set(numbers))
