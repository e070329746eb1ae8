"""The stand-in for libusb: built where a C compiler is, and put in place of the system's."""

from __future__ import annotations

import os
import socket
import subprocess
from pathlib import Path

import pytest

from services.simulator.fronts import usb_standin
from shared.exceptions import FleetError
from shared.run_directory import live_dir


def test_it_compiles_without_a_warning(tmp_path: Path) -> None:
    command = ["cc", "-std=gnu11", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-c"]
    subprocess.run([*command, "-o", tmp_path / "o", usb_standin.SOURCE], check=True)


def test_it_is_built_once_and_again_when_its_source_is_newer(tmp_path: Path) -> None:
    library = usb_standin.build(tmp_path)
    assert library == tmp_path / usb_standin.SONAME
    inode = library.stat().st_ino
    assert usb_standin.build(tmp_path).stat().st_ino == inode
    os.utime(library, (0, 0))
    assert usb_standin.build(tmp_path).stat().st_ino != inode
    assert list(tmp_path.iterdir()) == [library]


def test_without_a_compiler_the_fix_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FleetError, match="no C compiler `cc` is on PATH; install one"):
        usb_standin.build(tmp_path / "lib")


def test_what_a_compiler_complains_of_is_shown_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "cc"
    program.write_text("#!/bin/sh\necho no such header >&2; exit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(FleetError, match="no such header"):
        usb_standin.build(tmp_path / "lib")
    assert list((tmp_path / "lib").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "lib").write_text("a file")
    with pytest.raises(FleetError, match="a folder that can be written"):
        usb_standin.build(tmp_path / "lib")


def test_the_environment_leads_to_library_plugs_and_a_cache_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/lib")
    environment = usb_standin.prepare(tmp_path)
    first, _, rest = environment["LD_LIBRARY_PATH"].partition(":")
    assert (Path(first) / usb_standin.SONAME).is_file()
    assert rest == "/opt/lib"
    assert environment[usb_standin.VARIABLE] == str(live_dir(tmp_path) / usb_standin.FOLDER)
    assert Path(environment["XDG_CACHE_HOME"]).is_relative_to(tmp_path)


def test_clearing_leaves_nothing_but_what_is_not_the_fleets(tmp_path: Path) -> None:
    usb_standin.prepare(tmp_path)
    plugs = live_dir(tmp_path) / usb_standin.FOLDER
    plugs.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as plug:
        plug.bind(str(plugs / "3A0000000001"))
    (plugs / "notes.txt").write_text("mine")
    usb_standin.clear(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert [path.name for path in plugs.iterdir()] == ["notes.txt"]
    (plugs / "notes.txt").unlink()
    usb_standin.clear(tmp_path)
    assert not plugs.exists()
