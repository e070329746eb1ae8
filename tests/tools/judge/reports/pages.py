"""Readers of a page: its data and its signals."""

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


def decode_signal(signal: dict[str, Any], grid: dict[str, float]) -> tuple[Array, Array]:
    """Return times and values as the page's script decodes them; NaN where the line breaks."""
    codes = np.frombuffer(base64.b64decode(signal["d"]), "<i2").astype(np.int64)
    assert signal["first"] + len(codes) <= grid["count"]
    t = grid["begin"] + (signal["first"] + np.arange(len(codes)) + 0.5) * grid["step"]
    values = signal["lo"] + (codes + 32766) * signal["step"]
    values[codes == -32767] = np.nan
    present = codes != -32768
    return t[present], values[present]


def line(data: dict[str, Any], title: str, label: str) -> tuple[Array, Array]:
    lines = panel(data, title)["lines"]
    index = next(line for line in lines if line["label"] == label)["signal"]
    return decode_signal(data["signals"][index], data["grid"])
