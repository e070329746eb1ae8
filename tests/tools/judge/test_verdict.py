"""A verdict that sees: what it is to stand, how soundly a robot stood; and the run's picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL
from services.simulator.physics.world import World
from shared.bus.messages import JointEvent, Mode
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.lockstep.runs import still
from tests.messages import sample
from tests.shared.mcap_log.runs import recorded_in_parts
from tools import cli
from tools.judge import figure, verdict, verdict_table
from tools.judge.standing import (
    LIMITS,
    SOUND,
    Soundness,
    _longest_s,
    _overforce_s,
    shaking_of,
    why_not_sound,
    why_not_standing,
)
from tools.judge.verdict import Percentiles, Summary, merged
from tools.logs.run_log import RunLog, RunPart, read_run
from tools.terminal import Console


@pytest.fixture(scope="module")
def upright(robot: RobotConfig) -> SimTruth:
    return World(body_of(robot, IDEAL), still(1.0)).truth(0, 1.0, 0.0)


def test_a_robot_upright_on_its_soles_stands(robot: RobotConfig, upright: SimTruth) -> None:
    assert why_not_standing(upright, robot) == ""


def test_feet_that_have_crept_for_an_hour_take_the_com_with_them(
    robot: RobotConfig, upright: SimTruth
) -> None:
    """A squat moves them by 0.3 mm: after an hour a robot that stood counted as fallen."""
    crept = msgspec.structs.replace(upright, com=(-0.25, 0.0, 1.0), feet=(-0.25, 0.0))
    assert crept.over == pytest.approx((0.0, 0.0), abs=2e-3)
    assert why_not_standing(crept, robot) == ""


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"fallen": True}, "it has fallen"),
        ({"com": (0.13, 0.0, 1.0)}, "beyond the soles"),
        ({"foot_left_tilt": 0.06}, "a sole is tilted"),
        ({"angles": (0.0, -0.6, 0.0)}, "turned"),
        ({"angles": (0.0, 1.7, 0.0)}, "turned"),
        ({"angles": (0.31, 0.0, 0.0)}, "turned"),
        ({"angles": (0.0, 0.0, -0.31)}, "turned"),
    ],
)
def test_what_is_no_standing_is_named(
    robot: RobotConfig, upright: SimTruth, changes: dict[str, object], why: str
) -> None:
    assert why in why_not_standing(msgspec.structs.replace(upright, **changes), robot)


@pytest.mark.parametrize("hz", [2.0, 20.0, 60.0])
def test_shaking_is_what_is_above_the_laws_band(hz: float) -> None:
    t_s = np.arange(0.0, 3.0, 0.004)
    tau = np.stack([10.0 * np.sin(2 * np.pi * hz * t_s), np.full(len(t_s), 40.0)], axis=1)
    found = shaking_of((1e9 * t_s).astype(np.int64), tau)[-1]
    through = hz / np.hypot(hz, 8.0)  # one pole
    assert found[0] == pytest.approx(10.0 / np.sqrt(2.0) * through, rel=0.25)
    assert found[1] == pytest.approx(0.0, abs=1e-9)


def test_a_run_is_judged_by_how_it_stands_at_its_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pushed by 250 N as the scenario ends, it is not down yet, and will be."""
    words = ("--scenario", "stand", "--duration", "1.5", "--push", "1:0.8:250,0,0")
    assert cli.main(["sim", *words, "--out", str(tmp_path / "out")]) == 1
    log = read_run(tmp_path / "out" / "run.mcap")
    summary = verdict.summarise(log, 1.5)
    assert summary.fallen_at_s is None
    assert summary.stood is False
    assert summary.why_not
    assert "DOES NOT STAND" in capsys.readouterr().out


def test_a_run_in_virtual_time_has_no_stalls_and_says_nothing_of_them(
    impaired: RunLog, log: RunLog
) -> None:
    led_again = verdict.summarise(log, 2.0)
    assert led_again.reengage_s is not None
    sound = verdict.summarise(impaired, 2.0)
    for run in (led_again, sound):
        assert run.stalls == []
    assert sound.operator_side_peak_n is None, "nobody holds it sideways"
    assert verdict_table.stalls(sound) == []


def test_a_sound_run_has_figures_within_their_limits(log: RunLog) -> None:
    """Until its planner is killed."""
    before_s = (verdict.course(log).zero_ns - log.began_ns()) / 1e9
    sound = verdict.summarise(RunLog(log.index, RunPart(0.0, before_s + 0.95)), 0.95)
    assert (sound.stood, sound.sound) == (True, True)
    assert sound.torque_at_limit_ms == 0.0
    assert 0.05 < (sound.shaking_nm or 0.0) < 5.0
    assert 0.05 < (sound.sinking_m_s or 0.0) < 0.3, "it is led down"
    console = Console(width=120, record=True)
    verdict_table.show(sound, console)
    text = console.export_text()
    assert all(word in text for word in ("torque above 8 Hz", "at its limit", "fastest descent"))


