"""Compilation of the simulator's inner loops by numba, with a cache keyed by content.

numba's own cache checks place and time stamp of one file, not of other files with functions that it
calls. Here the cache's folder is named after place, time stamp and text of all files with compiled
functions: changed code is never mixed with unchanged code, and an empty folder is one to be filled.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from stiffopt.errors import MissingExtraError, warn_slow

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

_REORDER = {"contract", "reassoc", "arcp", "nsz"}  # fast mathematics that preserves NaN and inf


@cache
def _folder() -> str:
    known = hashlib.sha256()
    for path in sorted(Path(__file__).resolve().parent.glob("*.py")):
        text = path.read_bytes()
        if b"@jit" in text:
            known.update(f"{path} {path.stat().st_mtime_ns} ".encode() + text)
    root = os.environ.get("STIFFOPT_CACHE_DIR") or Path.home() / ".cache" / "stiffopt"
    return str(Path(root) / "simulator" / known.hexdigest()[:16])


_done = False  # whether this process has compiled or loaded its functions


@contextmanager
def compiling_once() -> Iterator[None]:
    """Enclose the first use of compiled functions: one process compiles, others wait for it.

    It warns of the wait if the cache is empty.
    """
    global _done
    with _lock():
        if not _done and not any(Path(_folder()).rglob("*.nbi")):
            warn_slow("the simulator is compiled, once; that takes up to a minute")
        yield
        _done = True


@contextmanager
def _lock() -> Iterator[None]:
    if _done:
        yield
        return
    try:
        import fcntl

        handle = open(Path(_folder()) / "lock", "a")  # noqa: SIM115 (closed below)
    except (ImportError, OSError):  # no such locks, or no writable cache
        yield
        return
    with handle:
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def jit(function: FunctionT) -> FunctionT:
    """Compile a function when it is first called, without the interpreter's lock.

    Raises `MissingExtraError`: numba is not installed.
    """
    try:
        import numba
    except ImportError:
        raise MissingExtraError("numba", "sim") from None
    config: Any = numba.config
    compile_it: Any = numba.njit
    options = {"nogil": True, "fastmath": _REORDER, "error_model": "numpy"}
    before = config.CACHE_DIR  # a setting of the whole process: restore it for other packages
    try:
        config.CACHE_DIR = _folder()
        Path(config.CACHE_DIR).mkdir(parents=True, exist_ok=True)
        compiled = compile_it(cache=True, **options)(function)
    except (OSError, RuntimeError):  # no writable cache: compile once per process
        compiled = compile_it(**options)(function)
    finally:
        config.CACHE_DIR = before
    return compiled
