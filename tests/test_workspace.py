"""Maps of the workspace: true to the model, and the same however they are made."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import stiffopt
from conftest import is_long
from stiffopt.cli.main import main
from stiffopt.errors import (
    CancelledError,
    FileError,
    InputError,
    MissingExtraError,
    OutOfTimeError,
)
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.scene import Scene
from stiffopt.workspace import (
    MapPlan,
    WorkspaceMap,
    map_workspace,
    open_workspace_map,
    store,
)
from stiffopt.workspace.plan import TUNING, Grid, QuasiRandom
from stiffopt.workspace.table import CellTable, Gathering, cell_indices, cell_keys, merged

BLOCK = TUNING.block if is_long() else TUNING.block // 8
SAMPLES = 2 * BLOCK + BLOCK // 8  # three blocks
COMMAND = Path(sys.executable).with_name("stiffopt")


@pytest.fixture(autouse=True, scope="module")
def _blocks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stiffopt.workspace.plan.TUNING", replace(TUNING, block=BLOCK))
        yield


@pytest.fixture(scope="module")
def robot() -> Manipulator:
    return stiffopt.load_robot("stiff-flop-1")


@pytest.fixture(scope="module")
def whole(robot: Manipulator) -> WorkspaceMap:
    """Return the map that all others of these samples must equal."""
    return map_workspace(robot, samples=SAMPLES, cell=0.004, threads=1)


def assert_same(one: WorkspaceMap, other: WorkspaceMap) -> None:
    """Require that two maps agree to the last bit."""
    assert one.lost == other.lost
    assert one.low.tobytes() == other.low.tobytes()
    assert one.high.tobytes() == other.high.tobytes()
    for name, column in one.table.arrays.items():
        same = other.table.arrays[name]
        assert column.dtype == same.dtype, name
        assert column.shape == same.shape, name
        assert column.tobytes() == same.tobytes(), name


def run_script(text: str, *arguments: object, seconds: float = 60) -> str:
    """Run a script in a process of its own and return what it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(text), *map(str, arguments)],
        capture_output=True, text=True, check=False, timeout=seconds,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


# -- samples ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sampling",
    [QuasiRandom((0.0, -5.0, 1.0), (1.0, 5.0, 3.0), 1000, 3), Grid((0.0, -5.0), (1.0, 5.0), 11)],
    ids=["quasi-random", "grid"],
)
def test_a_sample_depends_on_its_number_alone(sampling: QuasiRandom | Grid) -> None:
    together = sampling.pressures(0, sampling.total)
    apart = np.vstack([sampling.pressures(i, i + 1) for i in range(sampling.total)])
    assert together.tobytes() == apart.tobytes()


def test_quasi_random_samples_are_spread_evenly() -> None:
    shares = QuasiRandom((0.0,) * 6, (1.0,) * 6, 4096, 0).shares(0, 4096)
    assert shares.min() >= 0
    assert shares.max() < 1
    counts = [np.histogram(column, 16, (0, 1))[0] for column in shares.T]
    assert np.abs(np.array(counts) - 256).max() < 24  # random ones: about 60
    for a, b in itertools.combinations(range(6), 2):
        square = np.histogram2d(shares[:, a], shares[:, b], 8, [(0, 1), (0, 1)])[0]
        assert np.abs(square - 64).max() < 32


def test_the_recurrence_is_exact_far_out() -> None:
    far = 10**12 - 1
    sampling = QuasiRandom((0.0,), (1.0,), 10**12, 0)
    first, last = sampling.shares(0, 1)[0, 0], sampling.shares(far, far + 1)[0, 0]
    golden = 11400714819323198485  # 2^64 / 1.618...
    step = far * golden % 2**64 / 2**64
    assert (last - first) % 1.0 == pytest.approx(step, abs=1e-15)


def test_seeds_give_other_samples() -> None:
    a, b = (QuasiRandom((0.0,), (1.0,), 100, seed).shares(0, 100) for seed in (0, 1))
    assert not np.isclose(a, b).any()


def test_a_grid_has_every_combination_of_levels_limits_included() -> None:
    grid = Grid((0.0, 1.0), (2.0, 5.0), 3)
    expected = list(itertools.product([0.0, 1.0, 2.0], [1.0, 3.0, 5.0]))
    np.testing.assert_array_equal(grid.pressures(0, grid.total), expected)


