"""Files that the wheel contains besides the packages: data files, and the commit of the build."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FILES = (
    "robot.toml",
    "robot.gains.json",
    "processes.toml",
    "hosts.example.toml",
    "scenarios",
    "plants",
    "nftables",
    "sysctl",
    "udev",
)
"""Names in `deploy/`. A wheel installs them into `shared/files/`; `shared/places.py` finds both."""


class WheelFiles(BuildHookInterface):  # type: ignore[type-arg]  # hatchling names no configuration
    """Adds the files to a wheel; an editable install uses the checkout's own."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files to the build data."""
        root = Path(self.root)
        main = {str(root / "deploy" / "xrl_main.py"): "xrl_main.py"}
        if version == "editable":
            build_data["force_include_editable"] = main
            return
        sys.path.insert(0, self.root)
        from shared.revision import BUILT_FROM, code  # noqa: PLC0415 - found only now

        self._scratch = tempfile.TemporaryDirectory()
        commit = Path(self._scratch.name, "commit.json")
        commit.write_text(json.dumps(code(root)), encoding="utf-8")
        files = {str(root / "deploy" / name): f"shared/files/{name}" for name in FILES}
        build_data["force_include"] |= main | files | {str(commit): BUILT_FROM}

    def finalize(self, version: str, _build_data: dict[str, Any], _artifact: str) -> None:
        """Remove the temporary files of the build."""
        if version != "editable":
            self._scratch.cleanup()
