"""CasADi functions as machine code, kept on disk by content.

`library` finds or makes a shared library; without a compiler, or a place to keep the code, it
gives a notice once and returns None, and `interpreted` serves the same calls from the CasADi VM.
Values are those of the VM to the last bit.

The cache (``STIFFOPT_CACHE_DIR``, else ``stiffopt`` in the user's cache directory) may be shared
by processes and removed at any time.  A library is entered by writing ``KEY-HASH.so`` and then
``KEY.json``, which holds the hash of the former, so that code which is not whole is never loaded.
"""

import ctypes
import hashlib
import json
import os
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import casadi as ca

from stiffopt.errors import SlowWarning
from stiffopt.model import native_build as build
from stiffopt.model.native_calls import BatchFunction, CompiledFunction, InterpretedFunction
from stiffopt.model.native_source import HEADER_NAME, Signature, c_code, dense, header

__all__ = [
    "BatchFunction",
    "CompiledFunction",
    "InterpretedFunction",
    "Library",
    "interpreted",
    "library",
]

Make = Callable[[], Sequence[ca.Function]]


class Library:
    """A loaded shared library.

    Attributes
    ----------
    path : Path
        Its file, for messages.
    cdll : ctypes.CDLL
        For what hand-written sources add; calls through it free the interpreter lock.
    """

    def __init__(self, path: Path, signatures: dict[str, Signature]) -> None:
        self.path = path
        self.cdll = ctypes.CDLL(str(path))
        self._signatures = signatures
        self._functions = {
            name: CompiledFunction(self.cdll[f"{name}_rows"], signature)
            for name, signature in signatures.items()
        }

    def function(self, name: str) -> CompiledFunction:
        """One of the CasADi functions in it."""
        return self._functions[name]


_lock = threading.RLock()
_loaded: dict[tuple[Path, str], Library | None] = {}
_notified = False


def library(
    content: str | Sequence[object],
    make: Make,
    sources: Sequence[str] = (),
    daqp: bool = False,
    build_missing: bool = True,
) -> Library | None:
    """Machine code of CasADi functions, from the cache or newly compiled.

    Parameters
    ----------
    content : str or sequence
        What identifies the functions, beside stiffopt's own code: text, or values whose `repr`
        says it all.
    make : callable
        Makes the functions; called only if they are not in the cache.  Their names are the names
        in C and must be told apart in capitals too.
    sources : sequence of str, optional
        Paths of C files compiled with them, which find prototypes and sizes in ``functions.h``
        (see `native_source.header`) and their own headers beside them.
    daqp : bool
        Whether those need the DAQP that comes with CasADi.
    build_missing : bool
        False: only look into the cache.

    Returns
    -------
    Library or None
        None where code cannot be had; the first time in a process a `SlowWarning` says why.
    """
    with _lock:
        try:
            cache = build.cache_directory()
            compiler = build.find_compiler(cache)
            key = _key(content, compiler, sources, daqp)
        except build.BuildError as error:
            if build_missing:
                _notify(error)
            return None
        if (cache, key) in _loaded:
            return _loaded[cache, key]
        found = _from_cache(cache, key)
        if found is None:
            if not build_missing:
                return None
            found = _built(cache, key, compiler, make, sources, daqp)
        _loaded[cache, key] = found
        return found


def interpreted(make: Make) -> dict[str, InterpretedFunction]:
    """The same functions in the CasADi VM, by name."""
    return {function.name(): InterpretedFunction(dense(function)) for function in make()}


# -- keys -----------------------------------------------------------------------------------


def _key(
    content: str | Sequence[object], compiler: build.Compiler, sources: Sequence[str], daqp: bool
) -> str:
    parts = [
        content if isinstance(content, str) else repr(tuple(content)),
        _own_code(),
        ca.__version__,
        build.platform(),
        repr(compiler.identity),
        repr(build.FLAGS),
        *(hashlib.sha256(text).hexdigest() for text in _source_texts(sources)),
        str(build.daqp_parts()[1]) if daqp else "",
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def _source_texts(sources: Sequence[str]) -> list[bytes]:
    """The sources and the headers beside them."""
    files = [Path(source) for source in sources]
    headers = {found for file in files for found in file.parent.glob("*.h")}
    return [file.read_bytes() for file in (*files, *sorted(headers))]


@lru_cache(maxsize=1)
def _own_code() -> str:
    """Hash of the code that functions come from; the version is part of it."""
    root = Path(__file__).parent.parent
    files = [*root.glob("*.py")]
    files += [file for part in ("model", "optimise") for file in (root / part).rglob("*.py")]
    total = hashlib.sha256()
    for file in sorted(files):
        total.update(f"{file.relative_to(root)}\0".encode())
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


# -- cache ----------------------------------------------------------------------------------


def _from_cache(cache: Path, key: str) -> Library | None:
    """The library if it is in the cache and whole."""
    try:
        entry = json.loads((cache / f"{key}.json").read_bytes())
        digest = str(entry["sha256"])
        signatures = {
            str(name): Signature.from_mapping(mapping)
            for name, mapping in entry["functions"].items()
        }
        path = _code_path(cache, key, digest)
        if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            return None
        return Library(path, signatures)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _code_path(cache: Path, key: str, digest: str) -> Path:
    return cache / f"{key}-{digest[:16]}.so"


def _built(
    cache: Path,
    key: str,
    compiler: build.Compiler,
    make: Make,
    sources: Sequence[str],
    daqp: bool,
) -> Library | None:
    try:
        with build.turn(cache / f"{key}.lock"):
            found = _from_cache(cache, key)  # another process may have come first
            if found is not None:
                return found
            functions = [dense(function) for function in make()]
            signatures = {function.name(): Signature.of(function) for function in functions}
            texts = {f"{function.name()}.c": c_code(function) for function in functions}
            texts[HEADER_NAME] = header(signatures)
            code = build.compile_library(compiler, texts, sources, daqp, cache)
            _enter(cache, key, code, signatures)
        found = _from_cache(cache, key)
        if found is None:
            raise build.BuildError(f"compiled code cannot be loaded from {cache}")
        with suppress(OSError):
            os.unlink(cache / f"{key}.lock")
        return found
    except build.BuildError as error:
        _notify(error)
    except OSError as error:
        _notify(
            build.BuildError(
                f"the directory of compiled code {cache} cannot be written "
                f"({error.strerror}); name another in STIFFOPT_CACHE_DIR"
            )
        )
    return None


def _enter(cache: Path, key: str, code: bytes, signatures: dict[str, Signature]) -> None:
    digest = hashlib.sha256(code).hexdigest()
    build.write_atomically(_code_path(cache, key, digest), code)
    functions = {name: signature.as_mapping() for name, signature in signatures.items()}
    entry = json.dumps({"sha256": digest, "functions": functions})
    build.write_atomically(cache / f"{key}.json", entry.encode())


def _notify(error: build.BuildError) -> None:
    """Say once per process why there is no machine code."""
    global _notified
    if error.expected or _notified:
        return
    _notified = True
    warnings.warn(
        f"slower without compiled code: {error} (STIFFOPT_COMPILER=none does without in silence)",
        SlowWarning,
        stacklevel=4,
    )
