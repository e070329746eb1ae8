"""Run commands on a host with the system's ssh."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Final, NamedTuple, TypedDict, TypeVar, Unpack

from shared.exceptions import FleetError
from tools.guarded_streams import printable
from tools.hosts.hosts_file import Host, Hosts

R = TypeVar("R")

TIMEOUT_S: Final = 90.0
MARK: Final = "xrl-output-follows"
"""Line printed before a command's output: a host's .bashrc may print other lines first."""


class Said(NamedTuple):
    """Result of a command."""

    code: int
    out: str
    error: str


class _Manner(TypedDict, total=False):
    """Options of a command on a host."""

    content: bytes
    """Data for its standard input."""
    as_user: bool
    """True to run the command as the services' user, not as the login user."""
    timeout_s: float


class Remote:
    """One host, reached by ssh."""

    def __init__(self, hosts: Hosts, host: Host) -> None:
        self.host = host
        self._begin = [*hosts.ssh, host.ssh]
        # in a folder that every user may enter, because `find` returns to its start folder
        self._as_user = ["env", "-C", "/", "runuser", "-u", hosts.user, "--"]

    def run(self, *words: str, **manner: Unpack[_Manner]) -> Said:
        """Run a command without shell expansion, and wait for it. A failed command raises no error.

        Raises:
            FleetError: the host cannot be reached, or the command does not end in time.
        """
        timeout_s = manner.get("timeout_s", TIMEOUT_S)
        command, name = self._command(words, manner), self.host.name
        try:
            done = subprocess.run(
                command, input=manner.get("content", b""), capture_output=True, timeout=timeout_s,
                check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise FleetError(f"{name}: {words[0]}: did not end within {timeout_s:g} s") from None
        except OSError as error:
            raise FleetError(f"{name}: {command[0]}: {error.strerror}") from None
        errors = done.stderr.decode(errors="replace").strip()
        if done.returncode == 255:  # the exit code of ssh itself
            raise FleetError(f"{name}: {self.host.ssh} cannot be reached: {_last(errors)}")
        noise, mark, out = done.stdout.decode(errors="replace").partition(f"{MARK}\n")
        if not mark:
            text = f"the shell of {self.host.ssh} did not run the command: {_last(errors or noise)}"
            raise FleetError(f"{name}: {text}")
        return Said(done.returncode, out, errors)

    def follow(self, *words: str, tell: Callable[[str], None], **manner: Unpack[_Manner]) -> None:
        """Run a command, and pass each line of its output to `tell`.

        Raises:
            FleetError: the host cannot be reached, or the command fails.
        """
        pipe = subprocess.PIPE
        command, name = self._command(words, manner), self.host.name
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True
            )
        except OSError as error:
            raise FleetError(f"{name}: {command[0]}: {error.strerror}") from None
        with process:
            lines = iter(process.stdout or ())
            _skip_noise(lines)
            for line in lines:
                tell(f"{name}: {printable(line.rstrip())}")
            errors = process.stderr.read() if process.stderr is not None else ""
        if process.returncode != 0:
            raise FleetError(f"{name}: {_last(errors)}")

    def _command(self, words: Sequence[str], manner: _Manner) -> list[str]:
        """Return the local command that prints `MARK` and runs words on the host."""
        before = self._as_user if manner.get("as_user") else []
        return [*self._begin, f"echo {MARK}; {shlex.join([*before, *words])}"]

    def must(self, *words: str, **manner: Unpack[_Manner]) -> str:
        """Run a command that must succeed, and return its output."""
        said = self.run(*words, **manner)
        if said.code != 0:
            why = _last(said.error) or f"exit status {said.code}"
            raise FleetError(f"{self.host.name}: {shlex.join(words)[:120]}: {why}")
        return said.out

    def write(self, path: str, content: bytes, *, private: bool) -> None:
        """Write a file atomically; only the services' user can read a private file."""
        part, mode = shlex.quote(f"{path}.part"), 0o600 if private else 0o644
        script = (
            f"umask 077 && rm -f {part} && set -C && cat > {part} && chmod {mode:o} {part} && "
            f"mv {part} {shlex.quote(path)}"
        )
        self.must("sh", "-c", script, content=content, as_user=private)


def _skip_noise(lines: Iterable[str]) -> None:
    """Skip lines up to `MARK`, or to the end."""
    for line in lines:
        if line.endswith(f"{MARK}\n"):
            return


def on_all(
    remotes: Sequence[Remote],
    work: Callable[[Remote], R],
    tell: Callable[[str, R | FleetError], None] = lambda _name, _result: None,
) -> dict[str, R | FleetError]:
    """Run `work` on all hosts at once; return the result or the error of each."""

    def attempt(remote: Remote) -> R | FleetError:
        try:
            return work(remote)
        except FleetError as error:
            return error

    found: dict[str, R | FleetError] = {}
    with ThreadPoolExecutor(len(remotes)) as pool:
        names = {pool.submit(attempt, remote): remote.host.name for remote in remotes}
        for future in as_completed(names):
            found[names[future]] = future.result()
            tell(names[future], found[names[future]])
    return {remote.host.name: found[remote.host.name] for remote in remotes}


def _last(text: str) -> str:
    """Return the last line of a command's output, without control characters."""
    lines = [line for line in text.splitlines() if line.strip()]
    return printable(lines[-1]) if lines else "it printed nothing"
