"""The page in a real Chromium, if one is installed: led, pushed, killed, stopped, scrubbed."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from shared.places import DEFAULT_CONFIG
from tests.tools.view.browser import BROWSER, Page, browser
from tests.tools.view.test_record_source import LOG
from tools import cli
from tools.live.experiment import load_robot
from tools.logs.run_log import read_run, robot_of
from tools.view.frame import Source
from tools.view.lockstep import LockstepSource
from tools.view.record import RecordFrames
from tools.view.server import ViewServer

pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="needs a Chromium"),
    pytest.mark.timeout(180),
]

HEIGHT = "Number(document.getElementById('height')?.textContent)"
MODES = "document.getElementById('modules')?.textContent ?? ''"
WIDE = """JSON.stringify([...document.querySelectorAll('body *')].filter((node) => {
  const { left, right, width } = node.getBoundingClientRect();
  return width > 0 && (right > innerWidth + 0.5 || left < -0.5);
}).map((node) => node.tagName + node.id))"""


def with_page(source: Source, work: Callable[[Page, str], Awaitable[None]]) -> None:
    async def main() -> None:
        server = ViewServer(source, 0)
        async with server.running(), browser() as page:
            await work(page, server.address)
            assert page.complaints == []

    asyncio.run(main())


@pytest.fixture(scope="module")
def lockstep() -> Any:
    """Return a robot for all of it; the test that stops it comes last."""
    made = LockstepSource(load_robot(DEFAULT_CONFIG))
    yield made
    made.close()


@pytest.fixture(scope="module")
def recorded() -> RecordFrames:
    log = read_run(LOG)
    return RecordFrames(log, robot_of(log))


def button(order: str) -> str:
    return f"document.querySelector('[data-service=planner][data-order={order}]').click()"


async def drag(
    page: Page, x: float, y: float, dx: float, dy: float, *, shift: bool = False
) -> None:
    """Press at a place, go on by so much, and hold."""
    await page.mouse("down", x, y, shift=shift)
    for part in range(1, 11):
        await page.mouse("move", x + dx * part / 10, y + dy * part / 10, shift=shift)


def force_of(source: LockstepSource) -> tuple[float, float, float]:
    frame = source.frame()
    return frame.push if frame is not None else (0.0, 0.0, 0.0)


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(30.0):
        while not holds():
            await asyncio.sleep(0.01)


async def scrub_and_play(page: Page, source: RecordFrames, picture: Path) -> None:
    """Look at a record near its end, and play it from there."""
    end_s = source.model.end_s
    wanted = source.at(end_s - 0.2)
    assert wanted is not None
    place = "document.getElementById('place')"
    await page.until(f"{place}?.max", lambda text: text not in (None, "", "100"))
    await page.value(f"{place}.value = {end_s - 0.2}; {place}.dispatchEvent(new Event('input'))")
    await page.until(HEIGHT, lambda at: at is not None and abs(at - wanted.torso[2]) < 0.002)
    await page.until(MODES, lambda text: text.count("TRACK") + text.count("HOLD") == 6)
    marks = await page.value("document.querySelectorAll('#marks i').length")
    assert marks == len(source.model.marks)
    await page.value("document.getElementById('play').click()")
    await page.until(f"Number({place}.value)", lambda at: abs(at - end_s) < 0.02)
    await page.until("document.getElementById('play').textContent", lambda text: text == "▶")
    await page.picture(picture)


def test_a_record_in_one_file_opens_without_a_server_and_is_scrubbed_and_played(
    recorded: RecordFrames, tmp_path: Path
) -> None:
    file = tmp_path / "run.html"
    assert cli.main(["view", str(LOG), "--html", str(file)]) == 0
    text = file.read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:)', text), "it loads nothing"

    async def main() -> None:
        async with browser() as page:
            await page.open(file.as_uri())
            await scrub_and_play(page, recorded, tmp_path / "file.png")
            assert page.complaints == []

    asyncio.run(main())


@pytest.mark.parametrize(("width", "height"), [(1400, 800), (400, 800)])
def test_nothing_is_cut_off_on_a_wide_or_a_narrow_screen(
    lockstep: LockstepSource, width: int, height: int
) -> None:
    async def work(page: Page, address: str) -> None:
        await page.open(address, width, height)
        await page.until(MODES, lambda text: text.count("TRACK") == 6, 60.0)
        assert json.loads(await page.value(WIDE)) == []

    with_page(lockstep, work)


def test_a_person_leads_pushes_kills_and_stops_it_with_the_mouse(
    lockstep: LockstepSource, tmp_path: Path
) -> None:
    async def work(page: Page, address: str) -> None:
        await page.open(address)
        await page.until(MODES, lambda text: text.count("TRACK") == 6, 60.0)
        # it is grasped twice at one place, where its torso is while it stands still
        await drag(page, 665.0, 185.0, 80.0, 0.0, shift=True)
        await until(lambda: any(force_of(lockstep)))
        await page.mouse("up", 745.0, 185.0, shift=True)
        await until(lambda: not any(force_of(lockstep)))
        begin = await page.value(HEIGHT)
        await drag(page, 665.0, 185.0, 0.0, 90.0)  # where the hand's arrow is, too
        low = await page.until(HEIGHT, lambda height: height < begin - 0.2)
        await page.mouse("move", 665.0, 215.0)
        await page.until(HEIGHT, lambda height: height > low + 0.05)
        await page.mouse("up", 665.0, 215.0)
        pushed = "document.getElementById('plots').querySelectorAll('canvas').length"
        assert await page.value(pushed) == 8
        await page.value(button("kill"))
        await page.until(MODES, lambda text: text.count("HOLD") == 6)
        await page.until("document.getElementById('mode').textContent", lambda w: w == "silent")
        await page.value(button("start"))
        await page.until(MODES, lambda text: text.count("TRACK") == 6)
        await page.key("ArrowDown")
        await page.value("document.getElementById('estop').click()")
        await page.until(MODES, lambda text: text.count("DAMP") == 6)
        await page.picture(tmp_path / "stopped.png")
        assert (tmp_path / "stopped.png").stat().st_size > 20_000

    with_page(lockstep, work)
