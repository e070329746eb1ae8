"""The page in a real browser, if one is installed: errors, drawing, narrow screens."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((found for name in NAMES if (found := shutil.which(name))), None)
WIDTHS = (380, 600, 1000, 1600)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=1700,1000", "--virtual-time-budget=20000", "--dump-dom",
)  # fmt: skip

LOOK = """
<script>
const errors = [];
addEventListener("error", (event) => errors.push(event.message));
addEventListener("securitypolicyviolation", (event) => errors.push(event.violatedDirective));
addEventListener("load", () => setTimeout(() => {
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
  const empty = [...document.querySelectorAll("canvas")].filter((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return !data.some((value) => value > 0);
  }).length;
  parent.postMessage(JSON.stringify({
    frame: window.innerWidth, width, page: root.scrollWidth, errors, wider, cut, empty,
    panels: document.querySelectorAll(".panel").length,
    shown: document.getElementById("to").value,
  }), "*");
}, 3000));
</script>
"""

pytestmark = pytest.mark.skipif(BROWSER is None, reason="needs a Chromium")


@pytest.fixture(scope="module")
def seen(page: str, tmp_path_factory: pytest.TempPathFactory) -> dict[int, dict[str, Any]]:
    """Properties of the page at each width: one browser, one frame for each width."""
    directory = tmp_path_factory.mktemp("browser")
    opened = page.replace("<details>", "<details open>").replace("<head>", f"<head>{LOOK}")
    (directory / "page.html").write_text(opened, encoding="utf-8")
    frames = "".join(
        f'<iframe src="page.html" width="{width}" height="900"></iframe>' for width in WIDTHS
    )
    (directory / "frames.html").write_text(
        "<!DOCTYPE html><style>iframe { border: 0; position: absolute; left: 0; top: 0 }</style>"
        f"{frames}<ol></ol><script>addEventListener('message', (event) => "
        "document.querySelector('ol').append(Object.assign(document.createElement('li'), "
        "{ textContent: event.data })))</script>",
        encoding="utf-8",
    )
    command = [str(BROWSER), *FLAGS, f"--user-data-dir={directory / 'user'}"]
    address = (directory / "frames.html").as_uri()
    done = subprocess.run(
        [*command, address], capture_output=True, text=True, check=False, timeout=240
    )
    found = [json.loads(unescape(row)) for row in re.findall(r"<li>(.*?)</li>", done.stdout)]
    assert len(found) == len(WIDTHS), done.stderr[-2000:]
    return {row["frame"]: row for row in found}


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_has_no_errors_and_every_panel_is_drawn(
    seen: dict[int, dict[str, Any]], width: int
) -> None:
    row = seen[width]
    assert row["errors"] == []
    assert row["panels"] >= 20
    assert row["empty"] == 0
    assert float(row["shown"]) > 3.9


@pytest.mark.parametrize("width", WIDTHS)
def test_no_element_exceeds_the_width_of_the_screen(
    seen: dict[int, dict[str, Any]], width: int
) -> None:
    """With all details open; tables and files scroll inside their own area."""
    row = seen[width]
    assert row["page"] == row["width"] <= width
    assert row["wider"] == []
    assert row["cut"] == []
