"""The page in a real Chromium, if one is installed: what it adds to uPlot, how it is laid out."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Coroutine, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from shared.bus import topics
from shared.joints import MODULES
from tests.tools.judge.reports import runs
from tests.tools.view.browser import BROWSER, FLAT, Page, browser
from tools.judge.reports.page import render
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog

DRIVER = Path(__file__).with_name("driver.js").read_text(encoding="utf-8")
A, B = 300, 500
"""Two places in a plot, px."""

WIDTHS = (380, 600, 1000, 1600)
EMPTY = """[...document.querySelectorAll("canvas")].filter((canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return !data.some((value) => value > 0);
}).length"""
LOOK = """(() => {
  const root = document.documentElement, width = root.clientWidth;
  const scroller = ".wide, pre, #timeline ol";
  const boxes = [...document.querySelectorAll("body *")].filter((node) => !node.closest(scroller));
  const wider = boxes.filter((node) => {
    const { left, right, width: wide } = node.getBoundingClientRect();
    return wide > 0 && (right > width + 0.5 || left < -0.5);
  }).map((node) => `${node.tagName} ${node.className}`);
  const cut = [...document.querySelectorAll("button, h1, h3, summary, dd, td, input")]
    .filter((node) => node.scrollWidth > node.clientWidth + 1 && node.clientWidth > 0)
    .map((node) => `${node.tagName} ${node.textContent || node.value}`);
  return JSON.stringify({
    width, page: root.scrollWidth, wider, cut, panels: document.querySelectorAll(".panel").length,
    shown: document.getElementById("to").value,
  });
})()"""

pytestmark = pytest.mark.skipif(BROWSER is None, reason="needs a Chromium")


class Tab:
    """A browser's page, for tests that are no coroutines."""

    def __init__(self, runner: asyncio.Runner, page: Page) -> None:
        self._runner, self.page = runner, page

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self._runner.run(work)


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with asyncio.Runner() as runner:
        opened = browser(FLAT)
        page = runner.run(opened.__aenter__())
        runner.run(page.call("Page.enable"))
        runner.run(page.call("Page.addScriptToEvaluateOnNewDocument", source=DRIVER))
        yield Tab(runner, page)
        assert page.complaints == [], "also what the page's own policy forbids"
        runner.run(opened.__aexit__(None, None, None))


class Report(NamedTuple):
    """A report in a browser's page."""

    tab: Tab
    file: Path

    def do(self, *steps: list[Any], width: int = 1400, theme: str = "light") -> list[Any]:
        """Open it, take some steps of `driver.js`, and return their answers."""
        return self.tab.run(self._do(steps, width, theme))

    async def _do(self, steps: Sequence[list[Any]], width: int, theme: str) -> list[Any]:
        page = self.tab.page
        scheme = [{"name": "prefers-color-scheme", "value": theme}]
        await page.call("Emulation.setEmulatedMedia", features=scheme)
        await page.open(self.file.as_uri(), width, 900)
        await page.until("isDrawn()")
        answers: list[Any] = await page.value(f"act({json.dumps(steps)})")
        assert answers is not None, "a step has failed"
        return answers


@pytest.fixture(scope="module")
def report(page: str, tab: Tab, tmp_path_factory: pytest.TempPathFactory) -> Report:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page, encoding="utf-8")
    return Report(tab, path)


@pytest.mark.parametrize(("width", "theme"), [(380, "dark"), (1400, "light")])
def test_every_panel_draws_narrow_and_wide_light_and_dark(
    report: Report, width: int, theme: str
) -> None:
    (panels,) = report.do(["all"], width=width, theme=theme)
    assert len(panels) >= 17
    for panel in panels:
        kinds = {op[0] for op in panel["ops"]}
        bars = panel["title"].startswith(
            ("Modes", "Drives", "Planner", "Source", "Harness s", "Injected")
        )
        assert {"path", "text"} <= kinds, panel["title"]
        assert ("rect" in kinds) == bars, panel["title"]
        for _, text, left, right, y in texts_of(panel):
            assert -1 <= left <= right <= panel["width"] + 1, (panel["title"], text)
            assert -1 <= y <= panel["height"] + 1, (panel["title"], text)


