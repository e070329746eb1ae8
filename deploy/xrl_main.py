"""Entry of the command `xrl`: this project's packages, whoever else has one of their names.

`tools` and `shared` are common names: a folder of PYTHONPATH that has such a package would be found
before ours, here and in every process that is started from here.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import PathFinder
from pathlib import Path

PACKAGES = ("services", "shared", "tools")
HERE = next(p for p in Path(__file__).resolve().parents if (p / PACKAGES[0]).is_dir())
"""Folder of our packages: a checkout's top, or beside this file where they are installed."""


def main() -> int:
    """Run the command line."""
    os.environ["PYTHONSAFEPATH"] = "1"  # no process of ours takes packages from where it is started
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
