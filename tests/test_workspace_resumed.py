"""A map is the same however it is made: threads, processes, stopped, killed, resumed."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from conftest import is_long
from stiffopt.errors import CancelledError, FileError, InputError, OutOfTimeError
from stiffopt.model.manipulator import Manipulator, load_robot
from stiffopt.model.scene import Scene
from stiffopt.workspace import WorkspaceMap, map_workspace, open_workspace_map, store
from stiffopt.workspace.plan import TUNING, MapPlan
from stiffopt.workspace.table import CellTable, Gathering
from stiffopt.workspace.workers import ResultLostError, results
from workspace_maps import BLOCK, Stop, _blocks, _raise_at, assert_same, robot_fixture  # noqa: F401

SAMPLES = 2 * BLOCK + BLOCK // 8  # three blocks


@pytest.fixture(scope="module")
def whole(robot: Manipulator) -> WorkspaceMap:
    """Return the map that all others of these samples must equal."""
    return map_workspace(robot, samples=SAMPLES, cell=0.004, threads=1)


def run_script(text: str, *arguments: object, seconds: float = 60) -> str:
    """Run a script in a process of its own and return what it prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(text), *map(str, arguments)],
        capture_output=True, text=True, check=False, timeout=seconds,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


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


class Losing:
    """Workers that lose the result of a block so many times: the block is its own future."""

    width = 2

    def __init__(self, block: int, times: int) -> None:
        self._block, self._times, self.begun = block, times, list[int]()

    def submit(self, index: int, done: Callable[[int, Any], None]) -> None:
        self.begun.append(index)
        done(index, index)

    def result(self, future: Any) -> Any:
        if future == self._block and self._times:
            self._times -= 1
            raise ResultLostError("lost")
        return future

    def check(self) -> None:
        """Do nothing."""


def test_a_block_whose_result_is_lost_is_computed_again() -> None:
    workers: Any = Losing(1, times=TUNING.retries)
    assert list(results(workers, range(3))) == [0, 1, 2]
    assert sorted(workers.begun) == [0, *[1] * (1 + TUNING.retries), 2]
    workers = Losing(0, times=TUNING.retries + 1)
    with pytest.raises(ResultLostError):
        list(results(workers, range(3)))


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
