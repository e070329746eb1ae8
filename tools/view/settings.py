"""Where a view is served and how often, and the files of its page."""

from __future__ import annotations

from pathlib import Path
from typing import Final

HOST: Final = "127.0.0.1"
PORT: Final = 8417
FOXGLOVE_PORT: Final = 8765
"""That Foxglove offers."""
FRAMES_S: Final = 30.0
PAGE: Final = Path(__file__).parent / "page"
UPLOT: Final = Path(__file__).parents[1] / "judge" / "reports" / "vendor" / "uplot"
