"""Compile CasADi functions to machine code, cached on disk by content.

`library` finds or makes a shared library.  Without a compiler, or a place for the cache, it warns
once and returns None; `interpreted` then serves the same calls in the CasADi VM.  Values equal
those of the VM to the last bit.

The cache (``STIFFOPT_CACHE_DIR``, by default ``stiffopt`` in the user's cache directory) may be
shared by processes and removed at any time.  A library is entered by writing ``KEY-HASH.so`` and
then ``KEY.json``, which holds the hash of the former, so that incomplete code is never loaded.
"""

import ctypes
import hashlib
import json
import math
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import casadi as ca

from stiffopt.errors import warn_slow
from stiffopt.model import compiler as build
from stiffopt.model import stopping
from stiffopt.model.batch import CompiledFunction, InterpretedFunction
from stiffopt.model.codegen import HEADER_NAME, Signature, c_code, dense, header

Make = Callable[[], Sequence[ca.Function]]

_ENVIRONMENT = ("STIFFOPT_CACHE_DIR", "STIFFOPT_COMPILER", "CC", "XDG_CACHE_HOME", "HOME", "PATH")
_TRIED_AGAIN_AFTER = 600.0  # s after a failed compilation in the background


class Library:
    """A loaded shared library.

    `path`: its file, for messages. `cdll`: gives access to functions of hand-written sources; calls
    release the interpreter lock.
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
        """Return one of the CasADi functions in it."""
        return self._functions[name]


@dataclass(frozen=True)
class _Wanted:
    """A request for machine code; see `library` for the fields."""

    text: str
    make: Make
    sources: tuple[str, ...]
    daqp: bool

    def key(self, compiler: build.Compiler) -> str:
        """Return a hash of everything that the code depends on, for file names."""
        files = [Path(source) for source in self.sources]
        folders = {folder for file in files for folder in (file.parent, build.NATIVE)}
        headers = {found for folder in folders for found in folder.glob("*.[ch]")}
        parts = [
            self.text,
            _own_code(),
            ca.__version__,
            f"{sys.platform} {os.uname().machine} {sys.maxsize}",
            repr(compiler.identity),
            repr(build.FLAGS),
            *(hashlib.sha256(file.read_bytes()).hexdigest() for file in (*files, *sorted(headers))),
            str(build.daqp_parts()[1]) if self.daqp else "",
        ]
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


@lru_cache(maxsize=1)
def _own_code() -> str:
    """Return a hash of the source that defines the functions."""
    root = Path(__file__).parent.parent
    files = list(root.glob("*.py"))
    for folder in ("model", "optimise"):
        files += (root / folder).rglob("*.py")
    total = hashlib.sha256()
    for file in sorted(files):
        total.update(f"{file.relative_to(root)}\0".encode())
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


_lock = threading.RLock()
_loaded: dict[tuple[Path, str], Library | None] = {}
_awaited: dict[Hashable, float] = {}  # requests compiled elsewhere, with the time of the next look
_LOOK_AGAIN = 0.2  # s
_begun: dict[tuple[Path, str], float] = {}  # when a process was started to make code
_BEGUN_AGAIN_AFTER = 30.0  # s; a process takes about a second to start and take the lock
_notified: set[str] = set()
_in_foreground: ContextVar[bool] = ContextVar("in_foreground", default=False)
_only_cached: ContextVar[bool] = ContextVar("only_cached", default=False)
_watch: ContextVar[Callable[[], None] | None] = ContextVar("watch", default=None)


class CodeReadyError(Exception):
    """Awaited machine code is ready; see `until_ready`."""


@contextmanager
def compiling_at_once() -> Iterator[None]:
    """Make `library` wait for the compiler within this context.

    ``STIFFOPT_COMPILE=wait`` in the environment does so everywhere.
    """
    token = _in_foreground.set(True)
    try:
        yield
    finally:
        _in_foreground.reset(token)


@contextmanager
def compiling_nothing() -> Iterator[None]:
    """Make `library` only look into the cache within this context."""
    token = _only_cached.set(True)
    try:
        yield
    finally:
        _only_cached.reset(token)


@contextmanager
def until_ready(is_ready: Callable[[], bool]) -> Iterator[None]:
    """Interrupt evaluations in this context with `CodeReadyError` as soon as code is ready.

    An answer that takes minutes without machine code can then be restarted with it.
    """
    next_look = time.monotonic() + _LOOK_AGAIN

    def look() -> None:
        nonlocal next_look
        if time.monotonic() > next_look:
            next_look = math.inf  # do not interrupt evaluations of `is_ready` itself
            if is_ready():
                raise CodeReadyError
            next_look = time.monotonic() + _LOOK_AGAIN

    token = _watch.set(look)
    try:
        yield
    finally:
        _watch.reset(token)


def checkpoint() -> None:
    """Raise `CodeReadyError` if code awaited by `until_ready` is ready; raise if told to stop.

    See `stiffopt.model.stopping`.
    """
    stopping.checkpoint()
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
    """Return machine code of CasADi functions, from the cache or newly compiled.

    Code that is not in the cache is compiled by a background process
    (`make_in_background`), and None is returned until it is ready.  The process outlives
    this one, and there is one for each library, however many processes request it.

    Returns None if code is not ready or cannot be made; a `SlowWarning` gives the reason, once for
    each process.

    Parameters
    ----------
    content : str or sequence
        Identifies the functions, in addition to stiffopt's own code: text, or values
        whose `repr` is complete.
    make : returns the functions; called only if they are not in the cache.  Their names are the
        names in C and must differ in more than capitals.  If it cannot be pickled, it is compiled
        at once.
    sources : paths of C files compiled with them, which find prototypes and sizes in
        ``functions.h`` (see `codegen.header`) and headers in their own folders and in ``native``.
    daqp : whether the sources need the DAQP that comes with CasADi.
    build_missing : False: only look into the cache.
    """
    text = content if isinstance(content, str) else repr(tuple(content))
    build_missing = build_missing and not _only_cached.get()
    wanted = _Wanted(text, make, tuple(sources), daqp)
    request = (text, wanted.sources, daqp, *map(os.environ.get, _ENVIRONMENT))
    with _lock:
        if _awaited.get(request, 0.0) > time.monotonic() and not _at_once():
            return None
        try:
            cache = build.cache_directory()
            compiler = build.find_compiler()
            key = wanted.key(compiler)
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
                if not _is_made_in_background(cache, key, wanted):
                    _loaded[cache, key] = None
                return _loaded.get((cache, key))
            begin = time.perf_counter()
            try:
                found = _make(cache, key, compiler, wanted)
            except build.BuildError as error:
                _notify(error)
            finally:
                Stopwatch.compilation += time.perf_counter() - begin
        _loaded[cache, key] = found
        _awaited.pop(request, None)
        return found


def _at_once() -> bool:
    return _in_foreground.get() or os.environ.get("STIFFOPT_COMPILE") == "wait"


def _is_made_in_background(cache: Path, key: str, wanted: _Wanted) -> bool:
    """Start a background compilation, unless one is running; return False if it has failed."""
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
        request = pickle.dumps(wanted)
    except Exception:  # not picklable, so no other process can do it
        with compiling_at_once():
            return library(wanted.text, wanted.make, wanted.sources, wanted.daqp) is not None
    try:
        build.start_background(request, cache)
    except OSError as error:
        _notify(build.BuildError(f"no process can be started to make it ({error.strerror})"))
        return False
    _begun[cache, key] = time.monotonic()
    _notify_of_waiting()
    return True


def compilation_is_held_off() -> bool:
    """Return whether an arm is armed somewhere, which forbids background compilation."""
    with suppress(build.BuildError):
        return build.is_held_off(build.cache_directory())
    return False


def make_in_background() -> None:
    """Compile a request from standard input, at low priority.

    Only one process at a time does so for one library.
    """
    with suppress(OSError):
        os.nice(10)
    wanted: _Wanted = pickle.load(sys.stdin.buffer)
    cache = build.cache_directory()
    compiler = build.find_compiler()
    key = wanted.key(compiler)
    lock = cache / f"{key}.lock"
    if build.is_locked(lock) or build.is_held_off(cache) or _from_cache(cache, key) is not None:
        return
    try:
        _make(cache, key, compiler, wanted)
    except build.BuildError as error:
        with suppress(OSError):
            build.write_atomically(cache / f"{key}.failed", str(error).encode())


class Stopwatch:
    """Measure the time of an answer, apart from one-time compilation."""

    compilation = 0.0  # s, of this process so far

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self._compiled = Stopwatch.compilation

    def timings(self) -> dict[str, float]:
        """Return ``total`` in s and, where code was made, the further ``compilation``."""
        compiled = Stopwatch.compilation - self._compiled
        total = max(0.0, time.perf_counter() - self._begin - compiled)
        return {"total": total, "compilation": compiled} if compiled else {"total": total}


def interpreted(make: Make) -> dict[str, InterpretedFunction]:
    """Return the same functions in the CasADi VM, by name."""
    return {function.name(): InterpretedFunction(dense(function)) for function in make()}


# -- cache ----------------------------------------------------------------------------------


def _from_cache(cache: Path, key: str) -> Library | None:
    """Return the library if it is in the cache and complete."""
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


def _make(cache: Path, key: str, compiler: build.Compiler, wanted: _Wanted) -> Library:
    """Compile, enter into the cache and load; other processes with the same request wait."""
    try:
        with build.locked(cache / f"{key}.lock"):
            found = _from_cache(cache, key)  # another process may have been faster
            if found is not None:
                return found
            functions = [dense(function) for function in wanted.make()]
            signatures = {function.name(): Signature.of(function) for function in functions}
            texts = {f"{function.name()}.c": c_code(function) for function in functions}
            texts[HEADER_NAME] = header(signatures)
            code = build.compile_library(compiler, texts, wanted.sources, wanted.daqp, cache)
            digest = hashlib.sha256(code).hexdigest()
            build.write_atomically(_code_path(cache, key, digest), code)
            entry = {
                "sha256": digest,
                "functions": {name: asdict(each) for name, each in signatures.items()},
            }
            build.write_atomically(cache / f"{key}.json", json.dumps(entry).encode())
    except OSError as error:
        raise build.BuildError(
            f"the directory of compiled code {cache} cannot be written ({error.strerror}); name "
            "another in STIFFOPT_CACHE_DIR"
        ) from error
    found = _from_cache(cache, key)
    if found is None:
        raise build.BuildError(f"compiled code cannot be loaded from {cache}")
    for name in (f"{key}.lock", f"{key}.failed"):
        with suppress(OSError):
            os.unlink(cache / name)
    return found


def _notify(error: build.BuildError) -> None:
    """Warn once per process why there is no machine code."""
    if not error.expected:
        _warn_once(
            f"slower without compiled code: {error} "
            "(STIFFOPT_COMPILER=none does without in silence)"
        )


def _notify_of_waiting() -> None:
    _warn_once(
        "compiling once for this kind of arm and task, in the background (about 10 s); until then "
        "answers take longer"
    )


def _warn_once(text: str) -> None:
    kind = text.partition(":")[0]
    if kind not in _notified:
        _notified.add(kind)
        warn_slow(text)
