"""The picture of a run and its figures: what was done to the network, how old commands were."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.judge import figure, verdict
from tools.logs.run_log import RunLog


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
