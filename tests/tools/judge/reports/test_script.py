"""The page's script in node, with a stand-in for the browser: what the page adds to uPlot."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.bus import topics
from shared.joints import MODULES
from tests.tools.judge.reports import runs
from tools.judge.reports.page import render
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog

NODE = shutil.which("node")
STAND_IN = Path(__file__).with_name("stand_in_browser.js")

pytestmark = pytest.mark.skipif(NODE is None, reason="needs node")


@pytest.fixture(scope="module")
def page_file(page: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def do(page: Path, *steps: list[Any], width: int = 1400, theme: str = "light") -> list[Any]:
    command = [str(NODE), str(STAND_IN), str(page), str(width), json.dumps(steps), theme]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    answers: list[Any] = json.loads(done.stdout)
    return answers


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [380, 1400])
def test_every_panel_draws_narrow_and_wide_light_and_dark(
    page_file: Path, width: int, theme: str
) -> None:
    (panels,) = do(page_file, ["all"], width=width, theme=theme)
    assert len(panels) >= 17
    for panel in panels:
        kinds = {op[0] for op in panel["ops"]}
        bars = panel["title"].startswith(("Modes", "Drives", "Planner", "Source", "Harness s"))
        assert {"path", "text"} <= kinds, panel["title"]
        assert ("rect" in kinds) == bars
        for op in panel["ops"]:
            if op[0] == "text":
                half = 3 * len(op[1]) if op[4] == "center" else 0
                assert -1 <= op[2] - half <= op[2] + half <= width + 1, (panel["title"], op[1])
                assert -1 <= op[3] <= panel["height"] + 1, (panel["title"], op[1])


def test_a_drag_zooms_all_panels_and_a_double_click_shows_the_whole_run(page_file: Path) -> None:
    whole, zoomed, texts, at, back = do(
        page_file, ["shown"], ["drag", "COM", 500, 700], ["texts", "Harness force"], ["times"],
        ["event", "COM", "dblclick", {}],
    )  # fmt: skip
    assert whole[0] < zoomed[0] < zoomed[1] < whole[1]
    fraction = 200 / (1400 - 100 - 20)
    assert zoomed[1] - zoomed[0] == pytest.approx(fraction * (whole[1] - whole[0]), rel=0.01)
    times = [float(text.removesuffix(" s")) for text in texts if text.endswith(" s")]
    assert times
    assert all(zoomed[0] <= t <= zoomed[1] for t in times)
    assert "\u0394t" not in at, "the end of a drag is no click: it pins nothing"
    assert back[0] == whole


def test_a_finger_zooms_as_the_mouse_does(page_file: Path) -> None:
    (swiped,) = do(page_file, ["swipe", "COM", 500, 700])
    (dragged,) = do(page_file, ["drag", "COM", 500, 700])
    assert swiped == dragged


def test_the_wheel_zooms_at_the_cursor_with_ctrl_and_scrolls_the_page_without(
    page_file: Path,
) -> None:
    wheel = {"deltaY": -1, "clientX": 700}
    whole, plain, zoomed = do(
        page_file, ["shown"], ["event", "COM", "wheel", wheel],
        ["event", "COM", "wheel", wheel | {"ctrlKey": True}],
    )  # fmt: skip
    assert plain == [whole, False]
    assert zoomed[1] is True
    assert zoomed[0][1] - zoomed[0][0] < whole[1] - whole[0]


def test_the_wheel_sideways_or_with_shift_moves_the_time_shown(page_file: Path) -> None:
    wheel = {"clientX": 700, "deltaX": 0, "deltaY": 0}
    zoomed, sideways, shifted = do(
        page_file, ["drag", "COM", 500, 700],
        ["event", "COM", "wheel", wheel | {"deltaX": 50}],
        ["event", "COM", "wheel", wheel | {"deltaY": -50, "shiftKey": True}],
    )  # fmt: skip
    length = zoomed[1] - zoomed[0]
    assert sideways[1] is True
    assert sideways[0][0] == pytest.approx(zoomed[0] + 0.05 * length, abs=0.002)
    assert shifted[0] == pytest.approx(zoomed, abs=0.002)


def test_the_legends_show_the_values_at_the_cursor_in_every_panel(page_file: Path) -> None:
    time, angles, modes, cursors, _, after = do(
        page_file, ["hover", "COM", 500], ["legend", "Torso angles"], ["legend", "Modes"],
        ["cursors", "Height"], ["event", "COM", "mouseleave", {}], ["legend", "Torso angles"],
    )  # fmt: skip
    assert time.startswith("t = ")
    assert angles[0][0] == "roll"
    assert all(value for _, value in angles)
    assert [name for name, _ in modes] == list(MODULES)
    assert {value for _, value in modes} <= {"HOLD", "TRACK"}
    assert cursors == [None, 500]
    assert not any(value for _, value in after)


@pytest.mark.parametrize("key", ["", "Enter", " "])
def test_the_legend_hides_a_line_and_shows_it_again(page_file: Path, key: str) -> None:
    before, off, fewer, on, again = do(
        page_file, ["lines", "Torso angles"], ["toggle", "Torso angles", 0, key],
        ["lines", "Torso angles"], ["toggle", "Torso angles", 0, key], ["lines", "Torso angles"],
    )  # fmt: skip
    assert (off, on) == ("false", "true")
    assert len(fewer) < len(before)
    assert again == before


def test_a_choice_of_joint_is_that_of_all_its_panels_and_keeps_hidden_lines(
    page_file: Path,
) -> None:
    first, _, before, second, after = do(
        page_file, ["choose", "Torque of one", 7], ["toggle", "Torque of one", 0],
        ["lines", "Torque of one"], ["choose", "Angle of one", 2], ["lines", "Torque of one"],
    )  # fmt: skip
    assert first == [7, 7, 7]
    assert second == [2, 2, 2]
    assert {colour for colour, _ in after} == {colour for colour, _ in before}


def test_the_keyboard_moves_the_cursor_and_the_time(page_file: Path) -> None:
    def key(name: str, **held: bool) -> list[Any]:
        return ["event", "COM", "keydown", {"key": name, **held}]

    whole, zoomed, panned, cursor, at, back, unused = do(
        page_file, ["shown"], key("+"), key("ArrowRight", shiftKey=True), key("ArrowLeft"),
        ["times"], key("0"), key("f"),
    )  # fmt: skip
    length = zoomed[0][1] - zoomed[0][0]
    assert length == pytest.approx((whole[1] - whole[0]) / 2, rel=0.01)
    assert panned[0][0] == pytest.approx(zoomed[0][0] + 0.2 * length, abs=0.002)
    assert cursor[1] is True
    middle = sum(panned[0]) / 2
    assert float(at.split()[2]) == pytest.approx(middle - length / 100, abs=0.002)
    assert back[0] == whole
    assert unused[1] is False


def test_a_click_in_the_timeline_shows_and_pins_its_time(page_file: Path, page: str) -> None:
    t = page.partition('class="kill"><button type="button" data-t="')[2].partition('"')[0]
    shown, label, modes, at = do(
        page_file, ["press", "t", t], ["texts", "COM"], ["legend", "Modes"], ["times"]
    )
    assert shown == pytest.approx([float(t) - 0.5, float(t) + 1.5], abs=0.002)
    assert "planner KILL" in label
    assert ["ankle_right", "TRACK"] in modes
    assert at == f"t = {float(t):.3f} s \u00b7 planner KILL"


def test_the_time_shown_can_be_typed_and_stays_in_the_run(page_file: Path) -> None:
    whole, typed, beyond = do(page_file, ["shown"], ["type", "to", "1.5"], ["type", "from", "-9"])
    assert typed[1] == pytest.approx(1.5, abs=0.002)
    assert beyond[0] >= whole[0] - 0.001


def test_a_peak_is_drawn_at_every_zoom(page_file: Path) -> None:
    """The value axis covers what is shown and 6 % more, and the lines reach both extremes."""
    for a, b in ((300, 1200), (700, 900), (400, 600)):
        _, lines = do(page_file, ["drag", "Height", a, b], ["lines", "Height"])
        paths = [path for colour, path in lines if colour in ("#0b5fa5", "#c4501b")]
        assert len(paths) == 2, "torso and COM"
        heights = [y for path in paths for _, x, y in path if 100 <= x <= 1380]
        pad = 0.06 / 1.12 * 146
        assert min(heights) == pytest.approx(6 + pad, abs=1.5)
        assert max(heights) == pytest.approx(152 - pad, abs=1.5)


def test_a_lone_sample_between_two_gaps_is_a_point(log: RunLog, tmp_path: Path) -> None:
    """The planner is killed at 1 s and back at 1.8 s; no line passes through a sample between."""
    run = RunData(log)
    status = log.messages(topics.PLANNER_STATUS)[-1]
    t_ns = run.zero_ns + 1_400_000_000
    body = msgspec.json.encode(msgspec.structs.replace(status, t_ns=t_ns, margin=0.7))
    path = tmp_path / "lone.html"
    with_sample = runs.rewritten(log, tmp_path, more=[(t_ns, topics.PLANNER_STATUS.name, body)])
    path.write_text(render(with_sample), encoding="utf-8")
    points, lines = do(path, ["points", "Certificate"], ["lines", "Certificate"])
    assert [colour for colour, _ in points] == ["#0b5fa5", "#c4501b"]
    assert len(points[0][1]) == 2, "one circle: a move and an arc"
    assert lines


def test_an_age_of_seconds_does_not_flatten_the_others(page_file: Path) -> None:
    (texts,) = do(page_file, ["texts", "Command age"])
    ages = [float(text) for text in texts if text.replace(".", "").replace("-", "").isdigit()]
    assert max(ages) <= 200.0
    assert "HOLD" in texts


def test_a_click_pins_the_cursor_and_the_bar_shows_the_time_from_there(page_file: Path) -> None:
    def press(key: str) -> list[Any]:
        return ["event", "COM", "keydown", {"key": key}]

    _, pinned, _, stays, values, apart, marked, _, gone, whole, _, removed = do(
        page_file,
        ["hover", "COM", 500], ["click", "COM", 500], ["event", "COM", "mouseleave", {}],
        ["times"], ["legend", "Torso angles"],
        ["hover", "COM", 700], ["cursors", "Height"],
        press("Escape"), ["cursors", "Height"], press("Escape"),
        ["click", "COM", 500], ["click", "COM", 500],
    )  # fmt: skip
    assert pinned.startswith("t = ")
    assert stays == pinned, "the pin stays when the pointer leaves"
    assert values[0][1], "and so do the values"
    assert "\u0394t = +" in apart
    assert marked == pytest.approx([500, 700]), "pin and cursor, in every panel"
    assert gone == pytest.approx([None, 700])
    assert whole[1] is True
    assert "\u0394t" not in removed, "a second click at the pin removes it"


def test_the_cursor_does_not_draw_the_plots_again(page_file: Path) -> None:
    """Drawing lines of thousands of points again would delay each move of the cursor."""
    before, _, _, after, _, zoomed = do(
        page_file, ["drawings"], ["hover", "COM", 500], ["hover", "COM", 700], ["drawings"],
        ["drag", "COM", 500, 700], ["drawings"],
    )  # fmt: skip
    assert after == before
    assert all(more > count for more, count in zip(zoomed, after, strict=True))


def test_the_list_of_panels_goes_to_a_panel(page_file: Path) -> None:
    titles, third = do(page_file, ["titles"], ["goto", 3])
    assert third.startswith(titles[2])


def test_limits_are_named_in_the_plot_whose_lines_come_close(page_file: Path) -> None:
    torque, tilt, command = do(
        page_file, ["texts", "Torque of each"], ["texts", "Tilt of"], ["texts", "Command age"]
    )
    assert "limit" in torque
    assert "HOLD" in command
    assert "planner leading" not in tilt, "a limit far off does not flatten the line"


def test_numbers_of_an_axis_have_room_on_a_narrow_screen(page_file: Path) -> None:
    (panels,) = do(page_file, ["all"], width=380)
    for panel in panels:
        for op in panel["ops"]:
            if op[0] == "text" and op[4] == "right" and not op[1][0].isalpha():
                assert 6 * len(op[1]) <= op[2], (panel["title"], op[1])


def test_a_screen_reader_gets_the_range_of_every_line(page_file: Path) -> None:
    lines, bars = do(page_file, ["description", "Torso angles"], ["description", "Modes"])
    assert lines.startswith("Torso angles: roll from ")
    assert "; pitch from " in lines
    assert "ankle_right, " in bars


def test_no_time_is_cut_off_at_the_edge(page_file: Path) -> None:
    """The time shown ends with a round number, which has no room on a narrow screen."""
    _, _, (panel, *_) = do(
        page_file, ["type", "from", "1"], ["type", "to", "2"], ["all"], width=380
    )
    times = [op for op in panel["ops"] if op[0] == "text" and op[1].endswith(" s")]
    assert len(times) > 2
    assert all(op[2] + 3 * len(op[1]) <= 380 for op in times)


def test_a_print_draws_every_panel_with_the_pin(page_file: Path) -> None:
    plain, _, pinned = do(page_file, ["print"], ["click", "COM", 500], ["print"])
    assert all(count > 5 and not pin for count, pin in plain)
    assert all(count > 5 and pin for count, pin in pinned)
