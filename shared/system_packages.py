"""Packages of the system that wheels do not bring."""

from __future__ import annotations

import shutil


def how_to_install(debian: str, fedora: str) -> str:
    """Return the command that brings a package of the system, as deploy/lib.sh names it."""
    if shutil.which("apt-get"):
        return f"`sudo apt-get install {debian}`"
    if shutil.which("dnf"):
        return f"`sudo dnf install {fedora}`"
    return f"your package manager (Debian: {debian}, Fedora: {fedora})"


def libusb_fix() -> str:
    """Return the command that brings libusb-1.0.so.0, which the `odrive` package loads."""
    return how_to_install("libusb-1.0-0", "libusb1")
