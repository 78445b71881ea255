"""Builds the firmware of the open regulator, and the program that runs it in simavr."""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from stiffopt.errors import DeviceError, InputError
from stiffopt.model.compiler import cache_directory

PACKAGES = "gcc make gcc-avr avr-libc libsimavr-dev libelf-dev"
"""Required Debian packages."""

_FILES = ("Makefile", "src", "avr", "simulator")
_COMMANDS = ("make", "gcc", "avr-gcc", "avr-size")
_HEADER = Path("/usr/include/simavr/sim_avr.h")


def firmware_directory() -> Path:
    """Return the folder of the firmware's source, in the package or in the checkout around it.

    Raises `InputError`: it is in neither.
    """
    package = Path(__file__).resolve().parent.parent
    for place in (package / "firmware", package.parent.parent / "firmware"):
        if (place / "Makefile").is_file():
            return place
    raise InputError("the firmware's source is missing; install stiffopt again")


def missing_tools() -> str:
    """Return what to install before firmware can be built and run; empty if nothing is missing."""
    if all(map(shutil.which, _COMMANDS)) and _HEADER.exists():
        return ""
    return (
        f"the open regulator's firmware cannot be built here; install {PACKAGES} (Debian's names)"
    )


def built_firmware(**settings: int) -> Path:
    """Return a folder with ``regulator.elf`` and ``board``, built once and then kept.

    `settings`: settings of the Makefile, such as ``PAIRS=0``. The environment variable
    ``STIFFOPT_FIRMWARE`` has precedence over them, in the same form. Raises `DeviceError`: a tool
    is missing, or the build fails.
    """
    if missing := missing_tools():
        raise DeviceError(missing)
    source = firmware_directory()
    files = sorted(f for name in _FILES for f in (source / name, *(source / name).rglob("*.[ch]")))
    words = [f"{name}={value}" for name, value in sorted(settings.items())]
    words += shlex.split(os.environ.get("STIFFOPT_FIRMWARE", ""))
    digest = hashlib.sha256(repr(words).encode())
    for file in files:
        if file.is_file():
            digest.update(file.name.encode() + file.read_bytes())
    target = cache_directory() / "firmware" / digest.hexdigest()[:16]
    if (target / "board").exists():
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    making = tempfile.mkdtemp(dir=target.parent)
    try:
        command = ["make", "--silent", "-C", str(source), "board", f"BUILD={making}", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise DeviceError(f"the firmware cannot be built: {done.stderr.strip()[-500:]}")
        if not target.exists():  # another process may have been first
            os.replace(making, target)
    finally:
        shutil.rmtree(making, ignore_errors=True)
    return target
