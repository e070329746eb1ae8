"""The process of a sensor's service: cycles on a grid, and both services on a real bus."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from services.simulator.fronts.sensor_fronts import HarnessFront
from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus import topics
from shared.bus.messages import Attitude, Tare, TareRequest, Wrench
from shared.bus.session import open_session
from shared.can import imu_can, sensor_service
from shared.can.sensor_service import next_deadline, run
from shared.clock import now_ns
from shared.config.files import load, to_toml
from shared.config.gain_schedule import path_beside, write
from shared.config.robot_config import RobotConfig
from shared.run_directory import make_live_dir
from tests.imu.robots import with_imu

T0 = 10**12


@pytest.mark.parametrize(
    ("late_ns", "next_ns", "missed"),
    [(-1, 1000, 0), (0, 1000, 0), (999, 1000, 0), (1000, 2000, 1), (1001, 2000, 1),
     (7500, 8000, 7)],
)  # fmt: skip
def test_missed_deadlines_are_skipped_and_the_grid_is_kept(
    late_ns: int, next_ns: int, missed: int
) -> None:
    assert next_deadline(T0, 1000, T0 + late_ns) == (T0 + next_ns, missed)


def test_a_long_cycle_is_followed_by_one_cycle_and_not_by_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    period_ns, clock, times = 4_000_000, [T0], list[int]()

    class SlowOnce:
        skipped = 0

        def cycle(self, at_ns: int) -> None:
            times.append(at_ns)
            clock[0] += (10 * period_ns + 1) * (len(times) == 4)

    class StopAfterSix:
        def __bool__(self) -> bool:
            return len(times) >= 6

    def sleep_until(deadline_ns: int) -> None:
        clock[0] = max(clock[0], deadline_ns)

    monkeypatch.setattr(sensor_service, "now_ns", lambda: clock[0])
    monkeypatch.setattr(sensor_service, "sleep_until", sleep_until)
    loop = SlowOnce()
    run(cast("Any", loop), 250.0, cast("Any", StopAfterSix()))
    assert [(t_ns - T0) // period_ns for t_ns in times] == [0, 1, 2, 3, 14, 15]
    assert loop.skipped == 10


@contextlib.contextmanager
def serving(name: str, *words: str) -> Iterator[None]:
    """Run a service, and see that it stops when it is asked to."""
    command = [sys.executable, "-m", f"services.{name}", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
        try:
            yield
            service.terminate()
            log = service.communicate(timeout=10.0)[1]
        finally:
            service.kill()
    assert service.returncode == 0, log
    assert "stopped:" in log


def retared(taken: list[Wrench]) -> bool:
    """Return True once a tare has begun after a wrench was valid."""
    states = [wrench.tare for wrench in taken]
    return Tare.DONE in states and Tare.RUNNING in states[states.index(Tare.DONE) :]


@pytest.mark.system
def test_the_harness_publishes_the_operators_wrench_and_tares_on_request(
    robot: RobotConfig, short_dir: Path
) -> None:
    taken: list[Wrench] = []
    with (
        UnixCanHub(make_live_dir(short_dir) / "can_harness.sock") as hub,
        open_session(robot, "test", short_dir) as session,
        serving("harness", "--run-dir", str(short_dir)),
    ):
        wrenches = session.latest(topics.WRENCH, Wrench)
        requests = session.publisher(topics.HARNESS_TARE, TareRequest)
        front, give_up, loaded_for = HarnessFront(robot, hub, seed=1), time.monotonic() + 20.0, 0

        def feel(force: float) -> None:
            front.send([0.0, 0.0, force], [0.0, 0.0, 0.0])
            taken.extend(filter(None, [wrenches.take()]))
            time.sleep(0.004)

        while loaded_for < 100 and time.monotonic() < give_up:
            tared = bool(taken) and taken[-1].valid
            loaded_for += tared
            feel(100.0 * tared)
        loaded = taken[-1]
        while not (retared(taken) and taken[-1].valid):
            assert time.monotonic() < give_up, taken[-1]
            if not retared(taken):
                requests.put(TareRequest(t_ns=now_ns(), seq=0, source="a test"))
            feel(100.0)
    assert not taken[0].valid
    assert loaded.force[2] == pytest.approx(100.0, abs=5.0)
    assert taken[-1].force[2] == pytest.approx(0.0, abs=5.0), "asked to, it took that for zero"
    numbers = [message.seq for message in taken]
    assert numbers == sorted(set(numbers))


@pytest.mark.system
def test_the_imu_publishes_which_way_is_up_and_invalid_once_the_sensor_is_silent(
    robot: RobotConfig, short_dir: Path
) -> None:
    fitted, file = with_imu(robot), short_dir / "robot.toml"
    file.write_text(to_toml(fitted), encoding="utf-8")
    assert fitted.gain_schedule is not None
    write(path_beside(file), fitted.gain_schedule)
    tilted = (math.cos(0.05), math.sin(0.05), 0.0, 0.0)
    taken: list[Attitude] = []
    with (
        UnixCanHub(make_live_dir(short_dir) / "can_imu.sock") as hub,
        open_session(load(file), "test", short_dir) as session,
        serving("imu", "--config", str(file), "--run-dir", str(short_dir)),
    ):
        attitudes, give_up = session.latest(topics.ATTITUDE, Attitude), time.monotonic() + 20.0

        def look() -> bool:
            assert time.monotonic() < give_up
            taken.extend(filter(None, [attitudes.take()]))
            time.sleep(0.01)
            return bool(taken) and taken[-1].valid

        while not look():
            hub.poll()
            hub.broadcast(imu_can.pack(tilted, (0.0, 0.0, 0.0), valid=True))
        attitude = taken[-1]
        while look():
            pass
    assert attitude.up == pytest.approx((0.0, math.sin(0.1), math.cos(0.1)), abs=1e-3)
    assert taken[-1].up == attitude.up, "the last good one"
