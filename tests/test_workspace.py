"""Maps of the workspace: samples, cells, against a loop over the model, and what is stored."""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import stiffopt
from stiffopt.errors import FileError, InputError, MissingExtraError
from stiffopt.model.manipulator import Manipulator
from stiffopt.workspace import WorkspaceMap, map_workspace, open_workspace_map, store
from stiffopt.workspace.plan import TUNING, Grid, QuasiRandom
from stiffopt.workspace.table import CellTable, Gathering, cell_indices, cell_keys, merged
from workspace_maps import BLOCK, Stop, _blocks, _raise_at, assert_same, robot_fixture  # noqa: F401


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
    gathering = Gathering(CellTable.empty(1), TUNING.max_cells)
    for piece in pieces:
        gathering.add(piece)
    for table in (gathering.table(), merged(pieces)):
        columns = zip(
            table.count, table.best[0], table.worst[0], table.best_sample[0],
            table.worst_sample[0], strict=True,
        )  # fmt: skip
        assert {k: list(v) for k, v in zip(table.key, columns, strict=True)} == expected


def test_too_many_cells_are_refused(monkeypatch: pytest.MonkeyPatch, robot: Manipulator) -> None:
    monkeypatch.setattr("stiffopt.workspace.mapping.TUNING", replace(TUNING, max_cells=100))
    with pytest.raises(InputError, match=r"fills more than 100 cells.*larger cells"):
        map_workspace(robot, samples=2000, cell=0.002)


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
