"""What `xrl hosts check` asks a host: one line of JSON, then its clock for each line it is sent.

python -m tools.hosts.probe --config /etc/xrl/robot.toml
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import subprocess
import sys
import time
from pathlib import Path

import msgspec

from shared.bus.credentials import keys_folder
from shared.config import files as config_file
from shared.exceptions import XrlError
from shared.process import CHECKOUT
from shared.robot import gain_schedule
from tools.keys.inspection import look


class Probe(msgspec.Struct, frozen=True):
    """What a host says of itself."""

    revision: str
    """Of the checkout, by git; "+": with changes. Empty: not known."""
    lock: str
    """Hash of what the environment was made from."""
    python: str
    robot: str
    """Hash of the robot file."""
    schedule: str
    """Hash of the gain schedule; empty: there is none."""
    wrong: tuple[str, ...]
    """What keeps the services from starting: the robot file, keys."""
    warnings: tuple[str, ...]


def probe(config: Path) -> Probe:
    """Look at this host."""
    wrong, warnings = [], []
    try:
        robot = config_file.load(config)
        for row in look(keys_folder(robot), robot):
            wrong += [f"{row.name}: {row.wrong}"] if row.wrong else []
            warnings += [f"{row.name}: {row.warning}"] if row.warning else []
    except XrlError as error:
        wrong.append(str(error))
    return Probe(
        revision=_revision(),
        lock=_hash_of(CHECKOUT / "requirements.runtime.lock"),
        python=platform.python_version(),
        robot=_hash_of(config),
        schedule=_hash_of(gain_schedule.path_beside(config)),
        wrong=tuple(wrong),
        warnings=tuple(warnings),
    )


def digest(content: bytes) -> str:
    """Return the hash by which files of several hosts are compared."""
    return hashlib.sha256(content).hexdigest()[:16]


def _hash_of(path: Path) -> str:
    try:
        return digest(path.read_bytes())
    except OSError:
        return ""


def _revision() -> str:
    words = ["git", "-c", f"safe.directory={CHECKOUT}", "-C", str(CHECKOUT), "describe"]
    words += ["--always", "--dirty=+", "--abbrev=12"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def main() -> None:
    """Print what there is to say, then answer until the input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    args = parser.parse_args()
    sys.stdout.write(msgspec.json.encode(probe(args.config)).decode() + "\n")
    sys.stdout.flush()
    for _ in sys.stdin:
        sys.stdout.write(f"{time.time_ns()}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
