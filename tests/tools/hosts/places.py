"""Three hosts on one machine: a stand-in for ssh, with a root folder for each host.

What a command names in /etc, /run and /var is the host's own, and so is what programs read in
SHARED, by a mount in a namespace of the command's; `systemctl`, `runuser` and `install` are
scripts that do the little that `xrl hosts` needs of them.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import tomli_w

from shared.joints import MODULES
from shared.places import CHECKOUT

BODY = ["planner", "harness", "recorder"]
LEGS = {side: [m for m in MODULES if m.endswith(f"_{side}")] for side in ("right", "left")}

SSH = """#!/bin/bash
# HOST COMMAND: what is rooted on the host is looked for there
set -u
host=$1; shift
root={base}/$host
[ -d "$root" ] || {{ echo "ssh: connect to host $host: No route to host" >&2; exit 255; }}
command=$(sed -E "s#(^|[ '=])/(etc|run|var)/#\\1$root/\\2/#g" <<<"$*")
export PATH={base}/bin:$PATH ROOT=$root
cd "$root" || exit
[ -d "$root/{shared}" ] || exec bash -c "$command"
[ "$EUID" = 0 ] || user="--user --map-root-user"
exec unshare ${{user-}} --mount bash -c 'mount --bind "$1" "$2" && exec bash -c "$3"' - \\
  "$root/{shared}" "{base}/{shared}" "$command"
"""
SHARED = "etc-xrl"
"""Folder of robot file and keys of hosts whose services run: files name it."""

TOOLS = {
    "runuser": '[ "$PWD" = / ] || { echo "may not stay in $PWD" >&2; exit 1; }; '
    'while [ "$1" != -- ]; do shift; done; shift; exec "$@"',
    "install": (
        'words=(); while [ $# -gt 0 ]; do [ "$1" = -o ] && shift 2 && continue; '
        'words+=("$1"); shift; done; exec /usr/bin/install "${words[@]}"'
    ),
    "systemctl": """echo "systemctl $*" >>"$ROOT/calls"
unit=$ROOT/etc/systemd/system/xrl.service
line() { sed -e ':a' -e '/\\\\$/N; s/\\\\\\n *//; ta' "$unit" | sed -n "s/^$1=//p" |
  sed -E "s#(^| )/(etc|run|var)/#\\1$ROOT/\\2/#g"; }
pid=$(cat "$ROOT/var/lib/xrl/run/supervisord.pid" 2>/dev/null)
case "$1" in
  start) grep -qs '^State:.[RSD]' "/proc/$pid/status" && exit 0
    mkdir -p "$ROOT/var/lib/xrl"; cd "$ROOT/var/lib/xrl" && exec $(line ExecStart) ;;
  stop) cd / && exec $(line ExecStop) ;;
  is-active) [ -e "$ROOT/var/lib/xrl/run/supervisord.pid" ] && echo active || echo inactive ;;
esac
exit 0""",
}


def make_hosts(base: Path, *, running: bool = False) -> Path:
    """Make three hosts and return their hosts file.

    Args:
        base: an empty folder; a short path, for sockets are in it.
        running: their services are to run, so what files name has to be each host's own.
    """
    if running and not _may_mount():
        pytest.skip("no mount namespace here: each host is to have a folder of one name")
    (base / "bin").mkdir(parents=True)
    _script(base / "bin" / "ssh", SSH.format(base=base, shared=SHARED))
    for name, body in TOOLS.items():
        _script(base / "bin" / name, f"#!/bin/bash\n{body}\n")
    rows = []
    for number, (name, services) in enumerate({"body": BODY, **LEGS}.items(), start=2):
        for folder in ("etc/systemd/system", "run", "var/lib"):
            (base / name / folder).mkdir(parents=True)
        if running:
            (base / name / SHARED).mkdir()
        tools = ["operator"] if name == "body" else ["viewer"]
        rows.append(
            {"name": name, "address": f"127.0.0.{number}", "ssh": name, "services": services,
             "tools": tools}
        )  # fmt: skip
    if running:
        (base / SHARED).mkdir()
    file = base / "hosts.toml"
    table = {
        "host": rows,
        "first_port": 20_000 + os.getpid() % 20_000,
        "checkout": str(_checkout(base)),
        "folder": str(base / SHARED) if running else "/etc/xrl",
        "ssh": [str(base / "bin" / "ssh")],
    }
    file.write_text(tomli_w.dumps(table), encoding="utf-8")
    return file


@cache
def _may_mount() -> bool:
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    said = subprocess.run(["unshare", *user, "--mount", "true"], capture_output=True, check=False)
    return said.returncode == 0


def _checkout(base: Path) -> Path:
    """Return a folder with this environment where a host's is."""
    binaries = base / "co" / ".venv" / "bin"
    binaries.mkdir(parents=True)
    for name, words in (("python", ""), ("xrl", "-m tools.cli")):
        _script(
            binaries / name,
            f'#!/bin/bash\nPYTHONPATH={CHECKOUT} exec {sys.executable} {words} "$@"\n',
        )
    return base / "co"


def _script(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


def complaints_about(unit: Path) -> list[str]:
    """Return what systemd says of a unit."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    words = ["systemd-analyze", "verify", "--man=no", str(unit)]
    said = subprocess.run(words, capture_output=True, text=True, check=False)
    return [line for line in said.stderr.splitlines() if unit.name in line]
