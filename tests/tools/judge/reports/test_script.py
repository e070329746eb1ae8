"""The page in a real Chromium, if one is installed: linked zoom and cursor, and its layout."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from tests.tools.view.browser import BROWSER, FLAT, Page, browser

pytestmark = pytest.mark.skipif(BROWSER is None, reason="needs a Chromium")

IS_DRAWN = "typeof view !== 'undefined' && view.panels.length === 8"
SPANS = """JSON.stringify(view.panels.map(({ plot }) =>
  [plot.scales.x.min, plot.scales.x.max]))"""
CURSORS = "JSON.stringify(view.panels.map(({ plot }) => plot.posToVal(plot.cursor.left, 'x')))"
LEGENDS = """JSON.stringify(view.panels.map(({ plot }) =>
  [...plot.root.querySelectorAll('.u-series:not(.u-off) .u-value')].slice(1)
    .map((node) => node.textContent)))"""
EMPTY = """[...document.querySelectorAll("canvas")].filter((canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return !data.some((value) => value > 0);
}).length"""
WIDER = """JSON.stringify([...document.querySelectorAll("body *")]
  .filter((node) => !node.closest(".wide, pre, #timeline ol"))
  .filter((node) => {
    const { left, right, width } = node.getBoundingClientRect();
    return width > 0 && (right > document.documentElement.clientWidth + 0.5 || left < -0.5);
  }).map((node) => node.tagName + " " + node.className))"""


@pytest.fixture(scope="module")
def report(page: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def opened(report: Path, work: Callable[[Page], Awaitable[None]], width: int = 1400) -> None:
    async def main() -> None:
        async with browser(FLAT) as page:
            await page.open(report.as_uri(), width, 900)
            await page.until(IS_DRAWN)
            await work(page)
            assert page.complaints == [], "also what the page's own policy forbids"

    asyncio.run(main())


async def at(page: Page, fraction: float) -> tuple[float, float]:
    """Return a place in the second plot, px of the window; the page is scrolled to it."""
    box = await page.value(
        "(() => { const { over } = view.panels[1].plot; over.scrollIntoView({ block: 'center' });"
        "const { left, top, width } = over.getBoundingClientRect();"
        "return [left, top, width]; })()"
    )
    return box[0] + fraction * box[2], box[1] + 40.0


def test_a_drag_zooms_all_panels_and_a_double_click_shows_the_whole_run(report: Path) -> None:
    async def work(page: Page) -> None:
        (begin, end), *_ = json.loads(await page.value(SPANS))
        (x0, y), (x1, _) = await at(page, 0.25), await at(page, 0.5)
        await page.mouse("move", x0, y)
        await page.mouse("down", x0, y)
        await page.mouse("move", x1, y)
        await page.mouse("up", x1, y)
        spans = json.loads(await page.until(SPANS, lambda text: json.loads(text)[0][0] > begin))
        assert len({tuple(span) for span in spans}) == 1
        assert spans[0] == pytest.approx(
            [begin + 0.25 * (end - begin), begin + 0.5 * (end - begin)], abs=0.05
        )
        await page.value(
            "view.panels[3].plot.over.dispatchEvent(new MouseEvent('dblclick', { bubbles: true }))"
        )
        await page.until(SPANS, lambda text: json.loads(text)[0][0] < begin + 0.01)
        assert json.loads(await page.value(SPANS)) == [pytest.approx([begin, end])] * 8

    opened(report, work)


def test_the_cursor_is_in_every_panel_and_the_legends_show_the_values_there(report: Path) -> None:
    async def work(page: Page) -> None:
        x, y = await at(page, 0.5)
        await page.mouse("move", x, y)
        text = await page.until("document.getElementById('cursor').textContent")
        cursors = json.loads(await page.value(CURSORS))
        assert cursors == pytest.approx([float(text.split()[2])] * 8, abs=0.01)
        legends = json.loads(await page.value(LEGENDS))
        assert all(value for values in legends for value in values), legends

    opened(report, work)


def test_a_click_on_an_event_shows_its_time_in_the_plots(report: Path) -> None:
    async def work(page: Page) -> None:
        t = await page.value(
            "(() => { const row = document.querySelector('.kill button'); row.click();"
            "return Number(row.dataset.t); })()"
        )
        spans = json.loads(await page.value(SPANS))
        assert spans == [pytest.approx([t - 0.5, t + 1.5], abs=0.01)] * 8
        assert json.loads(await page.value(CURSORS)) == pytest.approx([t] * 8, abs=0.02)

    opened(report, work)


@pytest.mark.parametrize(("width", "theme"), [(380, "dark"), (1000, "light"), (1600, "light")])
def test_every_panel_is_drawn_and_nothing_is_wider_than_the_screen(
    report: Path, width: int, theme: str
) -> None:
    async def work(page: Page) -> None:
        scheme = [{"name": "prefers-color-scheme", "value": theme}]
        await page.call("Emulation.setEmulatedMedia", features=scheme)
        await page.until(EMPTY, lambda count: count == 0)
        assert json.loads(await page.value(WIDER)) == []

    opened(report, work, width)
