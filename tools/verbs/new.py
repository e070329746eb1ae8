"""`xrl new`: creates a directory with a robot's files, which the user edits."""

from __future__ import annotations

import shlex
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Final

from services.simulator.physics import plant
from shared.exceptions import RunError
from shared.places import FILES, ROBOT_FILE, SCENARIOS
from tools import graph_libraries
from tools.flags import Flags, positional

HOSTS_FILE: Final = "hosts.example.toml"
_ABOUT_PLANTS: Final = (
    "# How the true robot differs from robot.toml, for the simulator: --plant plants/{}.toml\n"
    "# Missing keys have the values of `realistic`, the default without --plant.\n"
)


EXAMPLES: Final = """
xrl new lab                     # then: cd lab; every verb finds robot.toml there
"""


class NewFlags(Flags):
    """Directory for a robot."""

    directory: Annotated[Path, positional("DIR")]
    """new or empty directory"""


def run(flags: NewFlags) -> int:
    """Copy all shipped files, or none, and print the next steps."""
    with _filled(flags.directory) as scratch:
        for name, content in contents().items():
            path = scratch / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
    print(_what_next(flags.directory))
    return 0


def contents() -> dict[str, bytes]:
    """Return the files of a robot's directory by name; the robot file comes last."""
    names = [ROBOT_FILE.replace(".toml", ".gains.json"), HOSTS_FILE]
    copied = [FILES / name for name in names] + sorted(SCENARIOS.glob("*.toml"))
    files = {path.relative_to(FILES).as_posix(): path.read_bytes() for path in copied}
    for name, values in plant.NAMED.items():
        text = _ABOUT_PLANTS.format(name) + plant.to_toml(values)
        files[f"plants/{name}.toml"] = text.encode()
    return files | {ROBOT_FILE: (FILES / ROBOT_FILE).read_bytes()}


@contextmanager
def _filled(directory: Path) -> Iterator[Path]:
    """Yield a folder whose contents move into the directory if the block succeeds.

    Otherwise the directory is left empty or absent, as it was found.
    """
    made = _made(directory)
    moved: list[Path] = []
    try:
        with tempfile.TemporaryDirectory(prefix=".new-", dir=directory) as name:
            yield Path(name)
            for path in sorted(Path(name).iterdir(), key=lambda path: path.name == ROBOT_FILE):
                moved.append(directory / path.name)
                path.rename(moved[-1])
    except BaseException:
        for path in moved:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        if made:
            with suppress(OSError):
                directory.rmdir()
        raise


def _made(directory: Path) -> bool:
    """Create the directory and return True; return False if it exists and is empty."""
    try:
        directory.mkdir()
    except FileNotFoundError:
        raise RunError(f"{directory}: {directory.parent} does not exist; create it first") from None
    except FileExistsError:
        if not directory.is_dir():
            raise RunError(f"{directory}: not a directory; give a new or empty one") from None
        if not any(directory.iterdir()):
            return False
        right = "no file in it was changed; give a new or empty directory"
        raise RunError(f"{directory}: not empty; {right}") from None
    return True


def _what_next(directory: Path) -> str:
    lines = [
        f"{directory}: {ROBOT_FILE}, its gain schedule, scenarios, plants, {HOSTS_FILE}",
        "next steps:",
        f"  cd {shlex.quote(str(directory))}",
        "  xrl sim                                  # every verb finds robot.toml here",
        "  xrl sim --scenario crawl --plant plants/ideal.toml",
        "  xrl gains                                # after a change of masses, lengths or limits",
    ]
    if shutil.which("cc"):
        lines += [
            "to compile the law to C, which is faster, run this after each change of robot.toml:",
            f"  {graph_libraries.command()}",
        ]
    return "\n".join(lines)
