"""A run as one HTML file that opens anywhere: the page, its scripts, and its frames in it."""

from __future__ import annotations

import base64
import gzip
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from shared.exceptions import RunError
from tools.view.record import RecordSource
from tools.view.settings import FRAMES_S, PAGE, UPLOT

_MODULES: Final = (
    "vendor/three/three.module.min.js", "recorded.js", "plots.js", "scene.js", "main.js",
)  # fmt: skip
"""Each after those that it imports."""
_LOADER: Final = """
const urls = {};
for (const node of document.querySelectorAll("script[data-module]")) {
  const text = node.textContent.replace(/from "(\\.[^"]+)"/g, (_, name) => `from "${urls[name]}"`);
  urls[node.dataset.module] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}
import(urls["./main.js"]);
"""


def single_file(source: RecordSource, done: Callable[[float], None] = lambda _s: None) -> bytes:
    """Return the page with a whole record in it."""
    model = source.model()
    count = round((model.end_s - model.begin_s) * FRAMES_S) + 1
    frames = []
    for number in range(count):
        frames.append(source.frame(min(model.end_s, model.begin_s + number / FRAMES_S)))
        done(number / FRAMES_S)
    if not any(frames):
        raise RunError(f"{source.title}: no moment at which all six modules were heard")
    model = msgspec.structs.replace(model, title=Path(model.title).name)  # no path of this machine
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
    """Return one of the page's files; a script's text must not end the script around it."""
    file = PAGE / name if not name.startswith("vendor/uplot/") else UPLOT / name.rpartition("/")[2]
    return file.read_text(encoding="utf-8").replace("</script", "<\\/script")


def _style(found: re.Match[str]) -> str:
    return f"<style>{_content(found[1])}</style>"


def _script(found: re.Match[str]) -> str:
    return f"<script>{_content(found[1])}</script>"


def _module(name: str) -> str:
    return f'<script type="text/plain" data-module="./{name}">{_content(name)}</script>\n'
