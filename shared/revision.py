"""Commit of this code: from git in a checkout, from a file in a wheel.

It uses only the standard library, because the wheel's build uses it too (`deploy/build_hook.py`).
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Final

from shared.places import CHECKOUT

UNKNOWN: Final = "unknown"
BUILT_FROM: Final = "shared/files/commit.json"
"""File in a wheel that names the commit it was built from."""

_GIT_TIMEOUT_S: Final = 5.0


def code(root: Path = CHECKOUT) -> dict[str, str]:
    """Return `git_commit` and `git_dirty` ("true"/"false"), of a checkout or of a wheel's origin.

    Both are "unknown" if git is missing, if the wheel was built without git, or if `root` is not
    the top of a git checkout with a commit (a wheel may be installed inside another checkout).
    """
    try:
        built_from: dict[str, str] = json.loads((root / BUILT_FROM).read_text(encoding="utf-8"))
    except OSError:
        return _checked_out(root)
    return built_from


def in_words(found: dict[str, str]) -> str:
    """Return a commit as text: twelve digits, and whether files were changed."""
    changed = " with changes" if found["git_dirty"] == "true" else ""
    return f"commit {found['git_commit'][:12]}{changed}"


def _checked_out(root: Path) -> dict[str, str]:
    unknown = {"git_commit": UNKNOWN, "git_dirty": UNKNOWN}
    top = _git(root, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != root.resolve():
        return unknown
    commit = _git(root, "rev-parse", "--verify", "HEAD")
    changes = _git(root, "status", "--porcelain")
    if commit is None or changes is None:
        return unknown
    return {"git_commit": commit, "git_dirty": "true" if changes else "false"}


def _git(root: Path, *arguments: str) -> str | None:
    """Return git's output, or None if git fails.

    Also works for a service that runs as another user in a checkout that belongs to root.
    """
    try:
        done = subprocess.run(
            ("git", "-c", f"safe.directory={root}", "-C", str(root), *arguments),
            capture_output=True,
            text=True,
            timeout=_GIT_TIMEOUT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