# -- cells ------------------------------------------------------------------------------------


def test_cells_are_centred_at_multiples_of_their_size() -> None:
    position = np.array([[0.0, 0.0049, -0.0049], [0.0051, -0.0051, 0.0149], [-1.0, 2.0, 0.123]])
    expected = [[0, 0, 0], [1, -1, 1], [-100, 200, 12]]
    np.testing.assert_array_equal(cell_indices(position, 0.01), expected)


@given(st.lists(st.tuples(*[st.integers(-500_000, 500_000)] * 3), min_size=1, max_size=20))
def test_keys_of_cells_can_be_unpacked_and_sort_like_them(cells: list[tuple[int, ...]]) -> None:
    indices = np.array(sorted(cells))
    keys = cell_keys(indices)
    assert (np.diff(keys) >= 0).all()
    table = CellTable.of_samples(keys, np.ones((1, len(keys))), np.arange(len(keys)))
    np.testing.assert_array_equal(table.cells, np.unique(indices, axis=0))


rows = st.lists(
    st.tuples(st.integers(0, 5), st.sampled_from([1.0, 2.0, 3.0])), min_size=1, max_size=40
)


@given(rows, st.randoms(use_true_random=False))
def test_merging_does_not_depend_on_groups_and_order(rows: Any, random: Any) -> None:
    expected: dict[int, list[Any]] = {}
    for sample, (key, value) in enumerate(rows):
        cell = expected.setdefault(key, [0, value, value, sample, sample])
        cell[0] += 1
        if value > cell[1]:
            cell[1], cell[3] = value, sample
        if value < cell[2]:
            cell[2], cell[4] = value, sample
    pieces, start = [], 0
    while start < len(rows):
        end = start + random.randint(1, 7)
        part = rows[start:end]
        keys = np.array([key for key, _ in part])
        values = np.array([[value for _, value in part]])
        pieces.append(CellTable.of_samples(keys, values, np.arange(start, start + len(part))))
        start = end
    random.shuffle(pieces)
    gathering = Gathering(CellTable.empty(1), TUNING.most_cells)
    for piece in pieces:
        gathering.add(piece)
    for table in (gathering.table(), merged(pieces)):
        columns = zip(
            table.count, table.best[0], table.worst[0], table.best_sample[0],
            table.worst_sample[0], strict=True,
        )  # fmt: skip
        assert {k: list(v) for k, v in zip(table.key, columns, strict=True)} == expected


def test_too_many_cells_are_refused(monkeypatch: pytest.MonkeyPatch, robot: Manipulator) -> None:
    monkeypatch.setattr("stiffopt.workspace.mapping.TUNING", replace(TUNING, most_cells=100))
    with pytest.raises(InputError, match=r"fills more than 100 cells.*larger cells"):
        map_workspace(robot, samples=2000, cell=0.002)


# -- against a loop over the model ------------------------------------------------------------

MEASURES: list[dict[str, Any]] = [
    {},
    {"kind": "rotation", "boundary": "guided", "frame": "tip"},
    {"boundary": "clamped", "directions": [[0, 3, 4]]},
]


def brute_force(robot: Manipulator, found: WorkspaceMap) -> dict[tuple[int, ...], list[Any]]:
    """Range of stiffness of each cell, from one call of the model for each sample."""
    cells: dict[tuple[int, ...], list[Any]] = {}
    for sample in range(found.samples):
        p = found.pressures(sample)
        tip = robot.tip_pose(p)[:3, 3]
        cell = tuple(int(np.floor(x / found.plan.cell + 0.5)) for x in tip)
        values = [robot.stiffness(p, *measure) for measure in found.plan.measures]
        cells.setdefault(cell, []).append((sample, values))
    return cells


