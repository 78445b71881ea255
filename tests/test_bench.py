"""The bench of recordings: splits by file, every method, the same result each time."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from made_logs import course, made_log
from stiffopt.cli.main import main
from stiffopt.errors import MissingExtraError
from stiffopt.identify import bench
from stiffopt.logs import write_log
from stiffopt.model.history import History
from stiffopt.model.robot_files import load_description

needs_sklearn = pytest.mark.skipif(find_spec("sklearn") is None, reason="needs scikit-learn")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of an arm that lags, one to train and one to test, and their splits."""
    path = tmp_path_factory.mktemp("bench")
    robot = load_description("stiff-flop-1")
    segment = robot.segments[0].model_copy(update={"history": History(lag=0.3)})
    arm = robot.model_copy(update={"segments": (segment,)})
    for seed, name in enumerate(("train.csv", "test.csv")):
        time, pressures = course(3, 60.0, seed, rate=5.0)
        write_log(path / name, made_log(arm, time, pressures, seed=seed))
    arms: list[dict[str, Any]] = [
        {"name": "one", "robot": "stiff-flop-1", "train": ["train.csv"], "test": ["test.csv"]},
        {"name": "elsewhere", "robot": "stiff-flop-1", "train": ["not-there.csv"]},
        {"name": "train only", "robot": "stiff-flop-1", "train": ["train.csv"]},
    ]
    text = yaml.safe_dump({"format": "stiffopt-bench/1", "arms": arms})
    (path / "splits.yaml").write_text(text, encoding="utf-8")
    return path


def scores(folder: Path, *methods: str, arms: int = 3) -> dict[tuple[str, str], bench.BenchScore]:
    read, base = bench.load_bench(str(folder / "splits.yaml"))
    read = read.model_copy(update={"arms": read.arms[:arms]})
    found = bench.run_bench(folder, methods, read, base, rows=60)
    return {(each.arm, each.method): each for each in found}


def test_each_method_is_measured_in_files_that_it_has_not_seen(folder: Path) -> None:
    found = scores(folder, "stiffopt", arms=1) | scores(folder, "constant-curvature")
    assert {arm for arm, _ in found} == {"one", "train only"}  # the other's file is not there
    ours, arcs = found["one", "stiffopt"], found["one", "constant-curvature"]
    assert ours.test < 1.5e-3 < arcs.test < 15e-3
    assert ours.test < ours.p95
    assert ours.rows == 300
    assert arcs.rows == 60
    assert 0.5 < arcs.coverage <= 1
    assert 0.5 < ours.coverage <= 1
    assert np.isnan(found["train only", "constant-curvature"].test)


@needs_sklearn
def test_learnt_methods_are_reproducible(folder: Path) -> None:
    names = ("polynomial", "gaussian-process", "network")
    found = scores(folder, *names, arms=1)
    for name in names:
        assert found["one", name].test < 25e-3
        assert found["one", name].train <= found["one", name].test
    again = scores(folder, "network", arms=1)["one", "network"]
    assert again == found["one", "network"]


def test_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "recordings", str(folder), "--splits", str(folder / "splits.yaml")]
    command += ["--methods", "constant-curvature", "--rows", "60"]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [each["arm"] for each in found["scores"]] == ["one", "train only"]
    assert found["scores"][1]["test_mean_error_m"] is None
    assert found["scores"][0]["test_p95_error_m"] > found["scores"][0]["test_mean_error_m"]
    assert main(command) == 0
    table = capsys.readouterr().out
    assert "constant-curvature" in table
    assert "coverage" in table
    assert main(["bench", "recordings", str(folder), "--methods", "magic"]) == 2
    assert "there is no method 'magic'" in capsys.readouterr().err
    assert main(["bench", "recordings", str(folder / "nowhere")]) == 2
    assert "none of the arms" in capsys.readouterr().err


def test_the_bench_that_comes_with_stiffopt_names_robots_that_exist() -> None:
    read, base = bench.load_bench()
    for arm in read.arms:
        assert load_description(arm.robot, base=base).n_pressures in (3, 6)
        assert not set(arm.train) & set(arm.test)


def test_a_method_without_its_package_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "sklearn", None)
    with pytest.raises(MissingExtraError, match="baselines"):
        scores(folder, "polynomial")


def test_an_arc_is_that_of_the_paper() -> None:
    """Constant curvature with its own gains follows an arm that has no elongation to a hair."""
    robot = load_description("stiff-flop-1")
    time, pressures = course(3, 30.0, 0, rate=5.0)
    log = made_log(robot, time, 0.2 * pressures, noise=0.0)
    arm = bench.BenchArm(name="a", robot="stiff-flop-1", train=("a",), test=())
    task = bench.BenchTask(
        arm, robot, {"a": replace(log)}, bench.CalibrationSettings(rows=60), 60, 0
    )
    found = bench.constant_curvature(task)["a"]
    assert np.linalg.norm(found.errors, axis=1).mean() < 1.5e-3