def texts_of(panel: dict[str, Any]) -> list[Any]:
    """Return what a panel has written: text, left and right edge, height."""
    return [op for op in panel["ops"] if op[0] == "text"]


def test_a_drag_zooms_all_panels_and_a_double_click_shows_the_whole_run(report: Report) -> None:
    (_, _, width, _), whole, zoomed, texts, at, back = report.do(
        ["box", "COM"], ["shown"], ["drag", "COM", A, B], ["texts", "Harness force"], ["times"],
        ["event", "COM", "dblclick", {}],
    )  # fmt: skip
    assert whole[0] < zoomed[0] < zoomed[1] < whole[1]
    fraction = (B - A) / width
    assert zoomed[1] - zoomed[0] == pytest.approx(fraction * (whole[1] - whole[0]), rel=0.01)
    times = [float(text.removesuffix(" s")) for text in texts if text.endswith(" s")]
    assert times
    assert all(zoomed[0] <= t <= zoomed[1] for t in times)
    assert "\u0394t" not in at, "the end of a drag is no click: it pins nothing"
    assert back[0] == whole


def test_a_finger_zooms_as_the_mouse_does(report: Report) -> None:
    (swiped,) = report.do(["swipe", "COM", A, B])
    (dragged,) = report.do(["drag", "COM", A, B])
    assert swiped == dragged


def test_the_wheel_zooms_at_the_cursor_with_ctrl_and_scrolls_the_page_without(
    report: Report,
) -> None:
    wheel = {"deltaY": -1, "x": B}
    whole, plain, zoomed = report.do(
        ["shown"], ["event", "COM", "wheel", wheel],
        ["event", "COM", "wheel", wheel | {"ctrlKey": True}],
    )  # fmt: skip
    assert plain == [whole, False]
    assert zoomed[1] is True
    assert zoomed[0][1] - zoomed[0][0] < whole[1] - whole[0]


def test_the_wheel_sideways_or_with_shift_moves_the_time_shown(report: Report) -> None:
    wheel = {"x": B, "deltaX": 0, "deltaY": 0}
    zoomed, sideways, shifted = report.do(
        ["drag", "COM", A, B],
        ["event", "COM", "wheel", wheel | {"deltaX": 50}],
        ["event", "COM", "wheel", wheel | {"deltaY": -50, "shiftKey": True}],
    )  # fmt: skip
    length = zoomed[1] - zoomed[0]
    assert sideways[1] is True
    assert sideways[0][0] == pytest.approx(zoomed[0] + 0.05 * length, abs=0.002)
    assert shifted[0] == pytest.approx(zoomed, abs=0.002)


def test_the_legends_show_the_values_at_the_cursor_in_every_panel(report: Report) -> None:
    time, angles, modes, cursors, _, after = report.do(
        ["hover", "COM", A], ["legend", "Torso angles"], ["legend", "Modes"],
        ["cursors", "Height"], ["event", "COM", "mouseleave", {}], ["legend", "Torso angles"],
    )  # fmt: skip
    assert time.startswith("t = ")
    assert angles[0][0] == "roll"
    assert all(value for _, value in angles)
    assert [name for name, _ in modes] == list(MODULES)
    assert {value for _, value in modes} <= {"HOLD", "TRACK"}
    assert cursors == [None, A]
    assert not any(value for _, value in after)


@pytest.mark.parametrize("key", ["", "Enter", " "])
def test_the_legend_hides_a_line_and_shows_it_again(report: Report, key: str) -> None:
    before, off, fewer, on, again = report.do(
        ["lines", "Torso angles"], ["toggle", "Torso angles", 0, key],
        ["lines", "Torso angles"], ["toggle", "Torso angles", 0, key], ["lines", "Torso angles"],
    )  # fmt: skip
    assert (off, on) == ("false", "true")
    assert len(fewer) < len(before)
    assert again == before