@pytest.mark.one_in(3)
@pytest.mark.parametrize("asked", MEASURES, ids=["default", "rotation", "clamped"])
@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
def test_a_map_says_what_the_model_says(name: str, asked: dict[str, Any]) -> None:
    arm = stiffopt.load_robot(name)
    found = map_workspace(arm, samples=25 if arm.is_loaded else 300, cell=0.03, seed=5, **asked)
    expected = brute_force(arm, found)
    assert [tuple(cell) for cell in found.cells] == sorted(expected)
    for row, cell in enumerate(map(tuple, found.cells)):
        samples, values = zip(*expected[cell], strict=True)
        stiffness = np.array(values).T  # (m, k)
        assert found.count[row] == len(samples)
        np.testing.assert_allclose(found.best[:, row], stiffness.max(axis=1), rtol=1e-9)
        np.testing.assert_allclose(found.worst[:, row], stiffness.min(axis=1), rtol=1e-9)
        for m in range(len(stiffness)):
            for sample, value in (
                (found.best_sample[m, row], found.best[m, row]),
                (found.worst_sample[m, row], found.worst[m, row]),
            ):
                assert stiffness[m][samples.index(sample)] == pytest.approx(value, rel=1e-9)


def test_extremes_and_volume_and_boxes(robot: Manipulator) -> None:
    found = map_workspace(robot, samples=3000, cell=0.005)
    for m, direction in enumerate(np.eye(3)):
        for extreme, choose in ((found.best_in(m), np.max), (found.worst_in(m), np.min)):
            assert extreme is not None
            assert extreme.stiffness == choose(found.grid("best" if choose is np.max else "worst")[
                m][found.grid("count") > 0])  # fmt: skip
            value = robot.stiffness(extreme.pressures, direction)
            assert value == pytest.approx(extreme.stiffness, rel=1e-9)
            tip = robot.tip_pose(extreme.pressures)[:3, 3]
            assert np.abs(tip - extreme.cell_centre).max() <= 0.0025 + 1e-9
    box = found.grid("count")
    assert box.sum() == 3000
    assert (box > 0).sum() * 0.005**3 == pytest.approx(found.volume)
    assert np.isnan(found.grid("best")[:, box == 0]).all()
    assert (found.grid("worst_sample")[:, box == 0] == -1).all()
    tips = robot.tip_pose(found.plan.sampling.pressures(0, 3000))[:, :3, 3]
    np.testing.assert_allclose(found.low, tips.min(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.high, tips.max(axis=0), rtol=1e-12)


def test_grid_of_pressures(robot: Manipulator) -> None:
    found = map_workspace(robot, levels=4, cell=0.01)
    assert found.samples == found.count.sum() == 4**3
    assert sorted(expected := brute_force(robot, found)) == [tuple(c) for c in found.cells]
    assert [len(expected[cell]) for cell in sorted(expected)] == found.count.tolist()


def test_samples_without_equilibrium_are_counted_and_left_out(tmp_path: Path) -> None:
    description = stiffopt.load_robot("stiff-flop-2-hanging").description
    upright = description.model_copy(update={"gravity": (0.0, 0.0, -9.81), "tip_mass": 1.0})
    path = tmp_path / "none.zarr"
    found = map_workspace(stiffopt.load_robot(upright), path, samples=4)
    assert found.lost == 4
    assert len(found.table) == found.volume == 0
    assert found.best_in(0) is None
    assert_same(found, open_workspace_map(path))


# -- the same however it is made --------------------------------------------------------------


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_make_no_difference(
    robot: Manipulator, whole: WorkspaceMap, threads: int, tmp_path: Path
) -> None:
    path = tmp_path / "map.zarr"
    found = map_workspace(robot, path, samples=SAMPLES, cell=0.004, threads=threads)
    assert_same(found, whole)
    assert_same(open_workspace_map(path), whole)
    again = map_workspace(robot, path, samples=SAMPLES, cell=0.004)
    assert again.evaluated == 0
    assert_same(again, whole)


class Stop(Exception):  # noqa: N818
    pass


def test_a_run_goes_on_where_it_stopped(
    robot: Manipulator, whole: WorkspaceMap, tmp_path: Path
) -> None:
    path = tmp_path / "map.zarr"
    reports: list[int] = []

    def stop_at(sample: int) -> Any:
        def report(done: int, total: int) -> None:
            reports.append(done)
            if done >= sample:
                raise Stop

        return report

    for stop in (1, BLOCK + 1):
        with pytest.raises(Stop):
            map_workspace(
                robot, path, samples=SAMPLES, cell=0.004, threads=1, progress=stop_at(stop)
            )
        with pytest.raises(FileError, match="not complete"):
            open_workspace_map(path)
    found = map_workspace(robot, path, samples=SAMPLES, cell=0.004, progress=stop_at(10**9))
    assert found.evaluated == SAMPLES - 2 * BLOCK
    assert reports == sorted(reports)
    assert_same(found, whole)


def test_a_run_that_is_given_up_goes_on(
    robot: Manipulator, whole: WorkspaceMap, tmp_path: Path
) -> None:
    path = tmp_path / "map.zarr"
    with pytest.raises(OutOfTimeError):
        map_workspace(robot, path, samples=SAMPLES, cell=0.004, timeout=1e-9)
    with pytest.raises(CancelledError):
        map_workspace(robot, path, samples=SAMPLES, cell=0.004, cancel=lambda: True)
    assert_same(map_workspace(robot, path, samples=SAMPLES, cell=0.004), whole)


def test_a_run_survives_being_killed(
    robot: Manipulator, whole: WorkspaceMap, tmp_path: Path
) -> None:
    path = tmp_path / "map.zarr"
    script = f"""
        import sys, time, stiffopt
        from dataclasses import replace
        from stiffopt.workspace import map_workspace, mapping, plan
        plan.TUNING = replace(plan.TUNING, block={BLOCK})
        mapping.TUNING = replace(mapping.TUNING, checkpoint=1e-9, checkpoint_share=1e9)
        def report(done, total):
            if done:
                time.sleep(0.2)
        robot = stiffopt.load_robot("stiff-flop-1")
        map_workspace(robot, sys.argv[1], samples={SAMPLES}, cell=0.004, progress=report)
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script), str(path)])
    try:
        end = time.monotonic() + 30
        while not (path / "checkpoint.npz").exists() and time.monotonic() < end:
            assert process.poll() is None
            time.sleep(0.005)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not store.MapStore(path).is_complete
    found = map_workspace(robot, path, samples=SAMPLES, cell=0.004)
    assert 0 < found.evaluated < SAMPLES
    assert_same(found, whole)
    assert_same(open_workspace_map(path), whole)
    assert sorted(entry.name for entry in path.iterdir()) == [
        "best", "best_sample", "count", "direction", "worst", "worst_sample", "x", "y", "z",
        "zarr.json",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "step", ["store.write_arrays", "store._write_coordinates", "store._write_json"]
)
def test_a_run_survives_being_killed_at_the_end(
    robot: Manipulator, tmp_path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.zarr"
    with pytest.raises(Stop):
        map_workspace(robot, path, samples=500, progress=_raise_at(1))

    def stop(*_: Any) -> None:
        raise Stop

    with monkeypatch.context() as patched:
        patched.setattr(f"stiffopt.workspace.{step}", stop)
        with pytest.raises(Stop):
            map_workspace(robot, path, samples=500)
    assert not store.MapStore(path).is_complete
    assert_same(map_workspace(robot, path, samples=500), map_workspace(robot, samples=500))
    assert_same(open_workspace_map(path), map_workspace(robot, samples=500))


def test_an_interrupt_in_the_middle_of_a_step_counts_nothing_twice(
    robot: Manipulator, whole: WorkspaceMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.zarr"
    add, calls = Gathering.add, []

    def interrupted_add(self: Gathering, table: CellTable) -> None:
        add(self, table)
        calls.append(table)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Gathering, "add", interrupted_add)
        with pytest.raises(KeyboardInterrupt):
            map_workspace(robot, path, samples=SAMPLES, cell=0.004)
    assert_same(map_workspace(robot, path, samples=SAMPLES, cell=0.004), whole)


def _raise_at(sample: int) -> Any:
    def report(done: int, total: int) -> None:
        if done >= sample:
            raise Stop

    return report


def test_plans_go_to_other_processes(robot: Manipulator) -> None:
    loaded = robot.with_load([0, 0, 0.01], frame="tip")
    for arm in (robot, loaded):
        plan = MapPlan.of(arm, samples=10, directions=[[1, 2, 3]], frame="tip")
        assert pickle.loads(pickle.dumps(plan)).token == plan.token
    assert MapPlan.of(robot, samples=10).token != MapPlan.of(loaded, samples=10).token


def test_a_tip_load_is_kept_with_the_map(robot: Manipulator, tmp_path: Path) -> None:
    loaded = robot.with_load([0.001, 0, 0.002], [0, 1e-5, 0], "tip")
    map_workspace(loaded, tmp_path / "map.zarr", samples=3)
    plan = open_workspace_map(tmp_path / "map.zarr").plan
    assert plan.token == MapPlan.of(loaded, samples=3).token


CLUSTER = """
    import os, signal, sys
    import stiffopt
    from distributed import LocalCluster
    from stiffopt.workspace import map_workspace, open_workspace_map

    def main():
        folder, samples = sys.argv[1], int(sys.argv[2])
        robot = stiffopt.load_robot("stiff-flop-1")
        with LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1",
            dashboard_address=None,
        ) as cluster:
            pids = cluster.scheduler_info["workers"]
            address = cluster.scheduler_address
            map_workspace(
                robot, f"{folder}/a.zarr", samples=samples, cell=0.004, scheduler=address
            )
            victims = [next(iter(cluster.workers.values())).process.process.pid]

            def kill_one(done, total):
                if done and victims:
                    os.kill(victims.pop(), signal.SIGKILL)

            map_workspace(
                robot, f"{folder}/b.zarr", samples=samples, cell=0.004, scheduler=address,
                progress=kill_one,
            )
            assert not victims

    if __name__ == "__main__":
        main()
