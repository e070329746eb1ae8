"""Studies on a Dask cluster: what is refused, and that each task comes back with its result."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from concurrent.futures import CancelledError
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools import cli
from tools.lab.studies.sweeps import cluster, latency
from tools.lab.studies.sweeps.latency import JOB
from tools.lab.studies.sweeps.latency_trial import LatencyTrial, Network
from tools.lab.studies.sweeps.table import code_digest

CODE = ("tools/lab/studies/sweeps/pool.py",)


def test_without_dask_the_extra_that_brings_it_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    flags = ("--cluster", "tcp://127.0.0.1:1", "--out", str(tmp_path))
    assert cli.main(["study", "sweep", "latency", "--trials", "1", *flags]) == 2
    output = capsys.readouterr().err
    assert "extra `cluster`" in output
    assert output.count("\n") == 1


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "http://127.0.0.1:1", "tcp://nowhere"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(RunError, match="tcp://HOST:PORT"):
        list(cluster.results(abs, [1], address, str, ()))


class Inline(ModuleType):
    """A stand-in for Dask's `distributed` that runs the tasks at once, in this process."""

    def __init__(self) -> None:
        super().__init__("distributed")
        self.__spec__ = ModuleSpec("distributed", None, origin="here")
        self.closed = self.cancelled = False
        self.address = ""
        self.loop = object()

    def Client(self, address: str, **_options: object) -> Inline:  # noqa: N802
        self.address = address
        return self

    def map(
        self, run: Any, tasks: Sequence[int], pure: bool, **options: Any
    ) -> list[SimpleNamespace]:
        assert not pure, "a task that is asked for again is to be run again"
        return [
            SimpleNamespace(key=str(i), result=lambda task=task: run(task, **options))
            for i, task in enumerate(tasks)
        ]

    def as_completed(self, futures: list[Any], loop: object) -> list[Any]:
        assert loop is self.loop, "no client is the default one"
        return futures[::-1]

    def wait_for_workers(self, count: int, timeout: float) -> None:
        assert count == 1
        assert timeout > 0.0

    def cancel(self, _futures: list[Any]) -> None:
        self.cancelled = True

    def close(self) -> None:
        self.closed = True


def stumble(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return -number


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> Inline:
    module = Inline()
    monkeypatch.setitem(sys.modules, "distributed", module)
    return module


def test_each_task_of_a_cluster_comes_back_with_its_result(dask: Inline) -> None:
    found = dict(cluster.results(stumble, [0, 1, 3], "dask://127.0.0.1:5", str, CODE))
    assert found == {0: 0, 1: -1, 3: -3}
    assert dask.address == "tcp://127.0.0.1:5"
    assert dask.closed


def test_an_error_on_a_cluster_names_its_task_and_cancels_the_rest(dask: Inline) -> None:
    with pytest.raises(RunError, match="case 2: ValueError: two"):
        list(cluster.results(stumble, [2, 3][::-1], "tcp://127.0.0.1:5", lambda n: f"case {n}", ()))
    assert dask.cancelled
    assert dask.closed


def test_a_worker_of_other_code_is_refused() -> None:
    assert cluster.checked(3, stumble, CODE, code_digest(CODE)) == -3
    with pytest.raises(RunError, match="other code"):
        cluster.checked(3, stumble, CODE, "another digest")


def give_up(_number: int) -> int:
    raise CancelledError("scheduler-connection-lost.\nClient lost the connection.")


def test_a_lost_scheduler_is_reported_in_one_line(dask: Inline) -> None:
    with pytest.raises(RunError) as caught:
        list(cluster.results(give_up, [1], "tcp://127.0.0.1:5", str, ()))
    assert str(caught.value) == "--cluster tcp://127.0.0.1:5: connection to the scheduler lost"
    assert dask.closed


def test_dask_logs_nothing_into_a_study(dask: Inline, caplog: pytest.LogCaptureFixture) -> None:
    logger = logging.getLogger("distributed.client")
    logger.setLevel(logging.WARNING)

    def work(number: int) -> int:
        logger.error("Traceback ...")
        return number

    assert list(cluster.results(work, [1], "tcp://127.0.0.1:5", str, CODE)) == [(1, 1)]
    assert dask.closed
    assert caplog.records == []
    assert logger.level == logging.WARNING


def test_a_trial_on_a_real_cluster_is_the_trial_of_this_machine(robot: RobotConfig) -> None:
    """In a process of its own, as a worker is; it falls early, and so takes no time."""
    distributed = pytest.importorskip("distributed")
    network = Network(200.0, 0.0, 0.0)
    trial = LatencyTrial(number=0, repeat=0, seed=1, control="centralised", network=network)
    task = trial, robot
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
        protocol="tcp://",
    ) as local:
        address = local.scheduler_address
        found = list(cluster.results(JOB.work, [task], address, JOB.name, latency.CODE))
    assert found == [(task, JOB.work(task))]
    assert found[0][1].ending == "fell"
