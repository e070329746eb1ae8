"""The page in a real browser, if one is installed: errors, drawing, narrow screens."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from tests.tools.view.browser import BROWSER, browser

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


@pytest.fixture(scope="module")
def seen(page: str, tmp_path_factory: pytest.TempPathFactory) -> dict[int, dict[str, Any]]:
    """Properties of the page at each width, with all details open."""
    file = tmp_path_factory.mktemp("browser") / "page.html"
    file.write_text(page.replace("<details>", "<details open>"), encoding="utf-8")

    async def main() -> dict[int, dict[str, Any]]:
        found = {}
        async with browser() as tab:
            for width in WIDTHS:
                await tab.open(file.as_uri(), width, 900)
                drawn = f"document.querySelectorAll('.panel').length >= 20 && {EMPTY} === 0"
                await tab.until(drawn)
                found[width] = json.loads(await tab.value(LOOK))
            assert tab.complaints == [], "also what the page's own policy forbids"
        return found

    return asyncio.run(main())


@pytest.mark.parametrize("width", WIDTHS)
def test_every_panel_is_drawn_and_no_element_exceeds_the_width_of_the_screen(
    seen: dict[int, dict[str, Any]], width: int
) -> None:
    """Tables and files scroll inside their own area."""
    row = seen[width]
    assert row["panels"] >= 20
    assert float(row["shown"]) > 3.9
    assert row["page"] == row["width"] <= width
    assert row["wider"] == []
    assert row["cut"] == []
