"""Check this host for `xrl hosts check`, and print the result as one line of JSON.

python -m tools.hosts.probe --config /etc/xrl/robot.toml --run-dir /var/lib/xrl/run
"""

from __future__ import annotations

import hashlib
import platform
import sys
from pathlib import Path
from typing import Final

import msgspec

from services.recorder.host_watch import MIB, free_bytes_at
from shared import scheduling
from shared.arguments import FlagParser
from shared.bus.credentials import NAMES, keys_folder
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.exceptions import XrlError
from shared.places import CHECKOUT, IS_CHECKOUT
from shared.revision import UNKNOWN, code
from tools.bringup.check_host import CLOCK_FIX, clock_is_synchronised
from tools.fleet.run_dir import SUPERVISOR_PID
from tools.keys.authority import held_files
from tools.keys.inspection import inspect_keys

FREE_MIB: Final = 4096
"""Free space below which a warning is given, MiB; an hour of recording takes 0.8 GiB."""
LOCKS: Final = ("requirements.lock", "requirements.runtime.lock")


class Probe(msgspec.Struct, frozen=True):
    """State of a host."""

    revision: str
    """Commit of the code, with "+" for local changes; empty if unknown."""
    lock: str
    """Hash of the lock file of the runtime environment."""
    python: str
    robot: str
    """Hash of the robot file."""
    schedule: str
    """Hash of the gain schedule; empty without one."""
    keys: dict[str, str]
    """Hashes of the key files, by name."""
    wrong: tuple[str, ...]
    """Faults of robot file or keys that keep the services from starting."""
    warnings: tuple[str, ...]


def probe(config: Path, run_dir: Path) -> Probe:
    """Check this host."""
    wrong, warnings, keys = [], [], dict[str, str]()
    try:
        robot = config_file.load(config)
        folder = keys_folder(robot)
        for row in inspect_keys(folder, robot):
            wrong += [f"{row.name}: {row.wrong}"] if row.wrong else []
            warnings += [f"{row.name}: {row.warning}"] if row.warning else []
        keys = {name: _hash_of(folder / name) for name in (NAMES, *held_files(folder))}
        if _is_older(run_dir / SUPERVISOR_PID, folder / NAMES):
            warnings.append("its services started before its accepted keys changed; restart them")
    except (XrlError, OSError) as error:
        wrong.append(str(error))
    if not IS_CHECKOUT:
        warnings.append(f"{CHECKOUT}: a wheel, not a checkout: the lock of its packages is unknown")
    elif not _environment_is_current():
        warnings.append(f"{CHECKOUT}: the environment does not match the code; run deploy/install")
    free_mib = free_bytes_at(run_dir) // MIB
    if free_mib < FREE_MIB:
        warnings.append(f"{free_mib} MiB free for records; delete old ones")
    if not clock_is_synchronised():
        warnings.append(f"its clock is not synchronised: {CLOCK_FIX}")
    pause_ms = scheduling.real_time_pause_ms()
    if pause_ms:
        warnings.append(
            f"if services fill a processor, the kernel stops them for {pause_ms:g} ms of each "
            f"second; run `sysctl {scheduling.NO_PAUSE}`"
        )
    return Probe(
        revision=_revision(),
        lock=_hash_of(CHECKOUT / "requirements.runtime.lock"),
        python=platform.python_version(),
        robot=_hash_of(config),
        schedule=_hash_of(gain_schedule.path_beside(config)),
        keys=keys,
        wrong=tuple(wrong),
        warnings=tuple(warnings),
    )


def digest(content: bytes) -> str:
    """Return a hash for comparing files of several hosts."""
    return hashlib.sha256(content).hexdigest()[:16]


def _hash_of(path: Path) -> str:
    try:
        return digest(path.read_bytes())
    except OSError:
        return ""


def _is_older(path: Path, other: Path) -> bool:
    """Return True if both files exist and the first is older."""
    try:
        return path.stat().st_mtime < other.stat().st_mtime
    except OSError:
        return False


def _environment_is_current() -> bool:
    """Return True if this environment was made from a lock file of the checkout (deploy/lib.sh)."""
    try:
        made_from = Path(sys.prefix, "xrl.stamp").read_text(encoding="utf-8").split()
        rest = (CHECKOUT / "pyproject.toml").read_bytes()
        locks = [(CHECKOUT / name).read_bytes() for name in LOCKS]
    except OSError:
        return False
    begin = f"{CHECKOUT}\n".encode()
    return made_from[:1] in [[hashlib.sha256(begin + lock + rest).hexdigest()] for lock in locks]


def _revision() -> str:
    found = code()
    if found["git_commit"] == UNKNOWN:
        return ""
    return found["git_commit"][:12] + ("+" if found["git_dirty"] == "true" else "")


def main() -> None:
    """Print the state of this host."""
    parser = FlagParser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--run-dir", type=Path, required=True)
    args = parser.parse_args()
    print(msgspec.json.encode(probe(args.config, args.run_dir)).decode())


if __name__ == "__main__":
    main()
