"""`xrl new`: a robot's own directory, to be changed and kept."""

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
    "# How the true robot differs from robot.toml; for the simulator: --plant plants/{}.toml\n"
    "# Keys that are left out are as in `realistic`, which the simulator takes without --plant.\n"
)


EXAMPLES: Final = """
xrl new lab                     # then: cd lab; every verb finds robot.toml there
xrl new .                       # here, if this directory is empty
"""


class NewFlags(Flags):
    """Where."""

    directory: Annotated[Path, positional("DIR")]
    """directory; made if absent, else it must be empty"""


def run(flags: NewFlags) -> int:
    """Copy the shipped files out, all or none, and say what comes next."""
    with _filled(flags.directory) as scratch:
        for name, content in contents().items():
            path = scratch / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
    print(_what_next(flags.directory))
    return 0


def contents() -> dict[str, bytes]:
    """Return the files of a robot's directory, by their names in it; the robot file comes last."""
    names = [ROBOT_FILE.replace(".toml", ".gains.json"), HOSTS_FILE]
    copied = [FILES / name for name in names] + sorted(SCENARIOS.glob("*.toml"))
    files = {path.relative_to(FILES).as_posix(): path.read_bytes() for path in copied}
    for name, values in plant.NAMED.items():
        text = _ABOUT_PLANTS.format(name) + plant.to_toml(values)
        files[f"plants/{name}.toml"] = text.encode()
    return files | {ROBOT_FILE: (FILES / ROBOT_FILE).read_bytes()}


@contextmanager
def _filled(directory: Path) -> Iterator[Path]:
    """Yield a folder whose contents become the directory's if the block ends well.

    Otherwise the directory is left as it was found: empty, or absent.
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
    """Make the directory and return True, or return False if it is there and empty."""
    try:
        directory.mkdir()
    except FileNotFoundError:
        raise RunError(f"{directory}: {directory.parent} does not exist; make it first") from None
    except FileExistsError:
        if not directory.is_dir():
            raise RunError(f"{directory}: not a directory; name a new or an empty one") from None
        if not any(directory.iterdir()):
            return False
        right = "nothing in it is replaced; name a new or an empty one"
        raise RunError(f"{directory}: not empty, and {right}") from None
    return True


def _what_next(directory: Path) -> str:
    lines = [
        f"{directory}: {ROBOT_FILE}, its gain schedule, scenarios, plants, {HOSTS_FILE}",
        "what next:",
        f"  cd {shlex.quote(str(directory))}",
        "  xrl sim                                  # every verb finds robot.toml here",
        "  xrl sim --scenario crawl --plant plants/ideal.toml",
        "  xrl gains                                # after a change of masses, lengths, limits",
    ]
    if shutil.which("cc"):
        lines += [
            "to run the law as C, which is faster, run this after each change of robot.toml:",
            f"  {graph_libraries.command()}",
        ]
    return "\n".join(lines)
