"""Run the C compiler and manage the cache directory: C code in, shared library out.

Every failure is a `BuildError` with a text that a user can act on.
"""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import casadi as ca

NATIVE = Path(__file__).with_name("native")
"""Folder of headers, on the include path of all C files."""

FLAGS = ("-O1", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-w")
"""These flags do not change results, which equal those of the CasADi VM to the last bit."""

_TIMEOUT = 120.0  # s, for one call of the compiler
_ABANDONED_AFTER = 86400.0  # s
_POLL = 0.02  # s
_HELD_OFF = "armed"
_children: set[int] = set()  # processes that compile in the background
_DEFAULT_COMPILERS = ("cc", "gcc", "clang")


class BuildError(Exception):
    """There is no machine code, for this reason; `expected` if the user disabled it."""

    def __init__(self, reason: str, *, expected: bool = False) -> None:
        super().__init__(reason)
        self.expected = expected


@dataclass(frozen=True)
class Compiler:
    """A C compiler: its command, and its identity for cache keys."""

    command: tuple[str, ...]
    identity: tuple[str, ...]


def cache_directory() -> Path:
    """Return the directory of compiled code; it may not exist yet.

    Raises `BuildError` if it would be in a home directory, and there is none.
    """
    if given := os.environ.get("STIFFOPT_CACHE_DIR"):
        place = given
    elif sys.platform == "darwin":
        place = "~/Library/Caches/stiffopt"
    else:
        place = str(Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "stiffopt")
    try:
        return Path(place).expanduser().absolute()
    except RuntimeError as error:
        raise BuildError(
            f"there is no place to keep it ({error}); name one in STIFFOPT_CACHE_DIR"
        ) from None


# -- compiler -------------------------------------------------------------------------------


def find_compiler() -> Compiler:
    """Return the compiler in ``STIFFOPT_COMPILER`` or ``CC``, or the first one in ``PATH``."""
    if os.name != "posix":
        raise BuildError("code is compiled on Linux and macOS only")
    for variable in ("STIFFOPT_COMPILER", "CC"):
        words = _words(variable)
        if not words:
            continue
        if variable == "STIFFOPT_COMPILER" and words == ["none"]:
            raise BuildError("STIFFOPT_COMPILER is 'none'", expected=True)
        found = shutil.which(words[0])
        if found is None:
            raise BuildError(f"the C compiler {words[0]!r} that {variable} names was not found")
        return _identified([found, *words[1:]])
    for name in _DEFAULT_COMPILERS:
        if (found := shutil.which(name)) is not None:
            return _identified([found])
    raise BuildError(
        "no C compiler was found; install one (Debian and Ubuntu: apt install gcc) or name one in "
        "STIFFOPT_COMPILER"
    )


def _words(variable: str) -> list[str]:
    value = os.environ.get(variable, "")
    try:
        return shlex.split(value)
    except ValueError as error:
        raise BuildError(f"{variable} cannot be read as a command: {value!r}") from error


def _identified(command: list[str]) -> Compiler:
    """Return a compiler whose identity includes its file, which changes with the version."""
    command[0] = os.path.abspath(command[0])
    stat = os.stat(command[0])
    file = (os.path.realpath(command[0]), str(stat.st_mtime_ns), str(stat.st_size))
    return Compiler(tuple(command), (*command, *file))


def _run(commands: Sequence[Sequence[str]], directory: Path, timeout: float = _TIMEOUT) -> None:
    """Run commands in parallel; all have ended when this returns."""
    processes = []
    end = time.monotonic() + timeout
    try:
        for command in commands:
            processes.append(_started(command, directory))
        for process in processes:
            _check(commands[0][0], process, end, timeout)
    finally:
        for process in processes:
            if process.returncode is None:
                with suppress(OSError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.communicate()


def _started(command: Sequence[str], directory: Path) -> "subprocess.Popen[str]":
    try:
        return subprocess.Popen(
            command,
            cwd=directory,
            env={**os.environ, "LC_ALL": "C"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
    except OSError as error:
        raise BuildError(f"the C compiler {command[0]} cannot be run: {error.strerror}") from error


def _check(name: str, process: "subprocess.Popen[str]", end: float, timeout: float) -> None:
    """Raise an error if a compiler fails or exceeds its time."""
    try:
        output, complaint = process.communicate(timeout=max(0.0, end - time.monotonic()))
    except subprocess.TimeoutExpired as error:
        raise BuildError(f"the C compiler {name} took more than {timeout:g} s") from error
    if process.returncode != 0:
        first = "\n".join((complaint or output).strip().splitlines()[:3])
        raise BuildError(
            f"the C compiler {name} failed with exit code {process.returncode}"
            + (f":\n{first}" if first else "")
        )


# -- DAQP -----------------------------------------------------------------------------------


def daqp_parts() -> tuple[Path, Path]:
    """Return include directory and shared library of the DAQP that comes with CasADi."""
    home = Path(ca.__file__).parent
    include = home / "include"
    for suffix in (".so", ".dylib"):
        found = home / f"libdaqp{suffix}"
        if found.is_file() and (include / "daqp" / "api.h").is_file():
            return include, found
    raise BuildError(f"the installed CasADi has no headers or no library of DAQP in {home}")


# -- building -------------------------------------------------------------------------------


def compile_library(
    compiler: Compiler, texts: dict[str, str], sources: Sequence[str], daqp: bool, cache: Path
) -> bytes:
    """Return the machine code of C files, given by name and text, and of further sources."""
    cache.mkdir(mode=0o700, parents=True, exist_ok=True)
    _sweep(cache)
    directory = Path(tempfile.mkdtemp(prefix="build-", dir=cache))
    try:
        for name, text in texts.items():
            (directory / name).write_text(text, encoding="utf-8")
        includes, libraries = [f"-I{directory}", f"-I{NATIVE}"], ["-lm"]
        for folder in dict.fromkeys(str(Path(source).parent) for source in sources):
            includes.append(f"-I{folder}")
        if daqp:
            headers, shared = daqp_parts()
            includes.append(f"-I{headers}")
            libraries = [str(shared), f"-Wl,-rpath,{shared.parent}", *libraries]
        inputs = [name for name in texts if name.endswith(".c")] + list(sources)
        objects = [f"{k}.o" for k in range(len(inputs))]
        level = [word for word in compiler.command if word.startswith("-O")]
        command = [*compiler.command, *FLAGS, *level]  # the user's level overrides FLAGS
        calls = [
            [*command, *includes, "-c", source, "-o", target]
            for source, target in zip(inputs, objects, strict=True)
        ]
        _run(calls, directory)
        # bind our symbols locally: others in the process may have the same names
        symbols = ["-Wl,-Bsymbolic"] if sys.platform.startswith("linux") else []
        target = "library.so"
        link = ["-shared", *symbols, *objects, *libraries, "-o", target]
        _run([[*command, *link]], directory)
        return (directory / target).read_bytes()
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def _sweep(cache: Path) -> None:
    """Remove leftovers of builds that were killed."""
    oldest = time.time() - _ABANDONED_AFTER
    for pattern in ("build-*", "*.lock", "*.part"):
        for path in cache.glob(pattern):
            with suppress(OSError):
                if path.stat().st_mtime < oldest:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is complete or absent."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix="file-", suffix=".part", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise


@contextmanager
def locked(path: Path, longest: float = _TIMEOUT) -> Iterator[None]:
    """Hold a lock file; wait for another process that holds it, at most `longest` seconds.

    The system frees the lock of a process that ends in any way.  The lock only avoids duplicate
    work: without it, or after a timeout, everything is still correct.
    """
    import fcntl

    descriptor = None
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    if descriptor is None:
        yield
        return
    try:
        end = time.monotonic() + longest
        while time.monotonic() < end:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(_POLL)
            except OSError:  # a file system without locks
                break
        yield
    finally:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Return whether a process holds this lock file."""
    import fcntl

    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(descriptor)
    return False


@contextmanager
def held_off() -> Iterator[None]:
    """Forbid background compilation in all processes within this context: an arm is armed."""
    descriptor = None
    with suppress(OSError, BuildError, ImportError):
        import fcntl

        path = cache_directory() / _HELD_OFF
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(descriptor, fcntl.LOCK_SH)
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def is_held_off(cache: Path) -> bool:
    """Return whether some process has an arm armed; see `held_off`."""
    return is_locked(cache / _HELD_OFF)


def start_background(request: bytes, cache: Path) -> None:
    """Start `stiffopt.model.compiled.make_in_background` in a process that outlives this one."""
    root = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": path, "STIFFOPT_CACHE_DIR": str(cache)}
    if not sys.executable:
        raise OSError(0, "the Python interpreter is not known")
    with tempfile.TemporaryFile() as stream, open(os.devnull, "w") as nowhere:
        stream.write(request)
        stream.seek(0)
        stream.flush()
        command = [
            *(sys.executable, "-c"),
            "from stiffopt.model.compiled import make_in_background; make_in_background()",
        ]
        actions = [
            (os.POSIX_SPAWN_DUP2, stream.fileno(), 0),
            (os.POSIX_SPAWN_DUP2, nowhere.fileno(), 1),
            (os.POSIX_SPAWN_DUP2, nowhere.fileno(), 2),
        ]
        for child in list(_children):  # reap ended processes
            with suppress(OSError):
                if os.waitpid(child, os.WNOHANG) == (0, 0):
                    continue
            _children.discard(child)
        _children.add(
            os.posix_spawn(sys.executable, command, environment, file_actions=actions, setsid=True)
        )
