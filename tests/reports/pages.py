"""Reads a page back: its data, its signals."""

from __future__ import annotations

import base64
import json
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1])


def panel(data: dict[str, Any], title: str) -> dict[str, Any]:
    return next(panel for panel in data["panels"] if panel["title"] == title)


def unpacked(signal: dict[str, Any]) -> tuple[Array, Array]:
    """Return times and values as the page's script sees them; NaN where the line breaks."""
    codes = np.frombuffer(base64.b64decode(signal["d"]), "<i2").astype(np.int64)
    t = signal["t0"] + (np.arange(len(codes)) + 0.5) * signal["h"]
    values = signal["lo"] + (codes + 32766) * signal["step"]
    values[codes == -32767] = np.nan
    there = codes != -32768
    return t[there], values[there]


def line(data: dict[str, Any], title: str, label: str) -> tuple[Array, Array]:
    lines = panel(data, title)["lines"]
    return unpacked(data["signals"][next(x for x in lines if x["label"] == label)["signal"]])
