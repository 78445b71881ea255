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
import math
import os
import pickle
import threading
import time
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path

import casadi as ca

from stiffopt.errors import SlowWarning
from stiffopt.model import compiler as build
from stiffopt.model.batch import CompiledFunction, InterpretedFunction
from stiffopt.model.codegen import HEADER_NAME, Signature, c_code, dense, header

Make = Callable[[], Sequence[ca.Function]]

_ENVIRONMENT = ("STIFFOPT_CACHE_DIR", "STIFFOPT_COMPILER", "CC", "XDG_CACHE_HOME", "HOME", "PATH")
_TRIED_AGAIN_AFTER = 600.0  # s after a compilation in the background has failed


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
_awaited: dict[Hashable, float] = {}  # code that another process makes, and when to look again
_LOOK_AGAIN = 0.2  # s
_begun: dict[tuple[Path, str], float] = {}  # when a process was started to make code
_BEGUN_AGAIN_AFTER = 30.0  # s: such a process takes a second to start before it takes the lock
_notified: set[str] = set()
_in_foreground: ContextVar[bool] = ContextVar("in_foreground", default=False)
_watch: ContextVar[Callable[[], None] | None] = ContextVar("watch", default=None)


class CodeReadyError(Exception):
    """Machine code that was awaited is there; see `until_ready`."""


@contextmanager
def compiling_at_once() -> Iterator[None]:
    """Have `library` wait for the compiler in here, rather than have code made in the background.

    ``STIFFOPT_COMPILE=wait`` in the environment does so everywhere.
    """
    token = _in_foreground.set(True)
    try:
        yield
    finally:
        _in_foreground.reset(token)


@contextmanager
def until_ready(is_ready: Callable[[], bool]) -> Iterator[None]:
    """Interrupt evaluations in here by a `CodeReadyError` as soon as code is ready.

    What an answer would take minutes for without machine code is begun anew with it.
    """
    next_look = time.monotonic() + _LOOK_AGAIN

    def look() -> None:
        nonlocal next_look
        if time.monotonic() > next_look:
            next_look = math.inf  # what is evaluated to find out is not interrupted
            if is_ready():
                raise CodeReadyError
            next_look = time.monotonic() + _LOOK_AGAIN

    token = _watch.set(look)
    try:
        yield
    finally:
        _watch.reset(token)


def checkpoint() -> None:
    """Be interrupted here if `until_ready` says so."""
    look = _watch.get()
    if look is not None:
        look()


def library(
    content: str | Sequence[object],
    make: Make,
    sources: Sequence[str] = (),
    daqp: bool = False,
    build_missing: bool = True,
) -> Library | None:
    """Machine code of CasADi functions, from the cache or newly compiled.

    Code that is not in the cache is made by a process in the background (see
    `stiffopt.model.build_process`), and None is returned until it is there.  The process outlives
    this one, and there is one for each library, however many processes ask for it.

    Parameters
    ----------
    content : str or sequence
        What identifies the functions, beside stiffopt's own code: text, or values whose `repr`
        says it all.
    make : callable
        Makes the functions; called only if they are not in the cache.  Their names are the names
        in C and must be told apart in capitals too.  What cannot be pickled is compiled at once.
    sources : sequence of str, optional
        Paths of C files compiled with them, which find prototypes and sizes in ``functions.h``
        (see `codegen.header`) and their own headers beside them.
    daqp : bool
        Whether those need the DAQP that comes with CasADi.
    build_missing : bool
        False: only look into the cache.

    Returns
    -------
    Library or None
        None where code is not there yet or cannot be had; the first time in a process a
        `SlowWarning` says why.
    """
    text = content if isinstance(content, str) else repr(tuple(content))
    request = (text, tuple(sources), daqp, *map(os.environ.get, _ENVIRONMENT))
    with _lock:
        if _awaited.get(request, 0.0) > time.monotonic() and not _at_once():
            return None
        try:
            cache = build.cache_directory()
            compiler = build.find_compiler(cache)
            key = _key(text, compiler, sources, daqp)
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
            if not _at_once():
                _awaited[request] = time.monotonic() + _LOOK_AGAIN
                if not _is_made_in_background(cache, key, text, make, sources, daqp):
                    _loaded[cache, key] = None
                return _loaded.get((cache, key))
            found = _built(cache, key, compiler, make, sources, daqp)
        _loaded[cache, key] = found
        _awaited.pop(request, None)
        return found


