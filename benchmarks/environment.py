"""Describe the environment of a measurement: machine, versions, compiler, load."""

import os
import platform
import shutil
import subprocess
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = (
    "stiffopt", "casadi", "numpy", "daqp", "scipy", "pin-pink", "pin", "qpsolvers", "soromox",
    "jax", "jaxlib", "numba",
)  # fmt: skip


def environment() -> dict[str, str]:
    """What a reader needs to compare with another machine."""
    here = str(Path(__file__).parent)
    found = {
        "date": date.today().isoformat(),
        "processor": _processor(),
        "cores": str(_cores()),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "compiler": compiler(),
        "commit": _output("git", "-C", here, "describe", "--always", "--dirty"),
    }
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def load() -> float:
    """Mean number of running processes in the last minute; NaN where that is unknown."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def compiler() -> str:
    """First line of the version of the C compiler that stiffopt would take, or "none"."""
    given = os.environ.get("STIFFOPT_COMPILER") or os.environ.get("CC") or ""
    names = given.split()[:1] or ["cc", "gcc", "clang"]
    for name in names:
        if shutil.which(name):
            return _output(name, "--version").partition("\n")[0]
    return "none"


def _output(*command: str) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()
