"""The picture of a run and its figures: what was done to the network, how old commands were."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from shared.config.robot_config import RobotConfig
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
    axis = panel(drawn, "command age")
    most_ms = robot.joint_service.max_command_age_ms
    curves = [line for line in axis.get_lines() if len(line.get_xdata()) > 100]
    assert len(curves) == 6
    assert any(set(line.get_ydata()) == {most_ms} for line in axis.get_lines())
    assert most_ms < axis.get_ylim()[1] < 2.0 * most_ms


def test_each_impairment_has_a_lane_with_its_words_and_no_curve(drawn: Figure) -> None:
    axis = panel(drawn, "network")
    assert [text.get_text() for text in axis.texts] == [
        "planner->joints delay=25ms, 0.40 to 1.00 s",
        "planner->left delay=40ms jitter=5ms, 0.70 to 1.30 s",
        "all partition, 1.50 to 1.90 s",
    ]
    assert not axis.get_lines()
    assert len({text.xy[1] for text in axis.texts}) == 3, "one below the other"


def test_where_two_impairments_overlap_each_begin_and_end_has_a_line(drawn: Figure) -> None:
    axis = panel(drawn, "COM")
    edges = {
        round(float(line.get_xdata()[0]), 2)
        for line in axis.get_lines()
        if line.get_color() == figure.IMPAIRED_COLOUR
    }
    assert edges == {0.4, 0.7, 1.0, 1.3, 1.5, 1.9}


def test_no_legend_covers_a_curve(drawn: Figure) -> None:
    drawn.canvas.draw()
    for axis in drawn.axes:
        legend = axis.get_legend()
        if legend is not None:
            assert legend.get_window_extent().x0 >= axis.get_window_extent().x1


def test_a_panel_for_the_network_is_there_only_if_something_was_done_to_it(
    impaired: RunLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = verdict.summarise(impaired, 2.0)
    monkeypatch.setattr(figure, "impairments", lambda _: [])
    labels: list[str] = []
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *_, **__: labels.extend(a.get_ylabel() for a in self.axes)
    )
    figure.draw(impaired, "x", summary, tmp_path / "run.png")
    assert "network" not in labels
    assert len(labels) == 6


def test_ages_while_impaired_and_otherwise_are_separate(impaired: RunLog) -> None:
    summary = verdict.summarise(impaired, 2.0)
    late, otherwise = summary.command_age_impaired_ms, summary.command_age_otherwise_ms
    assert late is not None
    assert otherwise is not None
    assert otherwise.median <= otherwise.p99 < 20.0
    assert 25.0 <= late.median <= late.p99
    links = [row.link for row in summary.impairments]
    assert links == ["planner->joints", "planner->left", "all"]
    assert summary.links_impaired == 3