def _at_once() -> bool:
    return _in_foreground.get() or os.environ.get("STIFFOPT_COMPILE") == "wait"


def _is_made_in_background(
    cache: Path, key: str, text: str, make: Make, sources: Sequence[str], daqp: bool
) -> bool:
    """Begin to compile in another process, unless one does already; False where it has failed."""
    failure = cache / f"{key}.failed"
    with suppress(OSError, ValueError):
        reason = failure.read_text(encoding="utf-8")
        if time.time() - failure.stat().st_mtime < _TRIED_AGAIN_AFTER:
            _notify(build.BuildError(reason))
            return False
    if build.is_locked(cache / f"{key}.lock"):
        _notify_of_waiting()
        return True
    begun = _begun.get((cache, key), -math.inf)
    if build.is_held_off(cache) or time.monotonic() < begun + _BEGUN_AGAIN_AFTER:
        return True
    try:
        request = pickle.dumps((text, make, tuple(sources), daqp))
    except Exception:  # made of what only this process knows
        with compiling_at_once():
            return library(text, make, sources, daqp) is not None
    try:
        build.start_background(request, cache)
    except OSError as error:
        _notify(build.BuildError(f"no process can be started to make it ({error.strerror})"))
        return False
    _begun[cache, key] = time.monotonic()
    _notify_of_waiting()
    return True


def compilation_is_held_off() -> bool:
    """Whether an arm is armed somewhere, so that no code is made in the background."""
    with suppress(build.BuildError):
        return build.is_held_off(build.cache_directory())
    return False


def make_in_background(request: bytes) -> None:
    """Compile what another process asked for; one process at a time does so for one library."""
    text, make, sources, daqp = pickle.loads(request)
    cache = build.cache_directory()
    compiler = build.find_compiler(cache)
    key = _key(text, compiler, sources, daqp)
    lock = cache / f"{key}.lock"
    if build.is_locked(lock) or build.is_held_off(cache) or _from_cache(cache, key) is not None:
        return
    try:
        _make(cache, key, compiler, make, sources, daqp)
    except (build.BuildError, OSError) as error:
        build.write_atomically(cache / f"{key}.failed", str(error).encode())


def interpreted(make: Make) -> dict[str, InterpretedFunction]:
    """The same functions in the CasADi VM, by name."""
    return {function.name(): InterpretedFunction(dense(function)) for function in make()}


# -- keys -----------------------------------------------------------------------------------


def _key(text: str, compiler: build.Compiler, sources: Sequence[str], daqp: bool) -> str:
    parts = [
        text,
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
    files = list(root.glob("*.py"))
    for folder in ("model", "optimise"):
        files += (root / folder).rglob("*.py")
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
        return _make(cache, key, compiler, make, sources, daqp)
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


def _make(
    cache: Path,
    key: str,
    compiler: build.Compiler,
    make: Make,
    sources: Sequence[str],
    daqp: bool,
) -> Library:
    """Compile, enter into the cache and load, while others who want the same wait."""
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
    for name in (f"{key}.lock", f"{key}.failed"):
        with suppress(OSError):
            os.unlink(cache / name)
    return found


def _enter(cache: Path, key: str, code: bytes, signatures: dict[str, Signature]) -> None:
    digest = hashlib.sha256(code).hexdigest()
    build.write_atomically(_code_path(cache, key, digest), code)
    functions = {name: signature.as_mapping() for name, signature in signatures.items()}
    entry = json.dumps({"sha256": digest, "functions": functions})
    build.write_atomically(cache / f"{key}.json", entry.encode())


def _notify(error: build.BuildError) -> None:
    """Say once per process why there is no machine code."""
    if not error.expected:
        _warn_once(
            f"slower without compiled code: {error} "
            "(STIFFOPT_COMPILER=none does without in silence)"
        )


def _notify_of_waiting() -> None:
    _warn_once(
        "machine code for this kind of arm and task is being made in the background; until it is "
        "there, answers take longer"
    )


def _warn_once(text: str) -> None:
    kind = text.partition(":")[0]
    if kind not in _notified:
        _notified.add(kind)
        warnings.warn(text, SlowWarning, stacklevel=5)
