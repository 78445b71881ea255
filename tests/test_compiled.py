"""Compiled code: what is cached, what happens when it cannot be, and that it is the VM's bits."""

import ctypes
import os
import shutil
import signal
import stat
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import stiffopt as so
from stiffopt.errors import SlowWarning
from stiffopt.model import compiled, tip_functions
from stiffopt.model import compiler as build
from stiffopt.model.batch import in_parallel
from stiffopt.model.codegen import c_code
from stiffopt.model.compiled import interpreted, library

pytestmark = pytest.mark.skipif(
    all(shutil.which(name) is None for name in ("cc", "gcc", "clang")), reason="no C compiler"
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache and a process that has loaded and said nothing yet."""
    directory = tmp_path / "cache"
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(directory))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("STIFFOPT_COMPILER", raising=False)
    as_a_new_process(monkeypatch)
    return directory


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A cache with the library of `functions`."""
    directory = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STIFFOPT_CACHE_DIR", str(directory))
        for name in ("CC", "STIFFOPT_COMPILER"):
            patch.delenv(name, raising=False)
        as_a_new_process(patch)
        library("f", functions)
    return directory


@pytest.fixture
def filled(made, cache):
    """A cache that has that library already."""
    return shutil.copytree(made, cache)


def as_a_new_process(monkeypatch):
    monkeypatch.setattr(compiled, "_loaded", {})
    monkeypatch.setattr(compiled, "_notified", set())


def functions():
    """Vectors and matrices in and out, sparse ones, an MX function and one without arguments."""
    x, A, s = ca.SX.sym("x", 3), ca.SX.sym("A", 2, 3), ca.SX.sym("s")
    lower = ca.SX.sym("L", ca.Sparsity.lower(2))
    mixed = ca.Function("mixed", [x, A, s], [A @ x * s, A * s, ca.diag(x), ca.norm_2(x)])
    sparse = ca.Function("sparse", [lower], [lower @ lower])
    y, B = ca.MX.sym("y", 3), ca.MX.sym("B", 2, 3)
    nested = ca.Function("nested", [y, B], [mixed(y, B, 2)[0] + ca.sin(B @ y), B.T])
    return [mixed, sparse, nested, ca.Function("constant", [ca.SX.sym("n", 0)], [ca.DM(3)])]


def unexpected():
    raise AssertionError("made although it is in the cache")


def code_files(directory):
    return sorted(directory.glob("*.so"))


def fake_compiler(path, body):
    """A script in the place of a compiler, with the real one as $CC_REAL."""
    real = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    path.write_text(f"#!/bin/sh\nCC_REAL={real}\n{textwrap.dedent(body)}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


ARGUMENTS = (np.array([0.3, -1.2, 2.0]), np.arange(6.0).reshape(2, 3), np.array([0.7]))


# -- values ---------------------------------------------------------------------------------


def test_values_of_machine_code_and_of_the_vm():
    native, vm = library("f", functions), interpreted(functions)
    x, A, s = ARGUMENTS
    expected = [(A @ x * s[0])[:, np.newaxis], A * s[0], np.diag(x), [[np.linalg.norm(x)]]]
    for function in (native.function("mixed"), vm["mixed"]):
        for found, value in zip(function(x, A, s), expected, strict=True):
            assert found == pytest.approx(np.array(value), rel=1e-15)
            assert found.flags.c_contiguous
    L = np.array([[2.0, 0.0], [3.0, 4.0]])
    for function in (native.function("sparse"), vm["sparse"]):
        assert np.array_equal(function(L)[0], L @ L)
    for function in (native.function("nested"), vm["nested"]):
        first, second = function(x, A)
        assert first[:, 0] == pytest.approx(2 * A @ x + np.sin(A @ x), rel=1e-15)
        assert np.array_equal(second, A.T)
    for function in (native.function("constant"), vm["constant"]):
        assert function(np.zeros(0))[0] == 3


@pytest.mark.one_in(3)
@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 10_000])
@pytest.mark.parametrize("rows_of", [(True, True, True), (True, False, True), (True, True, False)])
def test_a_batch_is_row_by_row(count, rows_of, filled):
    native, vm = library("f", unexpected).function("mixed"), interpreted(functions)["mixed"]
    rng = np.random.default_rng(0)
    shapes = ((3,), (2, 3), (1,))
    arguments = [
        rng.normal(size=(count, *shape) if each else shape)
        for shape, each in zip(shapes, rows_of, strict=True)
    ]
    together = native.many(*arguments)
    for other in (vm.many(*arguments), *(native.many(*arguments, threads=k) for k in (1, 3))):
        for one, two in zip(together, other, strict=True):
            assert np.array_equal(one, two)
    assert [value.shape for value in together] == [
        (count, 2, 1), (count, 2, 3), (count, 3, 3), (count, 1, 1),
    ]  # fmt: skip
    assert all(value.flags.c_contiguous for value in together)
    for row in range(0, count, max(1, count // 5)):
        own = [a[row] if each else a for a, each in zip(arguments, rows_of, strict=True)]
        for function in (native, vm):
            for value, whole in zip(function(*own), together, strict=True):
                assert np.array_equal(value, whole[row])


def test_batches_of_another_shape_are_refused():
    native, vm = library("f", functions).function("mixed"), interpreted(functions)["mixed"]
    x, A, s = ARGUMENTS
    for function in (native, vm):
        with pytest.raises(ValueError, match=r"expected \(3, 1\) for each of 1 rows"):
            function.many(x[np.newaxis, :2], A, s)
        with pytest.raises(ValueError, match=r"expected \(2, 3\) for each of 2 rows"):
            function.many(np.tile(x, (2, 1)), np.tile(A, (3, 1, 1)), s)
        with pytest.raises(ValueError, match="could not broadcast"):
            function(x[:2], A, s)


def test_rows_that_are_not_contiguous():
    native = library("f", functions).function("sparse")
    values = np.asfortranarray(np.random.default_rng(0).normal(size=(5, 2, 2)))
    values[:, 0, 1] = 0
    (found,) = native.many(values)
    assert found == pytest.approx(values @ values, rel=1e-14)


def test_many_threads_share_a_function():
    x, A, s = ARGUMENTS
    for function in (library("f", functions).function("mixed"), interpreted(functions)["mixed"]):
        wrong = []

        def work(factor, function=function, wrong=wrong):
            expected = factor * A * s[0]
            for _ in range(500):
                wrong.extend([1] * (not np.array_equal(function(x, factor * A, s)[1], expected)))

        threads = [threading.Thread(target=work, args=(2.0**k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not wrong


def test_an_error_in_a_thread_is_raised():
    def work(items):
        for item in items:
            time.sleep(1e-3)  # so that both threads have some
            if threading.current_thread() is not threading.main_thread():
                raise KeyError(item)

    with pytest.raises(KeyError):
        in_parallel(work, range(100), threads=2)


def test_hand_written_code_is_compiled_with_it(tmp_path):
    (tmp_path / "factor.h").write_text("#define FACTOR 10\n")
    source = tmp_path / "extra.c"
    source.write_text(
        """
        #include "factor.h"
        #include "functions.h"
        #include <daqp/api.h>
        int stiffopt_test(const double *x, const double *A, const double *s, double *y) {
          const double *arg[WORK_ARG] = {x, A, s};
          double *res[WORK_RES] = {y}, w[WORK_W];
          casadi_int iw[WORK_IW];
          DAQPSettings settings;
          daqp_default_settings(&settings);
          int failed = mixed(arg, res, iw, w, 0);
          y[0] *= FACTOR, y[1] *= settings.primal_tol > 0;
          return failed + 100 * MIXED_N_IN + 10 * SPARSE_N_OUT;
        }
        """
    )
    found = library("f", functions, [str(source)], daqp=True)
    x, A, s = ARGUMENTS
    y = np.zeros(2)
    columns = np.asfortranarray(A)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (x, columns, s, y)]
    assert found.cdll.stiffopt_test(*pointers) == 310
    assert y == pytest.approx([10, 1] * (A @ x * s), rel=1e-15)


# -- cache ----------------------------------------------------------------------------------


def test_a_second_process_makes_nothing_and_runs_nothing(cache, monkeypatch):
    first = library("f", functions).function("mixed")(*ARGUMENTS)
    files = sorted(cache.iterdir())
    as_a_new_process(monkeypatch)
    monkeypatch.setattr(subprocess, "Popen", unexpected)
    again = library("f", unexpected)
    assert all(map(np.array_equal, again.function("mixed")(*ARGUMENTS), first))
    assert library("f", unexpected) is again
    assert sorted(cache.iterdir()) == files
    assert not list(cache.glob("*.lock")) + list(cache.glob("build-*"))


def test_what_makes_another_library(cache, monkeypatch, tmp_path):
    def files():
        return len(code_files(cache)), len(list(cache.glob("*.json")))

    library("f", functions)
    assert library("g", unexpected, build_missing=False) is None
    library("g", functions)
    library(("g", 1), functions)
    assert len(list(cache.glob("*.json"))) == 3
    monkeypatch.setenv("STIFFOPT_COMPILER", fake_compiler(tmp_path / "mycc", 'exec $CC_REAL "$@"'))
    assert library("f", unexpected, build_missing=False) is None
    library("f", functions)
    monkeypatch.setattr(build, "FLAGS", (*build.FLAGS, "-DX"))
    library("f", functions)
    monkeypatch.setattr(compiled, "_own_code", lambda: "another version")
    library("f", functions)
    assert files()[1] == 6


def test_the_key_of_own_sources(tmp_path):
    source, beside = tmp_path / "a.c", tmp_path / "a.h"
    compiler = build.find_compiler()
    source.write_text("int a;")
    wanted = compiled._Wanted("f", functions, (str(source),), False)
    keys = [wanted.key(compiler)]
    beside.write_text("#define A 1\n")
    keys.append(wanted.key(compiler))
    source.write_text("int b;")
    keys.append(wanted.key(compiler))
    keys.append(replace(wanted, daqp=True).key(compiler))
    assert len(set(keys)) == 4


@pytest.mark.parametrize("damage", ["cut", "empty", "changed", "gone", "no entry", "half an entry"])
def test_code_that_is_not_whole_is_made_again(filled, monkeypatch, damage):
    expected = library("f", unexpected).function("mixed")(*ARGUMENTS)
    (code,), (entry,) = code_files(filled), filled.glob("*.json")
    content = code.read_bytes()
    code.unlink()  # not in place: the code is mapped into this process
    if damage == "cut":
        code.write_bytes(content[: len(content) // 2])
    elif damage == "empty":
        code.write_bytes(b"")
    elif damage == "changed":
        code.write_bytes(content[:2000] + bytes([content[2000] ^ 1]) + content[2001:])
    elif damage != "gone":
        code.write_bytes(content)
        entry.write_text(entry.read_text()[:50] if damage == "half an entry" else "{}")
    as_a_new_process(monkeypatch)
    assert library("f", unexpected, build_missing=False) is None
    made = []
    again = library("f", lambda: made.append(1) or functions())
    assert made
    assert all(map(np.array_equal, again.function("mixed")(*ARGUMENTS), expected))
    as_a_new_process(monkeypatch)
    assert library("f", unexpected) is not None


def test_a_cache_that_cannot_be_written_is_read(cache, monkeypatch):
    library("f", functions)
    as_a_new_process(monkeypatch)
    read_only(cache, monkeypatch)
    assert library("f", unexpected) is not None
    with pytest.warns(SlowWarning, match="cannot be written.*STIFFOPT_CACHE_DIR") as notices:
        assert [library(content, functions) for content in ("g", "g", "h")] == [None] * 3
    assert [notice.filename for notice in notices] == [__file__]  # not a line of stiffopt's


def read_only(directory, monkeypatch):
    """Make a directory one that nothing can be written to, even by the superuser."""
    directory.chmod(0o555)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(build, "write_atomically", refuse)
    monkeypatch.setattr(build.tempfile, "mkdtemp", refuse)


def test_a_cache_whose_place_is_taken(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(tmp_path / "file"))
    with pytest.warns(SlowWarning, match="cannot be written"):
        assert library("f", functions) is None


def test_where_the_cache_is(monkeypatch, tmp_path):
    assert build.cache_directory() == Path(os.environ["STIFFOPT_CACHE_DIR"])
    monkeypatch.delenv("STIFFOPT_CACHE_DIR")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert build.cache_directory() == tmp_path / "stiffopt"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert build.cache_directory() == Path.home() / ".cache" / "stiffopt"


def test_what_killed_builds_left_is_removed_after_a_day(cache):
    cache.mkdir()
    old, new = cache / "build-old", cache / "build-new"
    for directory in (old, new):
        directory.mkdir()
        (directory / "f.c").write_text("")
    (cache / "file-old.part").write_text("")
    long_ago = time.time() - 2 * 86400
    for path in (old, cache / "file-old.part"):
        os.utime(path, (long_ago, long_ago))
    library("f", functions)
    assert not old.exists()
    assert new.exists()
    assert not list(cache.glob("*.part"))


# -- compilers ------------------------------------------------------------------------------


def test_without_a_compiler(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert library("f", unexpected, build_missing=False) is None
    with pytest.warns(SlowWarning, match="no C compiler was found; install one") as notices:
        assert [library(content, unexpected) for content in ("f", "g")] == [None] * 2
    assert len(notices) == 1


def test_none_is_a_compiler_that_nobody_misses(monkeypatch):
    monkeypatch.setenv("STIFFOPT_COMPILER", "none")
    assert library("f", unexpected) is None


@pytest.mark.parametrize("variable", ["STIFFOPT_COMPILER", "CC"])
def test_a_compiler_that_is_named_but_not_there(monkeypatch, variable):
    monkeypatch.setenv(variable, "no-such-compiler -m64")
    with pytest.warns(SlowWarning, match=f"'no-such-compiler' that {variable} names was not found"):
        assert library("f", unexpected) is None


def test_a_command_that_cannot_be_read(monkeypatch):
    monkeypatch.setenv("CC", "gcc '")
    with pytest.warns(SlowWarning, match="CC cannot be read as a command"):
        assert library("f", unexpected) is None


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("exit 1", "failed with exit code 1"),
        ("echo no room >&2\nexit 3", "code 3:\nno room"),
        ("exit 0", "cannot be"),
        ("sleep 60 & wait", "took more than 0.3 s"),
    ],
)
def test_a_compiler_that_fails(monkeypatch, tmp_path, cache, body, reason):
    monkeypatch.setenv("STIFFOPT_COMPILER", fake_compiler(tmp_path / "cc", body))
    monkeypatch.setattr(build._run, "__defaults__", (0.3,))
    start = time.monotonic()
    with pytest.warns(SlowWarning, match=reason) as notices:
        assert [library(content, functions) for content in ("f", "f")] == [None] * 2
    assert len(notices) == 1
    assert time.monotonic() - start < 10
    assert not list(cache.glob("build-*")) + code_files(cache)


def test_a_compiler_with_options(monkeypatch):
    monkeypatch.setenv("CC", "cc -DSOMETHING='a b'")
    assert library("f", functions) is not None


# -- processes ------------------------------------------------------------------------------

CHILD = """
import numpy as np, sys
sys.path[:0] = {path!r}
from test_compiled import ARGUMENTS, functions
from stiffopt.model.compiled import library
made = []
found = library("f", lambda: made.append(1) or functions())
print(len(made), *found.function("mixed")(*ARGUMENTS)[0][:, 0])
"""


def child(**environment):
    script = CHILD.format(path=[str(Path(__file__).parent)])
    return subprocess.Popen(
        [sys.executable, "-c", script],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_two_processes_at_once(cache):
    children = [child(), child()]
    answers = [process.communicate(timeout=100) for process in children]
    assert [process.returncode for process in children] == [0, 0], answers
    assert sorted(answer[0].split()[0] for answer in answers) == ["0", "1"]  # one waited
    assert answers[0][0].split()[1:] == answers[1][0].split()[1:]
    assert len(code_files(cache)) == 1


def test_killed_in_the_middle(cache, tmp_path):
    """What a build that was killed leaves behind neither counts as code nor blocks the next."""
    slow = fake_compiler(
        tmp_path / "cc",
        f"""
        if [ ! -e {tmp_path}/again ]; then touch {tmp_path}/begun; sleep 5; fi
        exec $CC_REAL "$@"
        """,
    )
    process = child(STIFFOPT_COMPILER=slow)
    end = time.monotonic() + 60
    while not (tmp_path / "begun").exists():
        assert time.monotonic() < end
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert list(cache.glob("build-*"))
    assert not code_files(cache)
    (tmp_path / "again").touch()
    start = time.monotonic()
    process = child(STIFFOPT_COMPILER=slow)
    output, _ = process.communicate(timeout=60)
    assert output.split()[0] == "1"
    assert time.monotonic() - start < 30
    assert len(code_files(cache)) == 1


def test_a_lock_is_waited_for_only_so_long(tmp_path):
    with build.locked(tmp_path / "lock"):
        start = time.monotonic()
        with build.locked(tmp_path / "lock", longest=0.1):
            assert 0.1 <= time.monotonic() - start < 5


# -- the functions of an arm ----------------------------------------------------------------

CALLS = {
    "tip_pose": lambda arm, p: arm.tip_pose(p),
    "tip_jacobian": lambda arm, p: arm.tip_jacobian(p),
    "tip_compliance": lambda arm, p: arm.tip_compliance(p),
    "free": lambda arm, p: arm.stiffness(p, (1, -2, 0.5), frame="tip"),
    "free gradient": lambda arm, p: arm.stiffness_gradient(p, (1, -2, 0.5), "rotation"),
    "guided": lambda arm, p: arm.stiffness(p, (1, -2, 0.5), "rotation", "guided"),
    "clamped gradient": lambda arm, p: arm.stiffness_gradient(p, (1, 0, 1), boundary="clamped"),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-3"])
def test_compiled_maps_are_those_of_the_vm(name, cache, monkeypatch):
    reference = so.load_robot(name)
    ps = np.random.default_rng(0).uniform(0, 1.2e5, (2000, reference.n_pressures))
    expected = {key: call(reference, ps) for key, call in CALLS.items()}
    assert not code_files(cache)  # too few rows to compile for
    monkeypatch.setattr(tip_functions, "COMPILED_FROM", 1500)
    arm = so.load_robot(name)
    for key, call in CALLS.items():
        found = call(arm, ps)
        assert np.abs(found - expected[key]).max() <= 1e-12 * np.abs(expected[key]).max(), key
        for row in (0, 1999):
            assert np.array_equal(call(arm, ps[row]), found[row]), key
        assert call(arm, ps[:0]).shape == expected[key][:0].shape
    assert len(code_files(cache)) == 1
    # from now on small batches use it too, without making anything
    monkeypatch.setattr(tip_functions, "_tip_functions", unexpected)
    as_a_new_process(monkeypatch)
    arm = so.load_robot(name)
    assert np.array_equal(arm.tip_pose(ps[:64]), expected["tip_pose"][:64])
    assert arm._tip._library is not None


def test_bad_rows_of_a_large_batch(monkeypatch):
    monkeypatch.setattr(tip_functions, "COMPILED_FROM", 100)
    arm = so.load_robot("stiff-flop-1")
    ps = np.full((200, 3), 1e4)
    assert arm.tip_pose(ps).shape == (200, 4, 4)
    for value in (np.nan, np.inf):
        ps[150, 1] = value
        with pytest.raises(so.PressureError, match="must be finite"):
            arm.stiffness(ps, (1, 0, 0))
    ps[150, 1] = 1e6
    with pytest.raises(so.PressureError, match="segment 1 of robot 'stiff-flop-1' at"):
        arm.tip_compliance(ps)


@pytest.mark.parametrize(("n", "most"), [(1, 8_000), (2, 16_500), (3, 25_000)])
def test_how_much_is_compiled(n, most):
    """Instructions of the VM, which the time to compile goes by: 3 s for three segments."""
    layout = so.load_robot(f"stiff-flop-{n}").layout
    formulas = tip_functions._tip_functions(layout)
    assert sum(function.n_instructions() for function in formulas) < most
    assert all("int main" not in c_code(function) for function in formulas)
