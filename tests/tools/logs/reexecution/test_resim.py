"""A run's services executed again: every tick equal, and a changed parameter seen."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.bus.topics import Topic
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, Kill, Restart
from shared.exceptions import FAULT_EXIT_CODE
from shared.joints import MODULES
from shared.mcap_log import provenance
from shared.rounding import POSITION
from tests.imu.robots import with_imu
from tests.lockstep.runs import still
from tests.shared.mcap_log.runs import recorded_in_parts, state
from tests.tools.exit_codes import exit_code
from tests.tools.logs.reexecution.executions import edited, executed
from tools import cli
from tools.logs.reexecution import execution
from tools.logs.reexecution.compare import ReexecutionResult
from tools.logs.reexecution.execution import RangeTask, execute_range, merged, ranges_of
from tools.logs.reexecution.params import with_params
from tools.logs.run_log import WHOLE, RunLog, RunPart, parts_of, read_run
from tools.sim.recorded_lockstep import simulate
from tools.verbs.log import resim


@pytest.fixture(scope="module")
def recorded(robot: RobotConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a run with a dead planner, a dead joint service and a fault in it, on a slope."""
    scenario = still(
        4.1,  # the planner compares the phases of the six a second time after 3 s of leading
        height=1.1,
        kill=(Kill(service="planner", at=0.2), Kill(service="knee_left", at=1.4)),
        restart=(Restart(service="planner", at=0.6), Restart(service="knee_left", at=1.501)),
        fault=(Fault(module="hip_right", kind="link_lost", at=3.3),),
    )
    folder = tmp_path_factory.mktemp("resim")
    simulate(
        with_imu(robot),
        scenario,
        Impairment(delay_ms=1.0, jitter_ms=0.5),
        3,
        folder,
        true_plant=changed(PlantConfig(), {"floor.slope": [0.03, -0.02]}),
    )
    return folder / "run.mcap"


@pytest.fixture(scope="module")
def log(recorded: Path) -> RunLog:
    return read_run(recorded)


@pytest.fixture(scope="module")
def whole(log: RunLog) -> Callable[[str], ReexecutionResult]:
    """Return what comes of a service over the whole run; each is executed once."""
    return functools.cache(lambda name: executed(log, name))


@pytest.mark.parametrize("name", ["planner", "knee_left"])
def test_a_run_read_in_parts_is_executed_like_the_whole(
    log: RunLog, whole: Callable[[str], ReexecutionResult], name: str
) -> None:
    outcome = executed(log, name, parts=parts_of(log.index, part_s=0.7))
    assert outcome.comparison.first is None
    assert (outcome.ticks, outcome.skipped, outcome.starts) == (
        whole(name).ticks, whole(name).skipped, whole(name).starts,
    )  # fmt: skip


def test_ranges_side_by_side_execute_every_tick_once_as_one_after_the_other(
    log: RunLog, whole: Callable[[str], ReexecutionResult]
) -> None:
    """Each begins at a memory before it: what begins at a dead planner finds the next one's."""
    names = ("planner", "knee_left")

    def tasks(range_s: float) -> list[RangeTask]:
        return ranges_of(log.index, RangeTask(log.index.path, WHOLE, names), 4, range_s)

    assert [len(tasks(range_s)) for range_s in (1.3, 3.0, 60.0)] == [8, 4, 1], "for each worker"
    found = merged([pickle.loads(pickle.dumps(execute_range(task))) for task in tasks(3.0)])  # noqa: S301
    for outcome, name in zip(found, names, strict=True):
        assert outcome.comparison.first is None
        assert outcome.ticks == whole(name).ticks
        assert outcome.skipped == whole(name).skipped
        assert outcome.lost_inputs == 0
        assert outcome.comparison.compared == whole(name).comparison.compared


def test_the_first_difference_is_that_of_the_first_range_that_has_one() -> None:
    parts = [ReexecutionResult("planner", 0.0, exact=True) for _ in range(3)]
    for part, q in zip(parts[1:], (0.2, 0.7), strict=True):
        recorded = msgspec.structs.replace(state(1), q=(0.1, 0.0))
        part.comparison.take("x", 7, recorded, msgspec.structs.replace(recorded, q=(q, 0.0)))
        part.ticks = 5
    (whole,) = merged([[part] for part in parts])
    assert whole.comparison.first is not None
    assert whole.comparison.first.recomputed == 0.2
    (largest,) = whole.comparison.largest.values()
    assert largest.recomputed == 0.7
    assert (whole.ticks, whole.comparison.differing) == (10, 2)


def test_a_part_of_a_run_is_executed_from_its_first_memory_on(log: RunLog) -> None:
    part = RunLog(log.index, RunPart(3.0, 5.0), margin_s=1.0)
    outcome = executed(log, "planner", parts=[part])
    assert outcome.comparison.first is None
    assert outcome.ticks > 100
    assert outcome.lost_inputs == 0


@pytest.mark.parametrize("name", resim.SERVICES)
def test_every_tick_of_a_run_with_restarts_holds_and_a_fault_is_equal_bit_for_bit(
    whole: Callable[[str], ReexecutionResult], name: str
) -> None:
    outcome = whole(name)
    assert outcome.comparison.first is None
    assert outcome.ticks > 900
    assert outcome.lost_inputs == 0
    assert outcome.skipped <= 4  # before the first memory of each planner
    restarted = name in ("planner", "knee_left")
    assert outcome.starts == (2 if restarted else 1)
    assert outcome.comparison.compared > outcome.ticks // 3


