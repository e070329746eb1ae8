"""Entry point of `xrl`: imports this project's packages, even if others have the same names.

`tools` and `shared` are common names: such a package in a folder of PYTHONPATH would be found
before ours, here and in every child process.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import PathFinder
from pathlib import Path

PACKAGES = ("services", "shared", "tools")
HERE = next(p for p in Path(__file__).resolve().parents if (p / PACKAGES[0]).is_dir())
"""Folder of our packages: the checkout's root or, if installed, this file's folder."""


def main() -> int:
    """Run the command line."""
    os.environ["PYTHONSAFEPATH"] = "1"  # our processes import nothing from their working directory
    if any(map(_is_hidden, PACKAGES)):
        sys.path.insert(0, str(HERE))
        before = os.environ.get("PYTHONPATH")
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(HERE), before)))
    from tools.cli import main as run  # noqa: PLC0415 - found only now

    return run()


def _is_hidden(package: str) -> bool:
    spec = PathFinder.find_spec(package)
    found = list(spec.submodule_search_locations or ()) if spec is not None else []
    return HERE / package not in [Path(place).resolve() for place in found]