def test_motors_at_their_limit_are_no_sound_standing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A knee limp, the other carries all: it stands, and not as it is to."""
    flags = ("--fault", "knee_left:disarmed@1.5", "--duration", "4")
    assert cli.main(["sim", *flags, "--out", str(tmp_path)]) == 3
    summary = verdict.summarise(read_run(tmp_path / "run.mcap"), 4.0)
    assert (summary.stood, summary.sound) == (True, False)
    assert (summary.fallen_at_s, summary.why_not) == (None, "")
    assert "torque at its limit" in summary.unsound
    output = capsys.readouterr().out
    assert "STOOD, BUT NOT SOUNDLY" in output
    assert "(limit 50)" in output


def test_what_follows_a_fall_does_not_count(log: RunLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot is down before the planner is killed, and the record goes on."""
    whole = verdict.course(log)
    fall = int(np.searchsorted(whole.t, 0.5))
    rows = [
        *whole.rows[:fall],
        *(msgspec.structs.replace(row, fallen=True) for row in whole.rows[fall:]),
    ]
    monkeypatch.setattr(verdict, "course", lambda _log: whole._replace(rows=rows))
    summary = verdict.summarise(log, 2.0)
    assert summary.fallen_at_s == summary.duration_s == whole.t[fall]
    assert (summary.handover_ms, summary.hold_entries) == (None, 0)
    assert summary.torso_height_min_m == min(row.torso[2] for row in rows[: fall + 1])
    assert summary.messages_recorded == sum(log.count(key) for key in log.keys())  # noqa: SIM118


def test_a_time_to_hold_that_was_not_measured_is_a_dash(log: RunLog) -> None:
    """In virtual time the joint services see the end of the planner in the same instant."""
    summary = verdict.summarise(log, 2.0)
    assert summary.handover_max_ms is None
    shown = {what: measured for what, measured, *_ in verdict_table.rows(summary)}
    assert shown["kill to HOLD, slowest module"] == "-"


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"stood": True, "sound": True}, 0),
        ({"fallen_at_s": 2.0}, 1),
        ({"why_not": "a sole is tilted by 0.06 rad"}, 1),
        ({"stood": True, "unsound": "torque at its limit: 90 ms (limit 50)"}, 3),
        ({}, 3),
    ],
    ids=["stood", "fell", "tips at the end", "not soundly", "not finished"],
)
def test_only_a_fall_is_exit_code_1(changes: dict[str, object], code: int) -> None:
    assert verdict.exit_code(msgspec.convert(changes, Summary)) == code


@pytest.mark.parametrize("key", SOUND)
def test_each_figure_of_soundness_is_judged_by_its_limit(key: str) -> None:
    (limit,) = (row for row in LIMITS if row.key == key)
    calm = Soundness(*[0.0] * len(SOUND))
    assert why_not_sound(calm._replace(**{key: limit.limit})) == ""
    assert limit.what in why_not_sound(calm._replace(**{key: 1.01 * limit.limit}))
    assert why_not_sound(Soundness()) == "", "nothing is known"


def test_nothing_is_reported_of_a_gap_in_the_log() -> None:
    """A service that was dead for 2 s between two torques at the limit."""
    t_ns = (1e9 * np.array([0.0, 0.004, 0.008, 2.0, 2.004])).astype(np.int64)
    assert _longest_s(t_ns, np.ones(5, bool)) == pytest.approx(0.008)
    tau = np.array([[10.0, 0.0]] * 3 + [[90.0, 0.0]] * 2)
    assert shaking_of(t_ns, tau).max() == 0.0


def test_every_limit_is_one_of_a_figure() -> None:
    assert {row.key for row in LIMITS} <= set(Summary.__struct_fields__)


def test_figures_of_parts_merge_as_their_fields_declare() -> None:
    first = Summary(
        shaking_nm=3.0, torso_height_min_m=0.9, duration_s=10.0, in_real_time=False,
        command_age_ms=Percentiles(3.0, 9.0), messages_recorded=5,
        links_impaired=1,
    )  # fmt: skip
    last = Summary(
        stood=True, sound=True, shaking_nm=2.0, torso_height_min_m=1.0, duration_s=20.0,
        command_age_ms=Percentiles(5.0, 8.0), messages_recorded=9,
    )  # fmt: skip
    assert merged([first, last]) == Summary(
        stood=True, sound=True, shaking_nm=3.0, torso_height_min_m=0.9, duration_s=20.0,
        in_real_time=False, command_age_ms=Percentiles(4.0, 9.0), messages_recorded=9,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "stood"), [({"fallen_at_s": 3.0}, False), ({"shaking_nm": 16.0}, True), ({}, True)]
)
def test_a_run_is_as_sound_as_its_worst_part(changes: dict[str, float], stood: bool) -> None:
    found = merged([msgspec.convert(changes, Summary), Summary(stood=True, sound=True)])
    assert (found.stood, found.sound) == (stood, not changes)
    assert found.fallen_at_s == changes.get("fallen_at_s")


