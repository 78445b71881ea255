"""What all tests share: no display, no network, and long tests only on demand."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import hypothesis
import pytest

LONGEST = (
    "test_fit", "test_controller", "test_touch", "test_soak", "test_commanding", "test_detection",
    "test_bracing_push", "test_bracing_loop", "test_brace", "test_workspace_resumed",
    "test_posture", "test_calibrate_command", "test_open_regulator", "test_ros_end_to_end",
    "test_run_command", "test_lab", "test_commanding_processes", "test_supply_contract",
    "test_world", "test_intervals",
)  # fmt: skip
LOOPBACK = ("127.0.0.1", "::1", "localhost")

os.environ["MPLBACKEND"] = "Agg"
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported: small matrices, many processes
os.environ["STIFFOPT_COMPILER"] = "none"  # but for tests that ask for `compiled`
os.environ["STIFFOPT_PROGRESS"] = "none"  # but for tests of progress
os.environ.pop("COLUMNS", None)  # what is printed has the width that it has by itself
os.environ["STIFFOPT_COMPILE"] = "wait"  # but for tests of code that is made in the background

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a shell
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # as under nohup
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run the tests marked as long too")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--long"):
        os.environ["STIFFOPT_LONG"] = "1"
    # the short form tries the same examples in every run, the long form new ones
    hypothesis.settings.register_profile("short", derandomize=True, deadline=None)
    hypothesis.settings.register_profile("long", deadline=None)
    hypothesis.settings.load_profile("long" if is_long() else "short")


def is_long() -> bool:
    return os.environ.get("STIFFOPT_LONG", "") not in ("", "0")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files without such tests where only `real_time` ones are asked for: quicker."""
    if config.getoption("markexpr") != "real_time" or collection_path.suffix != ".py":
        return None
    return "pytest.mark.real_time" not in collection_path.read_text() or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest: no process is left alone with one at the end."""
    items.sort(key=lambda item: item.path.stem not in LONGEST)
    if not is_long():
        skip = pytest.mark.skip(reason="long: run with --long or STIFFOPT_LONG=1")
        for item in items:
            if "long" in item.keywords or not _is_sampled(item):
                item.add_marker(skip)


def pytest_collection_finish() -> None:
    """Spare the garbage collector all that was imported: it would be looked through for ever."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def _is_sampled(item: pytest.Item) -> bool:
    """Say whether the ordinary form runs this case of a test that is marked `one_in(n, *names)`.

    It does where the places of its parameters in their lists, of all or of those that are named,
    have a sum that n divides: of one list every n-th, and of several of at least n each all values.
    """
    marker = item.get_closest_marker("one_in")
    if marker is None:
        return True
    every, *names = marker.args
    places: dict[str, int] = item.callspec.indices  # type: ignore[attr-defined]
    return bool(sum(places[name] for name in names or places) % every == 0)


@pytest.fixture(scope="session")
def code_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where compiled code is kept for all tests of this run, whichever process runs them."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # each of them has its own below
    cache = folder / "code"
    cache.mkdir(exist_ok=True)
    _link_simulator(cache)
    return cache


def _link_simulator(cache: Path) -> None:
    """Let a cache of compiled code have what is kept of the simulator, which takes longest."""
    root = os.environ.get("STIFFOPT_CACHE_DIR") or Path.home() / ".cache" / "stiffopt"
    kept = Path(root) / "simulator"
    kept.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):  # another process of this run was first
        (cache / "simulator").symlink_to(kept)


def use_compiler(patch: pytest.MonkeyPatch, code_cache: Path) -> None:
    """Use machine code, not optimised but in the long form; skip where there is no compiler."""
    found = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
    if found is None:
        pytest.skip("there is no C compiler")
    if is_long():
        patch.delenv("STIFFOPT_COMPILER", raising=False)
    else:
        patch.setenv("STIFFOPT_COMPILER", f"{found} -O0")
    patch.setenv("STIFFOPT_CACHE_DIR", str(code_cache))


@pytest.fixture
def compiled(code_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Machine code instead of the CasADi VM; not optimised but in the long form, to save time."""
    use_compiler(monkeypatch, code_cache)
    return code_cache


@pytest.fixture(scope="module")
def organ(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dented body in mm, of triangles, as an STL file."""
    np, trimesh = pytest.importorskip("numpy"), pytest.importorskip("trimesh")
    body = trimesh.creation.icosphere(3, 20.0)
    up = body.vertices[:, 2:] / 20.0
    body.vertices *= 1.0 - 0.35 * np.exp(-4 * (up - 1) ** 2) + 0.2 * up
    path = tmp_path_factory.mktemp("mesh") / "organ.stl"
    body.export(path)
    return path


@pytest.fixture
def kept_grids(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of meshes are kept for all tests of this run, and nowhere else."""
    folder = tmp_path_factory.getbasetemp() / "grids"
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(folder))


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse connections but to this machine: no test may depend on what is out there."""
    connect = socket.socket.connect

    def guarded(self: socket.socket, address: Any) -> None:
        if self.family in (socket.AF_INET, socket.AF_INET6) and address[0] not in LOOPBACK:
            self.close()
            raise RuntimeError(f"a test tried to connect to {address}")
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", guarded)


@pytest.fixture(autouse=True)
def _forget_supplies() -> Iterator[None]:
    """Let what a test left under pressure on purpose not be vented at the end of all tests."""
    yield
    pressure = sys.modules.get("stiffopt.rig.pressure")
    if pressure is not None:
        pressure._not_known_to_be_vented.clear()