"""


def test_what_a_scene_forbids_is_left_out(tmp_path: Path) -> None:
    robot = load_robot("stiff-flop-1")
    wall = {"name": "wall", "half_space": {"point": (0.02, 0, 0), "normal": (-1, 0, 0)}}
    scene = Scene(clearance=2e-3, objects=[wall])
    found = map_workspace(robot, tmp_path / "a.zarr", samples=300, cell=0.02, scene=scene)
    whole = map_workspace(robot, samples=300, cell=0.02)
    pressures = found.plan.sampling.pressures(0, 300)
    clear = robot.clearance(pressures, scene) >= scene.clearance
    assert 30 < clear.sum() < 270
    assert found.count.sum() == clear.sum() < whole.count.sum()
    assert found.lost == 0
    assert found.high[0] == pytest.approx(robot.tip_pose(pressures[clear])[:, 0, 3].max())
    assert open_workspace_map(tmp_path / "a.zarr").plan.scene == scene
    near = {"name": "wall", "half_space": {"point": (0.01, 0, 0), "normal": (-1, 0, 0)}}
    with pytest.raises(InputError, match="wall"):
        map_workspace(robot, samples=10, scene=Scene(objects=[near]))


@pytest.mark.skipif(find_spec("distributed") is None, reason="distributed is not installed")
def test_a_cluster_makes_no_difference_even_if_it_loses_a_worker(
    robot: Manipulator, tmp_path: Path
) -> None:
    samples = 150_000 if is_long() else 70_000  # five blocks or three
    script = tmp_path / "cluster.py"
    script.write_text(textwrap.dedent(CLUSTER), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script, tmp_path, str(samples)],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    whole = map_workspace(robot, samples=samples, cell=0.004)
    for name in ("a.zarr", "b.zarr"):
        assert_same(open_workspace_map(tmp_path / name), whole)


@pytest.mark.skipif(find_spec("distributed") is None, reason="distributed is not installed")
def test_a_cluster_that_is_not_there(tmp_path: Path) -> None:
    told = run_script(
        """
        import sys, stiffopt
        from stiffopt.errors import InputError
        from dataclasses import replace
        from stiffopt.workspace import map_workspace, workers
        workers.TUNING = replace(workers.TUNING, cluster_patience=1.0)
        robot = stiffopt.load_robot("stiff-flop-1")
        for address, kind in (("tcp://127.0.0.1:1", workers.ClusterError), ("a:b:c", InputError)):
            try:
                map_workspace(robot, samples=10, scheduler=address)
            except kind as error:
                print(error)
        """
    )
    first, second = told.splitlines()
    assert "no scheduler answers at tcp://127.0.0.1:1" in first
    assert "'a:b:c' is not the address of a scheduler" in second


# -- memory -----------------------------------------------------------------------------------

MEASURED = """
    import resource, sys, time, stiffopt
    from pathlib import Path
    from stiffopt.workspace import map_workspace
    robot = stiffopt.load_robot("stiff-flop-2")
    map_workspace(robot, samples=100)
    begin = time.perf_counter()
    map_workspace(robot, sys.argv[1], samples=int(float(sys.argv[2])))
    status = Path("/proc/self/status")  # the other figure starts with that of the parent process
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if status.exists():
        (line,) = [own for own in status.read_text().splitlines() if "VmHWM" in own]
        peak = int(line.split()[1])
    peak *= 1024
    print(time.perf_counter() - begin, peak)