def test_a_choice_of_joint_is_that_of_all_its_panels_and_keeps_hidden_lines(
    report: Report,
) -> None:
    first, _, before, second, after = report.do(
        ["choose", "Torque of one", 7], ["toggle", "Torque of one", 0],
        ["lines", "Torque of one"], ["choose", "Angle of one", 2], ["lines", "Torque of one"],
    )  # fmt: skip
    assert first == [7, 7, 7]
    assert second == [2, 2, 2]
    assert {colour for colour, _ in after} == {colour for colour, _ in before}


def test_the_keyboard_moves_the_cursor_and_the_time(report: Report) -> None:
    def key(name: str, **held: bool) -> list[Any]:
        return ["event", "COM", "keydown", {"key": name, **held}]

    whole, zoomed, panned, cursor, at, back, unused = report.do(
        ["shown"], key("+"), key("ArrowRight", shiftKey=True), key("ArrowLeft"),
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


def test_a_click_in_the_timeline_shows_and_pins_its_time(report: Report, page: str) -> None:
    t = page.partition('class="kill"><button type="button" data-t="')[2].partition('"')[0]
    shown, label, modes, at = report.do(
        ["press", "t", t], ["texts", "COM"], ["legend", "Modes"], ["times"]
    )
    assert shown == pytest.approx([float(t) - 0.5, float(t) + 1.5], abs=0.002)
    assert "planner KILL" in label
    assert ["ankle_right", "TRACK"] in modes
    assert at == f"t = {float(t):.3f} s \u00b7 planner KILL"


def test_the_time_shown_can_be_typed_and_stays_in_the_run(report: Report) -> None:
    whole, typed, beyond = report.do(["shown"], ["type", "to", "1.5"], ["type", "from", "-9"])
    assert typed[1] == pytest.approx(1.5, abs=0.002)
    assert beyond[0] >= whole[0] - 0.001


def test_a_peak_is_drawn_at_every_zoom(report: Report) -> None:
    """The value axis covers what is shown and 6 % more, and the lines reach both extremes."""
    for a, b in ((100, 700), (A, B), (150, 250)):
        _, (left, top, width, height), lines = report.do(
            ["drag", "Height", a, b], ["box", "Height"], ["lines", "Height"]
        )
        paths = [path for colour, path in lines if colour in ("#0b5fa5", "#c4501b")]
        assert len(paths) == 2, "torso and COM"
        heights = [y for path in paths for _, x, y in path if left <= x <= left + width]
        pad = 0.06 / 1.12 * height
        assert min(heights) == pytest.approx(top + pad, abs=1.5)
        assert max(heights) == pytest.approx(top + height - pad, abs=1.5)


def test_a_lone_sample_between_two_gaps_is_a_point(
    report: Report, log: RunLog, tmp_path: Path
) -> None:
    """The planner is killed at 1 s and back at 1.8 s; no line passes through a sample between."""
    run = RunData(log)
    status = log.messages(topics.PLANNER_STATUS)[-1]
    t_ns = run.zero_ns + 1_400_000_000
    body = msgspec.json.encode(msgspec.structs.replace(status, t_ns=t_ns, margin=0.7))
    path = tmp_path / "lone.html"
    with_sample = runs.changed(log, more=[(t_ns, topics.PLANNER_STATUS.name, body)])
    path.write_text(render(with_sample), encoding="utf-8")
    points, lines = Report(report.tab, path).do(["points", "Certificate"], ["lines", "Certificate"])
    assert [colour for colour, _ in points] == ["#0b5fa5", "#c4501b"]
    assert len(points[0][1]) == 2, "one circle: a move and an arc"
    assert lines


def test_an_age_of_seconds_does_not_flatten_the_others(report: Report) -> None:
    (texts,) = report.do(["texts", "Command age"])
    ages = [float(text) for text in texts if text.replace(".", "").replace("-", "").isdigit()]
    assert max(ages) <= 200.0
    assert "HOLD" in texts


def test_a_click_pins_the_cursor_and_the_bar_shows_the_time_from_there(report: Report) -> None:
    def press(key: str) -> list[Any]:
        return ["event", "COM", "keydown", {"key": key}]

    _, pinned, _, stays, values, apart, marked, _, gone, whole, _, removed = report.do(
        ["hover", "COM", A], ["click", "COM", A], ["event", "COM", "mouseleave", {}],
        ["times"], ["legend", "Torso angles"],
        ["hover", "COM", B], ["cursors", "Height"],
        press("Escape"), ["cursors", "Height"], press("Escape"),
        ["click", "COM", A], ["click", "COM", A],
    )  # fmt: skip
    assert pinned.startswith("t = ")
    assert stays == pinned, "the pin stays when the pointer leaves"
    assert values[0][1], "and so do the values"
    assert "\u0394t = +" in apart
    assert marked == pytest.approx([A, B]), "pin and cursor, in every panel"
    assert gone == pytest.approx([None, B])
    assert whole[1] is True
    assert "\u0394t" not in removed, "a second click at the pin removes it"


def test_the_cursor_does_not_draw_the_plots_again(report: Report) -> None:
    """Drawing lines of thousands of points again would delay each move of the cursor."""
    before, _, _, after, _, zoomed = report.do(
        ["drawings"], ["hover", "COM", A], ["hover", "COM", B], ["drawings"],
        ["drag", "COM", A, B], ["drawings"],
    )  # fmt: skip
    assert after == before
    assert all(more > count for more, count in zip(zoomed, after, strict=True))


def test_the_list_of_panels_goes_to_a_panel(report: Report) -> None:
    titles, third = report.do(["titles"], ["goto", 3])
    assert third.startswith(titles[2])


def test_limits_are_named_in_the_plot_whose_lines_come_close(report: Report) -> None:
    torque, tilt, command = report.do(
        ["texts", "Torque of each"], ["texts", "Tilt of"], ["texts", "Command age"]
    )
    assert "limit" in torque
    assert "HOLD" in command
    assert "planner leading" not in tilt, "a limit far off does not flatten the line"


def test_a_screen_reader_gets_the_range_of_every_line(report: Report) -> None:
    lines, bars = report.do(["description", "Torso angles"], ["description", "Modes"])
    assert lines.startswith("Torso angles: roll from ")
    assert "; pitch from " in lines
    assert "ankle_right, " in bars


def test_no_time_is_cut_off_at_the_edge(report: Report) -> None:
    """The time shown ends with a round number, which has no room on a narrow screen."""
    _, _, (panel, *_) = report.do(["type", "from", "1"], ["type", "to", "2"], ["all"], width=380)
    times = [op for op in texts_of(panel) if op[1].endswith(" s")]
    assert len(times) > 2
    assert all(right <= panel["width"] for _, _, _, right, _ in times)


def test_a_print_draws_every_panel_with_the_pin(report: Report) -> None:
    plain, _, pinned = report.do(["print"], ["click", "COM", A], ["print"])
    assert all(count > 5 and not pin for count, pin in plain)
    assert all(count > 5 and pin for count, pin in pinned)


@pytest.mark.parametrize("width", WIDTHS)
def test_every_panel_is_drawn_and_no_element_exceeds_the_width_of_the_screen(
    page: str, report: Report, tmp_path: Path, width: int
) -> None:
    """With all details open; tables and files scroll inside their own area."""
    path = tmp_path / "open.html"
    path.write_text(page.replace("<details>", "<details open>"), encoding="utf-8")
    Report(report.tab, path).do(width=width)
    assert report.tab.run(report.tab.page.value(EMPTY)) == 0
    row = json.loads(report.tab.run(report.tab.page.value(LOOK)))
    assert row["panels"] >= 20
    assert float(row["shown"]) > 3.9
    assert row["page"] == row["width"] <= width
    assert row["wider"] == []
    assert row["cut"] == []
