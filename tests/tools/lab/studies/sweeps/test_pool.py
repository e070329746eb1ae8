"""Work over processes and over a Dask cluster: every result, every error, no process left."""

from __future__ import annotations

import logging
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tests.tools.lab.studies.sweeps.tables import die, give_up, sleep, square, stumble, sweep
from tools.lab.studies.sweeps import pool
from tools.lab.studies.sweeps.certificate import STUDY
from tools.lab.studies.sweeps.certificate_trial import (
    CertificateCase,
    CertificateCases,
    CertificateResult,
    run_case,
)
from tools.lab.studies.sweeps.pool import Cluster
from tools.lab.studies.sweeps.table import code_digest

CODE = ("tools/lab/studies/sweeps/pool.py",)
HERE = Cluster("tcp://127.0.0.1:5", CODE)


class Inline(ModuleType):
    """A stand-in for Dask's `distributed` that runs the tasks at once, in this process."""

    def __init__(self) -> None:
        super().__init__("distributed")
        self.__spec__ = ModuleSpec("distributed", None, origin="here")
        self.closed = self.cancelled = False
        self.address = ""

    def Client(self, address: str, **options: object) -> Inline:  # noqa: N802
        assert options["set_as_default"] is False
        self.address = address
        return self

    def get_executor(self, *, pure: bool) -> Inline:
        assert not pure, "a task that is asked for again is to be run again"
        return self

    def submit(self, run: Callable[[Any], Any], task: object) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(run(task))
        except Exception as error:  # noqa: BLE001 - as an executor does
            future.set_exception(error)
        return future

    def wait_for_workers(self, count: int, timeout: float) -> None:
        assert count == 1
        assert timeout > 0.0

    def shutdown(self, *, wait: bool) -> None:
        self.cancelled = not wait

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def dask(monkeypatch: pytest.MonkeyPatch) -> Inline:
    module = Inline()
    monkeypatch.setitem(sys.modules, "distributed", module)
    return module


@pytest.mark.parametrize("workers", [2, Cluster("dask://127.0.0.1:5", CODE)])
def test_every_task_comes_back_with_its_result(workers: int | Cluster, dask: Inline) -> None:
    assert dict(pool.results(square, range(10), workers, str)) == {n: n * n for n in range(10)}
    if isinstance(workers, Cluster):
        assert dask.address == "tcp://127.0.0.1:5"
        assert dask.closed


@pytest.mark.parametrize("workers", [2, HERE])
def test_an_error_is_one_line_names_its_task_and_ends_the_rest(
    workers: int | Cluster, dask: Inline
) -> None:
    with pytest.raises(RunError) as caught:
        list(pool.results(stumble, range(4), workers, lambda n: f"case {n}"))
    assert str(caught.value) == "case 2: ValueError: two lines"
    assert multiprocessing.active_children() == []
    assert dask.cancelled is dask.closed is isinstance(workers, Cluster)


def test_a_killed_worker_is_an_error_and_no_wait() -> None:
    with pytest.raises(RunError, match="fewer --workers"):
        list(pool.results(die, [1, 2], 2, str))


def test_a_loop_left_early_leaves_no_worker() -> None:
    done = pool.results(sleep, [0.0, 60.0], 2, str)
    next(done)
    begin = time.monotonic()
    done.close()  # type: ignore[attr-defined]  # a generator
    assert time.monotonic() - begin < 30.0
    assert multiprocessing.active_children() == []


def test_without_dask_the_extra_that_brings_it_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    flags = ("--n", 1, "--cluster", "tcp://127.0.0.1:1", "--out", tmp_path)
    assert sweep("latency", *flags) == 2
    output = capsys.readouterr().err
    assert "extra `cluster`" in output
    assert output.count("\n") == 1


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "http://127.0.0.1:1", "tcp://nowhere"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(RunError, match="tcp://HOST:PORT"):
        list(pool.results(abs, [1], Cluster(address, ()), str))


def test_a_worker_of_other_code_is_refused() -> None:
    assert pool.checked(3, square, CODE, code_digest(CODE)) == 9
    with pytest.raises(RunError, match="other code"):
        pool.checked(3, square, CODE, "another digest")


def test_a_lost_scheduler_is_reported_in_one_line(dask: Inline) -> None:
    with pytest.raises(RunError) as caught:
        list(pool.results(give_up, [1], HERE, str))
    assert str(caught.value) == "--cluster tcp://127.0.0.1:5: connection to the scheduler lost"
    assert dask.closed


def test_dask_logs_nothing_into_a_study(dask: Inline, caplog: pytest.LogCaptureFixture) -> None:
    logger = logging.getLogger("distributed.client")
    logger.setLevel(logging.WARNING)

    def work(number: int) -> int:
        logger.error("Traceback ...")
        return number

    assert list(pool.results(work, [1], HERE, str)) == [(1, 1)]
    assert dask.closed
    assert caplog.records == []
    assert logger.level == logging.WARNING


def run_task(task: tuple[CertificateCase, RobotConfig]) -> CertificateResult:
    return run_case(*task)


def test_a_case_on_a_real_cluster_is_the_case_of_this_machine(robot: RobotConfig) -> None:
    """In a process of its own, as a worker is."""
    distributed = pytest.importorskip("distributed")
    task = CertificateCases(robot).draw(1, 0), robot
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
        protocol="tcp://",
    ) as local:
        cluster = Cluster(local.scheduler_address, STUDY.code)
        ((_, figures),) = pool.results(run_task, [task], cluster, lambda _task: "the case")
    assert figures == run_task(task)