class Events:
    """A log of nothing but the modules' changes of mode."""

    def __init__(self, *changes: tuple[float, Mode]) -> None:
        self.rows = [
            sample(JointEvent, t_ns=round(t * 1e9), mode_after=int(mode)) for t, mode in changes
        ]

    def messages(self, _topic: Topic, _module: str) -> list[JointEvent]:
        return self.rows


@pytest.mark.parametrize(
    ("held_from_s", "force_n", "longest_s"),
    [(9.0, 150.0, 2.0), (9.0, 90.0, 0.0), (2.5, -150.0, 0.5)],
)
def test_only_a_hand_that_presses_a_robot_which_tracks_counts_as_overforce(
    upright: SimTruth, held_from_s: float, force_n: float, longest_s: float
) -> None:
    """The force is there from 2 to 4 s."""
    truth = [
        msgspec.structs.replace(
            upright, t_ns=ms * 1_000_000, operator_force=(0.0, 0.0, force_n * (2000 <= ms <= 4000))
        )
        for ms in range(0, 5000, 10)
    ]
    log: Any = Events((0.0, Mode.TRACK), (held_from_s, Mode.HOLD))
    assert _overforce_s(log, truth) == pytest.approx(longest_s, abs=0.02)


def test_a_run_in_several_files_is_judged_to_its_end(impaired: RunLog, tmp_path: Path) -> None:
    """An hour's demo was judged by its first file, and was NOT FINISHED."""
    folder = recorded_in_parts(impaired, tmp_path / "split")
    assert (folder / "run_1.mcap").exists()
    whole = verdict.summarise(impaired, 1.0)
    assert figure.judge_run(folder, "split", 1.0).duration_s == whole.duration_s


@pytest.fixture(scope="module")
def drawn(impaired: RunLog, tmp_path_factory: pytest.TempPathFactory) -> Figure:
    kept: list[Figure] = []
    patch = pytest.MonkeyPatch()
    save = Figure.savefig

    def keep(self: Figure, path: Path, **words: Any) -> None:
        kept.append(self)
        save(self, path, **words)

    patch.setattr(Figure, "savefig", keep)
    try:
        path = tmp_path_factory.mktemp("drawn") / "run.png"
        figure.draw(impaired, "x", verdict.summarise(impaired, 2.0), path)
    finally:
        patch.undo()
    return kept[0]


def panel(drawn: Figure, label: str) -> Any:
    return next(axis for axis in drawn.axes if axis.get_ylabel().startswith(label))


def test_the_ages_of_all_six_modules_are_drawn_with_the_age_that_is_not_used(
    drawn: Figure, robot: RobotConfig
) -> None:
    axis = panel(drawn, "Command age")
    most_ms = robot.joint_service.max_command_age_ms
    curves = [line for line in axis.get_lines() if len(line.get_xdata()) > 100]
    assert len(curves) == 6
    assert any(set(line.get_ydata()) == {most_ms} for line in axis.get_lines())
    assert most_ms < axis.get_ylim()[1] < 2.0 * most_ms


def test_each_impairment_is_named_and_has_a_bar_and_a_line_at_its_begin_and_end(
    drawn: Figure,
) -> None:
    axis = panel(drawn, "COM")
    assert {"planner->joints delay=25ms", "planner->left delay=40ms jitter=5ms"} <= {
        text.get_text() for text in axis.texts
    }
    edges = {round(float(line.get_xdata()[0]), 2) for line in axis.get_lines()}
    assert edges >= {0.4, 0.7, 1.0, 1.3, 1.5}
    labels = [label.get_text() for label in panel(drawn, "Modes").get_yticklabels()]
    assert labels == ["planner", *MODULES, "network"]


def test_no_legend_covers_a_curve(drawn: Figure) -> None:
    drawn.canvas.draw()
    for axis in drawn.axes:
        legend = axis.get_legend()
        if legend is not None:
            assert legend.get_window_extent().x0 >= axis.get_window_extent().x1


def test_ages_while_impaired_and_otherwise_are_separate(impaired: RunLog) -> None:
    summary = verdict.summarise(impaired, 2.0)
    late, otherwise = summary.command_age_impaired_ms, summary.command_age_otherwise_ms
    assert late is not None
    assert otherwise is not None
    assert otherwise.median <= otherwise.p99 < 20.0
    assert 25.0 <= late.median <= late.p99
    links = [line.split()[0] for line in summary.impairments]
    assert links == ["planner->joints", "planner->left", "all"]
    assert summary.links_impaired == 3
