"""The page's script, run by node with just enough of a document to click in."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from shared.joints import MODULES

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
        bars = panel["title"].startswith(("Modes", "Drives", "Planner", "Where", "Harness s"))
        assert {"path", "text"} <= kinds, panel["title"]
        assert ("rect" in kinds) == bars
        for op in panel["ops"]:
            if op[0] == "text":
                assert -1 <= op[2] <= width + 1, (panel["title"], op[1])
                assert -1 <= op[3] <= panel["height"] + 1, (panel["title"], op[1])


def test_a_drag_zooms_all_panels_and_a_double_click_shows_the_whole_run(page_file: Path) -> None:
    whole, zoomed, ticks, back = do(
        page_file, ["shown"], ["drag", "COM", 500, 700], ["texts", "Harness force"],
        ["event", "COM", "dblclick", {}],
    )  # fmt: skip
    assert whole[0] < zoomed[0] < zoomed[1] < whole[1]
    share = 200 / (1400 - 100 - 10)
    assert zoomed[1] - zoomed[0] == pytest.approx(share * (whole[1] - whole[0]), rel=0.01)
    times = [float(text.removesuffix(" s")) for text in ticks if text.endswith(" s")]
    assert times
    assert all(zoomed[0] <= t <= zoomed[1] for t in times)
    assert back[0] == whole


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


def test_the_legend_reads_the_cursor_and_hides_lines(page_file: Path) -> None:
    before, time, after, pressed, fewer, more = do(
        page_file, ["strokes", "Torso angles"], ["hover", "Torso angles", 500],
        ["legend", "Torso angles"], ["toggle", "Torso angles", 0], ["strokes", "Torso angles"],
        ["read", "Modes"],
    )  # fmt: skip
    assert time.startswith("t = ")
    assert after[0][0] == "roll"
    assert all(value for _, value in after)
    assert pressed == "false"
    assert len(fewer) < len(before)
    assert all(f"{module} " in more for module in MODULES)


def test_a_choice_of_joint_is_that_of_all_its_panels(page_file: Path) -> None:
    at_first, chosen = do(page_file, ["choose", "Torque of one", 7], ["choose", "Angle of one", 2])
    assert at_first == [7, 7, 7]
    assert chosen == [2, 2, 2]


def test_the_keyboard_moves_the_cursor_and_the_time(page_file: Path) -> None:
    def key(name: str, **held: bool) -> list[Any]:
        return ["event", "COM", "keydown", {"key": name, **held}]

    whole, zoomed, panned, cursor, back, left_alone = do(
        page_file, ["shown"], key("+"), key("ArrowRight", shiftKey=True), key("ArrowLeft"),
        key("0"), key("f"),
    )  # fmt: skip
    length = zoomed[0][1] - zoomed[0][0]
    assert length == pytest.approx((whole[1] - whole[0]) / 2, rel=0.01)
    assert panned[0][0] == pytest.approx(zoomed[0][0] + 0.2 * length, abs=0.002)
    assert cursor[1] is True
    assert back[0] == whole
    assert left_alone[1] is False


def test_a_click_in_the_timeline_shows_that_moment(page_file: Path, page: str) -> None:
    t = page.partition('class="kill"><button type="button" data-t="')[2].partition('"')[0]
    shown, label, read = do(page_file, ["click", "t", t], ["texts", "COM"], ["read", "Modes"])
    assert shown == pytest.approx([float(t) - 0.5, float(t) + 1.5], abs=0.002)
    assert "planner KILL" in label
    assert "ankle_right TRACK" in read


def test_the_time_shown_can_be_typed_and_stays_in_the_run(page_file: Path) -> None:
    whole, typed, beyond, _ = do(
        page_file, ["shown"], ["type", "to", "1.5"], ["type", "from", "-1000"], ["print"]
    )
    assert typed[1] == pytest.approx(1.5, abs=0.002)
    assert beyond[0] >= whole[0] - 0.001


def test_a_peak_is_drawn_at_every_zoom(page_file: Path) -> None:
    """The highest point of the line is as high on the canvas as the axis says, zoomed or not."""
    ends = ((300, 1200), (700, 900), (400, 600))
    for a, b in ends:
        _, strokes = do(page_file, ["drag", "COM", a, b], ["strokes", "COM"])
        heights = [y for _, path in strokes for _, _, y in path]
        assert min(heights) < 60, "the range is that of what is shown, 6 % above the peak"
        assert max(heights) < 210


def test_an_age_of_seconds_does_not_flatten_the_others(page_file: Path) -> None:
    (texts,) = do(page_file, ["texts", "Command age"])
    ages = [float(text) for text in texts if text.replace(".", "").replace("-", "").isdigit()]
    assert max(ages) <= 200.0
    assert "HOLD" in texts


def test_a_click_pins_the_cursor_and_the_time_from_there_is_told(page_file: Path) -> None:
    def press(key: str) -> list[Any]:
        return ["event", "COM", "keydown", {"key": key}]

    _, _, pinned, values, apart, marked, _, gone, whole = do(
        page_file,
        ["drag", "COM", 500, 501], ["event", "COM", "pointerleave", {}], ["times"],
        ["legend", "Torso angles"],
        ["hover", "COM", 700], ["levels", "Height"],
        press("Escape"), ["levels", "Height"], press("Escape"),
    )  # fmt: skip
    assert pinned.startswith("t = "), "it stays when the pointer leaves"
    assert values[0][1], "and so do the values"
    assert "\u0394t = +" in apart
    assert [x for _, x in marked] == [501.5, 700.5], "pin and cursor, in every panel"
    assert [x for _, x in gone] == [700.5]
    assert whole[1] is True


def test_the_cursor_names_what_happened_there(page_file: Path, page: str) -> None:
    t = page.partition('class="kill"><button type="button" data-t="')[2].partition('"')[0]
    _, said = do(page_file, ["click", "t", t], ["times"])
    assert said == f"t = {float(t):.3f} s \u00b7 planner KILL"


def test_a_wheel_sideways_or_with_shift_moves_the_time_shown(page_file: Path) -> None:
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


def test_the_cursor_does_not_draw_the_plots_again(page_file: Path) -> None:
    """With lines of thousands of points that would take a tenth of a second each time."""
    before, _, _, after, _, zoomed = do(
        page_file, ["drawings"], ["hover", "COM", 500], ["hover", "COM", 700], ["drawings"],
        ["drag", "COM", 500, 700], ["drawings"],
    )  # fmt: skip
    assert after == before
    assert all(more > count for more, count in zip(zoomed, after, strict=True))


def test_every_panel_can_be_gone_to_by_name(page_file: Path) -> None:
    titles, third = do(page_file, ["titles"], ["goto", 3])
    assert third.startswith(titles[2])


def test_limits_are_named_beside_the_plot_that_comes_near_them(page_file: Path) -> None:
    torque, tilt, command = do(
        page_file, ["texts", "Torque of each"], ["texts", "Tilt of"], ["texts", "Command age"]
    )
    assert "limit" in torque
    assert "HOLD" in command
    assert "while led" not in tilt, "a limit far off does not press the line flat"


def test_numbers_of_an_axis_have_room_on_a_narrow_screen(page_file: Path) -> None:
    (panels,) = do(page_file, ["all"], width=380)
    for panel in panels:
        for op in panel["ops"]:
            if op[0] == "text" and op[4] == "right" and not op[1][0].isalpha():
                assert 6 * len(op[1]) <= op[2], (panel["title"], op[1])


def test_a_page_is_printed_whole_with_its_pin(page_file: Path) -> None:
    plain, _, pinned = do(page_file, ["print"], ["drag", "COM", 500, 501], ["print"])
    assert min(plain) > 10
    assert all(more > count for more, count in zip(pinned, plain, strict=True))