def test_in_the_record_a_service_began_out_of_step_and_was_brought_into_it(log: RunLog) -> None:
    phases = [row.state_phase for row in log.messages(topics.JOINT_COMMAND, "knee_left")]
    assert (phases[0], phases[-1]) == (0, 1)


def test_the_planner_of_the_record_knew_the_slope(log: RunLog) -> None:
    assert log.messages(topics.PLANNER_STATUS)[-1].slope == pytest.approx((0.03, -0.02), abs=0.02)


def test_the_last_digit_of_one_recorded_number_is_found_where_it_was_taken(log: RunLog) -> None:
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    old = statuses[len(statuses) // 2]
    commands = list(old.commands)
    a, b = commands[5].q_ref
    commands[5] = msgspec.structs.replace(commands[5], q_ref=(a, b + 10.0**-POSITION))
    new = msgspec.structs.replace(old, commands=tuple(commands))
    bent = edited(log, topics.PLANNER_STATUS, "", lambda row: new if row is old else row)
    first = executed(bent, "hip_left").comparison.first
    assert first is not None
    assert old.t_ns <= first.t_ns <= old.t_ns + 200_000_000


@pytest.mark.parametrize(
    ("topic", "module", "taken_by"),
    [
        (topics.ATTITUDE, "", lambda status: status.attitude_seq),
        (topics.JOINT_STATE, MODULES[3], lambda status: status.state_seq[3]),
    ],
    ids=["attitude", "state"],
)
def test_an_input_missing_in_the_log_is_reported_and_execution_resumes_at_the_next_snapshot(
    log: RunLog, topic: Topic, module: str, taken_by: Callable[[PlannerStatus], int]
) -> None:
    statuses = log.messages(topics.PLANNER_STATUS)
    second = [status for status in statuses if status.session != statuses[0].session]
    taken = taken_by(second[300])
    begin_s, lost_s = ((row.t_ns - log.began_ns()) / 1e9 for row in (second[0], second[300]))
    part = RunLog(log.index, RunPart(begin_s, lost_s + 1.5), margin_s=1.0)
    lacking = edited(part, topic, module, lambda row: row if row.seq != taken else None)
    outcome = executed(lacking, "planner")
    assert outcome.lost_inputs == 1
    assert outcome.starts == 2
    assert 0 < outcome.skipped < 300
    assert outcome.comparison.first is None


def test_a_trace_that_the_log_lacks_does_not_let_the_service_go_on_from_a_guess(
    log: RunLog,
) -> None:
    lost = log.messages(topics.JOINT_TRACE, "ankle_left")[70]
    lacking = edited(
        log, topics.JOINT_TRACE, "ankle_left", lambda row: None if row is lost else row
    )
    outcome = executed(lacking, "ankle_left")
    assert outcome.starts == 2
    assert outcome.comparison.first is None


def test_a_difference_is_told_with_its_likely_reason_and_none_without(
    recorded: Path,
    robot: RobotConfig,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    versions = provenance.packages()
    reason = f"numpy {versions['numpy']}, here 0.1"
    words = ["log", "resim", str(recorded), "--service", "planner"]
    words += ["--from", "-1.2", "--to", "0.3"]
    monkeypatch.setattr(provenance, "packages", lambda: versions | {"numpy": "0.1"})
    assert exit_code(words) == 0
    assert reason not in capsys.readouterr().out
    other = with_params(with_imu(robot), ["law.K_p.x=2000"], "")
    monkeypatch.setattr(execution, "robot_of", lambda _log: other)
    assert exit_code(words) == FAULT_EXIT_CODE
    assert reason in capsys.readouterr().out


def test_a_run_reports_how_many_of_its_cycles_were_traced(log: RunLog) -> None:
    for module in MODULES:
        cycles = sum(len(trace.cycles) for trace in log.messages(topics.JOINT_TRACE, module))
        counts = [state.cycle for state in log.messages(topics.JOINT_STATE, module)]
        lives = [before for before, after in pairwise([*counts, 0]) if after < before]
        assert cycles >= sum(lives) - 20 * 2


# ---- the same run, split while it was recorded


@pytest.fixture(scope="module")
def directory(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_in_parts(read_run(recorded), tmp_path_factory.mktemp("split"))


def test_the_directory_of_a_split_run_is_the_run(log: RunLog, directory: Path) -> None:
    whole, log = log, read_run(directory)
    assert [path.name for path in log.files] == ["run.mcap", "run_1.mcap", "run_2.mcap"]
    assert (log.complete, log.damage, log.attachments) == (True, [], whole.attachments)
    assert {key: log.raw(key) for key in log.keys()} == {  # noqa: SIM118
        key: whole.raw(key)
        for key in whole.keys()  # noqa: SIM118
    }
    assert log.began_ns() == whole.began_ns()


def test_one_file_of_a_split_run_stands_for_itself(directory: Path) -> None:
    outcome = executed(read_run(directory / "run_1.mcap"), "ankle_left")
    assert outcome.comparison.first is None
    assert outcome.ticks > 0


def test_a_changed_gain_changes_what_comes_out_and_is_listed(
    directory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["log", "resim", str(directory), "--service", "planner", "--param", "law.K_p.x=2000"]
    assert cli.main(words) == 0
    text = capsys.readouterr().out
    assert "planner, first at" in text
    assert "largest changes" in text
    assert "joint/ankle_left/command" in text