"""


def test_memory_is_bounded(tmp_path: Path) -> None:
    _, peak = map(
        float, run_script(MEASURED, tmp_path / "map.zarr", 1e5 if is_long() else 7e4).split()
    )
    assert peak < 400e6


@pytest.mark.long
def test_ten_million_samples(tmp_path: Path) -> None:
    seconds, peak = map(
        float, run_script(MEASURED, tmp_path / "map.zarr", 1e7, seconds=600).split()
    )
    assert peak < 1e9
    assert seconds < 60  # 30 where nothing else runs


# -- what is stored ---------------------------------------------------------------------------


def test_any_zarr_reader_can_read_it(robot: Manipulator, tmp_path: Path) -> None:
    import zarr

    path = tmp_path / "map.zarr"
    found = map_workspace(robot, path, samples=3000, cell=0.002, directions=[[0, 3, 4]])
    group = zarr.open_group(str(path), mode="r", zarr_format=3)
    assert group.attrs["status"] == "complete"
    assert group.attrs["seed"] == 0
    assert group.attrs["stiffness_unit"] == "N/m"
    assert group.attrs["stiffopt_version"] == stiffopt.__version__
    for name in ("count", "best", "worst", "best_sample", "worst_sample"):
        array = group[name]
        assert array.metadata.dimension_names[-3:] == ("x", "y", "z")
        assert max(array.chunks) <= 32 < max(array.shape)
        np.testing.assert_array_equal(array[...], found.grid(name))
    assert list(group["direction"][...]) == ["(0, 0.6, 0.8)"]
    origin = found.cells.min(axis=0) * 0.002
    np.testing.assert_allclose([group[axis][0] for axis in "xyz"], origin, atol=1e-15)
    np.testing.assert_allclose(group.attrs["origin_m"], origin, atol=1e-15)


def test_other_settings_are_refused_by_name(robot: Manipulator, tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    first = map_workspace(robot, path, samples=100)
    with pytest.raises(FileError, match="seed is 0 there and 7 here"):
        map_workspace(robot, path, samples=100, seed=7)
    with pytest.raises(FileError, match=r"cell_m is 0.01 there and 0.02 here.*overwrite"):
        map_workspace(robot, path, samples=100, cell=0.02)
    with pytest.raises(FileError, match="robot is 'stiff-flop-1' there and 'stiff-flop-2' here"):
        map_workspace(stiffopt.load_robot("stiff-flop-2"), path, samples=100)
    assert_same(open_workspace_map(path), first)
    second = map_workspace(robot, path, samples=100, seed=7, overwrite=True)
    assert_same(open_workspace_map(path), second)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.zarr"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("kind", ["file", "folder", "other group", "no json", "dangling link"])
def test_what_is_no_map_is_refused_and_kept(
    robot: Manipulator, tmp_path: Path, kind: str, overwrite: bool
) -> None:
    path = tmp_path / "map.zarr"
    inside = path / "zarr.json"
    if kind == "file":
        path.write_text("precious")
    elif kind == "dangling link":
        path.symlink_to(tmp_path / "nothing")
    else:
        path.mkdir()
        texts = {"other group": '{"zarr_format": 3, "attributes": {}}', "no json": "{"}
        (inside if kind != "folder" else path / "precious").write_text(texts.get(kind, "precious"))
    before = sorted((p, p.is_file() and p.read_bytes()) for p in tmp_path.rglob("*"))
    with pytest.raises(FileError, match="is not a map"):
        map_workspace(robot, path, samples=10, overwrite=overwrite)
    assert sorted((p, p.is_file() and p.read_bytes()) for p in tmp_path.rglob("*")) == before


def test_an_empty_folder_will_do(robot: Manipulator, tmp_path: Path) -> None:
    assert map_workspace(robot, tmp_path, samples=10).path == tmp_path


def test_one_process_at_a_time(robot: Manipulator, tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    path = tmp_path / "map.zarr"
    with pytest.raises(Stop):
        map_workspace(robot, path, samples=100, progress=_raise_at(0))
    for overwrite in (False, True):
        with (
            store.MapStore(path).locked(),
            pytest.raises(FileError, match="another process is working on this map"),
        ):
            map_workspace(robot, path, samples=100, overwrite=overwrite)


def test_damage_is_noticed(robot: Manipulator, tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    with pytest.raises(Stop):
        map_workspace(robot, path, samples=BLOCK + 99, threads=1, progress=_raise_at(1))
    checkpoint = path / "checkpoint.npz"
    content = bytearray(checkpoint.read_bytes())
    content[len(content) // 2] ^= 1
    checkpoint.write_bytes(content)
    with pytest.raises(FileError, match=r"is damaged.*--overwrite"):
        map_workspace(robot, path, samples=BLOCK + 99)
    map_workspace(robot, path, samples=10, overwrite=True)
    (path / "best" / "zarr.json").unlink()
    with pytest.raises(FileError, match="is damaged"):
        open_workspace_map(path)


def test_a_full_disk_is_one_message(
    robot: Manipulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(FileError, match="cannot be written: no space left on device"):
        map_workspace(robot, tmp_path / "map.zarr", samples=100)


# -- arguments --------------------------------------------------------------------------------

WRONG: list[tuple[dict[str, Any], str]] = [
    ({"samples": 0}, "samples must be an integer of at least 1"),
    ({"samples": 10, "levels": 3}, "samples or levels, not both"),
    ({"levels": 1}, "levels must be an integer of at least 2"),
    ({"levels": 100_000}, "too many"),
    ({"cell": 0.0}, "cell.*must be between"),
    ({"cell": 1.0}, "cell.*must be between"),
    ({"cell": float("nan")}, "cell must be a finite number"),
    ({"seed": -1}, "seed must be"),
    ({"directions": []}, "directions must not be empty"),
    ({"directions": [1, 0, 0]}, "list of directions, not one"),
    ({"directions": 3}, "list of directions"),
    ({"directions": [[0, 0, 0]]}, "must not be zero"),
    ({"directions": [[1, 0, 0], [2, 0, 0]]}, "x is named twice"),
    ({"kind": "both"}, "unknown kind 'both'"),
    ({"threads": 0}, "threads must be"),
    ({"threads": 2, "scheduler": "tcp://a:1"}, "threads or a scheduler, not both"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=[message for _, message in WRONG])
def test_wrong_arguments(robot: Manipulator, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        map_workspace(robot, **arguments)


def test_missing_extras_are_named(
    robot: Manipulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'stiffopt\[map\]'"):
        map_workspace(robot, tmp_path / "map.zarr", samples=10)
    with pytest.raises(MissingExtraError, match=r"pip install 'stiffopt\[dask\]'"):
        map_workspace(robot, samples=10, scheduler="tcp://127.0.0.1:1")
    assert not list(tmp_path.iterdir())
    assert map_workspace(robot, samples=10).samples == 10  # needs neither


# -- the command ------------------------------------------------------------------------------


def command(*arguments: object) -> int:
    return main(["map", "workspace", *map(str, arguments)])


def test_json(tmp_path: Path, capsys: pytest.CaptureFixture[str], robot: Manipulator) -> None:
    path = tmp_path / "map.zarr"
    options = ["stiff-flop-1", "--samples", 500, "--cell", "5 mm", "--direction", "0,3,-4",
               "--direction", "z", "--out", path, "--json"]  # fmt: skip
    assert command(*options) == 0
    said = json.loads(capsys.readouterr().out)
    found = open_workspace_map(path)
    assert said["file"] == str(path)
    assert said["samples"] == said["samples_evaluated"] == 500
    assert said["cells"] == len(found.table)
    assert said["reach_volume_m3"] == found.volume
    assert said["stiffness_unit"] == "N/m"
    tilted = said["stiffnesses"][0]
    assert tilted["direction"] == [0, 0.6, -0.8]
    again = robot.stiffness(tilted["best"]["pressures_pa"], [0, 3, -4])
    assert again == pytest.approx(tilted["best"]["stiffness"], rel=1e-9)
    assert command(*options) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["samples_evaluated"] == 0
    assert "is complete" in printed.err


def test_table_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "map.png"
    assert command("stiff-flop-1", "--samples", 5000, "--plot", picture) == 0
    printed = capsys.readouterr()
    assert not printed.err
    for part in ("stiff-flop-1", "5,000", "cm^3", "stiffest", "softest", "samples a second"):
        assert part in printed.out
    assert max(map(len, printed.out.splitlines())) <= 80
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_quiet_hanging_and_rotation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "map.svg"
    arguments = ["stiff-flop-2-hanging", "--samples", 20, "--direction", "x", "--plot", picture]
    assert command(*arguments, "--kind", "rotation", "--frame", "tip", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert "<svg" in picture.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["no-such-robot"], "there is no robot 'no-such-robot'"),
        (["stiff-flop-1", "--cell", "5"], "--cell: '5' has no unit"),
        (["stiff-flop-1", "--cell", "5 bar"], "--cell: "),
        (["stiff-flop-1", "--direction", "up"], "--direction: 'up' is no direction"),
        (["stiff-flop-1", "--direction", "nan,0,0"], "direction must be 3 finite numbers"),
        (["stiff-flop-1", "--boundary", "loose"], "unknown boundary 'loose'"),
        (["stiff-flop-1", "--samples", "0"], "--samples"),
        (["stiff-flop-1", "--samples", "10", "--levels", "3"], "not both"),
        (["stiff-flop-1", "--timeout", "5"], "--timeout: '5' has no unit"),
        (["stiff-flop-1", "--timeout", "0 s"], "timeout must be"),
        (["stiff-flop-1", "--plot", "map.txt"], "expected a name that ends in .png"),
        (["stiff-flop-1", "--out", "no/such/map.zarr"], "there is no folder"),
    ],
    ids=lambda value: " ".join(value[1:]) if isinstance(value, list) else "",
)
def test_bad_input(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(*arguments) == 2
    printed = capsys.readouterr()
    assert not printed.out
    assert message in " ".join(printed.err.split())
    assert not list(tmp_path.iterdir())


def test_out_of_time_stops_and_the_same_command_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "map.zarr"
    options = ("stiff-flop-1", "--samples", 3000, "--out", path)
    assert command(*options, "--timeout", "1 us") == 130
    printed = capsys.readouterr()
    assert not printed.out
    said = " ".join(printed.err.split())
    assert "out of time; stopped after 0 of 3,000 samples; the same command goes on" in said
    assert command(*options, "--timeout", "1 h", "--quiet") == 0
    assert open_workspace_map(path).table.count.sum() == 3000


def interrupted(path: Path, wait_for: str = "") -> str:
    """Start a long map, press Ctrl-C once it has said something, and return what is on stderr."""
    said = path.with_suffix(".txt")
    with said.open("w") as stream:
        process = subprocess.Popen(
            [
                COMMAND, "map", "workspace", "stiff-flop-2-hanging",
                "--samples", "100000", "--out", path,
            ],
            stdout=subprocess.PIPE, stderr=stream, text=True,
        )  # fmt: skip
        try:
            end = time.monotonic() + 60
            while time.monotonic() < end:
                if path.exists() and wait_for in " ".join(said.read_text().split()):
                    break
                time.sleep(0.01)
            time.sleep(1.0 if not wait_for else 0.2)  # for some samples
            os.kill(process.pid, signal.SIGINT)
            out, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130, said.read_text()
    assert not out
    return " ".join(said.read_text().split())


def test_ctrl_c_stops_and_the_same_command_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    said = interrupted(path)
    stopped = re.search(r"stopped after ([\d,]+) of 100,000 samples; the same command", said)
    assert stopped, said
    assert said.endswith(f"goes on with {path} interrupted")
    going_on = stopped[1] != "0"
    said = interrupted(path, "goes on after" if going_on else "")
    if going_on:
        assert f"goes on after {stopped[1]} of 100,000 samples" in said
