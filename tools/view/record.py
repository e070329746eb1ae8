"""Frames of a record at any time, in any order; and the page that contains a whole record."""

from __future__ import annotations

import base64
import gzip
import re
from collections.abc import Callable
from typing import Final

import msgspec

from shared.bus import topics
from shared.bus.messages import RunEventKind
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.judge.reports.events import events_of
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import NewestAt, RunLog
from tools.view.frame import (
    FRAMES_S,
    PAGE,
    SHOWN,
    UPLOT,
    Frame,
    Mark,
    Newest,
    model_of,
    without_fleet,
)


class RecordFrames:
    """Frames of a run's record, or of a part of it, at any time and in any order."""

    def __init__(self, log: RunLog, robot: RobotConfig) -> None:
        self._data = RunData(log)
        self._newest = Newest(robot)
        self._keys = [(t, m, log.newest(t, m)) for t, m in SHOWN if t is not topics.RUN_EVENT]
        stalls = [row for row in log.messages(topics.RUN_EVENT) if row.kind == RunEventKind.STALLED]
        stalls.sort(key=lambda row: row.t_ns)  # stamped at the stall's end, sent later
        self._keys.append((topics.RUN_EVENT, "", NewestAt(stalls)))
        span = self._data.span
        self.model = msgspec.structs.replace(
            model_of(robot, "record", log.path.name), begin_s=span.begin, end_s=span.end,
            marks=tuple(Mark(event.t, event.kind, event.text) for event in events_of(self._data)),
        )  # fmt: skip

    def at(self, t_s: float) -> Frame | None:
        """Return the frame at a time of the timeline; None until every module has sent a state."""
        t_ns = self._data.zero_ns + round(t_s * NS_PER_S)
        newest = self._newest
        newest.clear()
        for topic, module, messages in self._keys:
            message = messages.at(t_ns)
            if message is not None:
                newest.add(topic, module, message)
        found = newest.frame(t_ns)
        return None if found is None else without_fleet(msgspec.structs.replace(found, t_s=t_s))


_MODULES: Final = (
    "vendor/three/three.module.min.js", "recorded.js", "plots.js", "scene.js", "main.js",
)  # fmt: skip
"""Each module comes after those that it imports."""
_LOADER: Final = """
const urls = {};
for (const node of document.querySelectorAll("script[data-module]")) {
  const text = node.textContent.replace(/from "(\\.[^"]+)"/g, (_, name) => `from "${urls[name]}"`);
  urls[node.dataset.module] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}
import(urls["./main.js"]);
"""


def single_file(record: RecordFrames, done: Callable[[float], None] = lambda _s: None) -> bytes:
    """Return the page with a whole record in it, as one file."""
    model = record.model
    count = round((model.end_s - model.begin_s) * FRAMES_S) + 1
    frames = []
    for number in range(count):
        frames.append(record.at(min(model.end_s, model.begin_s + number / FRAMES_S)))
        done(number / FRAMES_S)
    if not any(frames):
        raise RunError(f"{model.title}: there is no time at which all six modules have a state")
    run = {"model": model, "frames": frames, "every_s": 1.0 / FRAMES_S}
    packed = base64.b64encode(gzip.compress(msgspec.json.encode(run), mtime=0)).decode()
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    page = re.sub(r'<link rel="stylesheet" href="([^"]+)">', _style, page)
    page = re.sub(r'<script src="([^"]+)"></script>', _script, page)
    modules = "".join(_module(name) for name in _MODULES)
    own = (
        f'<script type="text/plain" id="run">{packed}</script>\n{modules}<script>{_LOADER}</script>'
    )
    return page.replace('<script type="module" src="main.js"></script>', own).encode()


def _content(name: str) -> str:
    """Return one of the page's files, escaped so that it cannot end the script around it."""
    file = PAGE / name if not name.startswith("vendor/uplot/") else UPLOT / name.rpartition("/")[2]
    return file.read_text(encoding="utf-8").replace("</script", "<\\/script")


def _style(found: re.Match[str]) -> str:
    return f"<style>{_content(found[1])}</style>"


def _script(found: re.Match[str]) -> str:
    return f"<script>{_content(found[1])}</script>"


def _module(name: str) -> str:
    return f'<script type="text/plain" data-module="./{name}">{_content(name)}</script>\n'
