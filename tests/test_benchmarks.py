"""The speed benchmarks: their models, their arithmetic, their report, and counts on record.

Times are not tested.  What is compared with the record (``benchmarks/results/counts.json``) are
counts, which do not depend on the machine; ``benchmarks/counts.py --update`` renews it.
"""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

HERE = Path(__file__).parent
BENCHMARKS = HERE.parent / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import contact  # noqa: E402
import counts  # noqa: E402
import environment  # noqa: E402
import plots  # noqa: E402
import report  # noqa: E402
import tasks  # noqa: E402
import timing  # noqa: E402
from peers import paper  # noqa: E402
from peers.base import Peer, PeerMissingError  # noqa: E402
from peers.ipopt import Ipopt, IpoptEnergy  # noqa: E402
from peers.own import Stiffopt  # noqa: E402
from peers.pink_chain import Pink  # noqa: E402
from peers.slsqp import Slsqp  # noqa: E402
from report import Comparison, Section, at_least, at_most  # noqa: E402
from stiffopt import PressureSolver  # noqa: E402

# -- counts -----------------------------------------------------------------------------------


def test_no_count_is_worse_than_on_record():
    assert counts.RECORD.exists()
    worse = [str(each) for each in counts.compare(counts.count()) if each.fails]
    assert not worse, "\n".join(worse)


@pytest.mark.parametrize(
    ("expected", "found", "state"),
    [
        (1000, 1019, "same"),
        (1000, 1021, "worse"),
        (1000, 979, "better"),
        (1000, None, "gone"),
        (None, 5, "new"),
        (0, 1, "worse"),
    ],
)
def test_a_count_is_compared_with_its_tolerance(expected, found, state):
    difference = counts.Difference("instructions", "pose", expected, found)
    assert difference.state == state
    assert difference.fails == (state in ("worse", "gone"))
    assert state in str(difference)


def test_groups_that_were_not_counted_are_not_compared():
    expected = {"instructions": {"a": 1}, "compiled code": {"b": 2}}
    (only,) = counts.compare({"instructions": {"a": 1}}, expected)
    assert only.name == "a"


def test_update_keeps_groups_that_were_not_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(counts, "RECORD", tmp_path / "new" / "counts.json")
    counts.update({"compiled code": {"b": 2}})
    counts.update({"instructions": {"a": 1}})
    assert counts.recorded() == {"compiled code": {"b": 2}, "instructions": {"a": 1}}


# -- the model that the peers are given --------------------------------------------------------


@pytest.mark.parametrize("segments", [1, 2, 3, 5])
def test_the_peers_model_is_that_of_stiffopt(segments):
    robot = tasks.arm(segments)
    d = np.array([0.6, 0.0, 0.8])
    p, x, R, C = paper.symbolic(segments)
    symbolic = ca.Function("model", [p], [x, R, C])
    energy = ca.Function("energy", *_energy(segments, d))
    for bar in np.random.default_rng(3).uniform(0, paper.PRESSURE_MAX, (4, 3 * segments)):
        pose, compliance = robot.tip_pose(bar * 1e5), robot.tip_compliance(bar * 1e5)
        size = np.abs(compliance).max()
        position, rotation, matrix = (value.full() for value in symbolic(bar))
        np.testing.assert_allclose(position[:, 0], pose[:3, 3], atol=1e-7)
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-6)
        np.testing.assert_allclose(matrix, compliance, atol=1e-6 * size)
        stiffness = robot.stiffness(bar * 1e5, d)
        assert float(energy(bar)) == pytest.approx(1 / stiffness, rel=1e-3)


def _energy(segments, d):
    p, _, along = paper.energy_form(segments, ca.SX(d))
    return [p], [along]


def test_pinks_coordinates_have_the_pressures_that_gave_them():
    pink = Pink.__new__(Pink)  # needs no pinocchio
    p = np.array([0.4, 1.0, 0.1])
    E = paper.E0 - paper.SLOPE * 1e5 * np.linalg.norm(p)
    length = paper.LENGTH * (1 + paper.FORCE @ p / (E * paper.AREA))
    kx, ky = paper.MOMENT @ p / (E * paper.INERTIA)
    half = np.hypot(kx, ky) * length / 2
    coordinates = np.array([np.arctan2(-kx, ky), half, length * np.sin(half) / half])
    np.testing.assert_allclose(pink.pressures(coordinates), p * 1e5, rtol=1e-9)
    coordinates[2] *= 2
    assert pink.pressures(coordinates) is None


@pytest.mark.parametrize("kind", [Ipopt, IpoptEnergy])
def test_ipopt_solves_the_same_task(kind):
    robot, task = tasks.task_of("position", 2, 1, 0)
    d = task.stiffness.maximise[0].direction
    peer = kind.of(2)
    p = peer.cold(task)
    assert tasks.holds(robot, task, task.target, p)
    best = robot.stiffness(Stiffopt.of(2).cold(task), d)
    assert robot.stiffness(p, d) <= best * (1 + 1e-3)
    moved = tasks.moved(robot, task, p)
    assert tasks.holds(robot, task, moved, peer.remember(task)(moved))


def test_slsqp_solves_the_same_task():
    pytest.importorskip("scipy")
    robot, task = tasks.task_of("position", 1, 1, 0)
    assert Slsqp.of(1).cold(task).shape == (robot.n_pressures,)


def test_a_peer_that_is_not_installed_is_named():
    class Nobody(Peer):
        name = "nobody"
        distributions = ("no-such-distribution",)

    with pytest.raises(PeerMissingError, match="no-such-distribution is not installed"):
        Nobody.of(1)


# -- tasks ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["position", "pointing", "pose-6", "free-axis", "several"])
def test_a_moved_target_is_half_a_millimetre_away_and_can_be_reached(kind):
    robot, task = tasks.task_of(kind, 2, 4, 0)
    solver = PressureSolver(robot, task)
    p = solver.solve().pressures
    target = tasks.moved(robot, task, p)
    if target.position is not None and None not in target.position:
        step = np.subtract(target.position, task.target.position)
        assert np.linalg.norm(step) == pytest.approx(tasks.STEP, rel=1e-6)
    assert solver.solve(target, guess=p).found


def test_tasks_follow_from_the_seed():
    _, first = tasks.task_of("tip load", 2, 9, 3)
    _, again = tasks.task_of("tip load", 2, 9, 3)
    _, other = tasks.task_of("tip load", 2, 10, 3)
    assert first == again
    assert first.load == tasks.LOAD
    assert first != other


def test_no_pressures_and_pressures_beyond_the_limits_do_not_hold():
    robot, task = tasks.task_of("position", 1, 1, 0)
    assert not tasks.holds(robot, task, task.target, None)
    assert not tasks.holds(robot, task, task.target, np.full(3, np.nan))
    assert not tasks.holds(robot, task, task.target, np.full(3, -1e3))


# -- timing -----------------------------------------------------------------------------------


def test_calls_are_interleaved_in_changing_order():
    order = []
    calls = {name: lambda item, n=name: order.append((n, item)) for name in "ab"}
    times = timing.interleaved(calls, 2, 2)
    assert order == [("a", 0), ("b", 0), ("b", 1), ("a", 1), ("b", 0), ("a", 0), ("a", 1), ("b", 1)]
    assert times["a"].shape == (2, 2)
    assert (times["a"] >= 0).all()


def test_a_name_that_takes_too_long_keeps_its_first_item_only():
    calls = {"slow": lambda _: sum(range(50_000)), "fast": lambda _: None}
    times = timing.interleaved(calls, 3, 2, most_seconds=1e-4)
    assert np.isnan(times["slow"][:, 1:]).all()
    assert times["slow"][0, 0] > 0


def test_ratios_are_paired_and_leave_out_what_was_not_timed():
    own = np.array([[1.0, 2.0, 4.0], [1.0, 2.0, 4.0]])
    peer = np.array([[3.0, 4.0, np.nan], [3.0, 8.0, np.nan]])
    assert timing.ratio(peer, own) == pytest.approx(3.0)
    assert timing.median(peer) == pytest.approx(4.5)
    assert np.isnan(timing.ratio(np.full((1, 2), np.nan), own[:, :2]))


# -- report -----------------------------------------------------------------------------------


def sections():
    return [
        Section(
            "Full task: pose and stiffness",
            "Text.",
            ("a", "b"),
            [("1", "x|y")],
            [at_most("cold", 1, 2, "ms"), at_least("batch", 5, float("nan"), "1/s")],
            [Comparison("cold", "peer", 0.5, remark="but wrong")],
            {"pink": "pin is not installed"},
        )
    ]


def test_the_report_shows_misses_better_peers_and_what_was_skipped_and_ends_with_limitations():
    worse = counts.Difference("instructions", "pose", 10, 20)
    text = report.markdown(sections(), [worse], {"processor": "any"}, (0.0, 1.0), 1, False, 2.0)
    assert "| cold | at most 1 ms | 2 ms | **not met** |" in text
    assert "| batch | at least 5 1/s | not measured | **not met** |" in text
    assert "| cold | peer | time | 2x | but wrong |" in text
    assert "Skipped: pink: pin is not installed." in text
    assert "| instructions | pose | 10 | 20 | worse |" in text
    assert "x\\|y" in text
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings[0] == "## Metrics"
    assert headings[-1] == "## Limitations"
    lines = report.summary(sections(), [worse])
    assert lines.startswith("0 of 2 bars met")
    assert "missed: cold: 2 ms, bar at most 1 ms" in lines


def test_the_environment_names_processor_and_versions():
    found = environment.environment()
    assert found["processor"]
    assert int(found["cores"]) >= 1
    assert found["casadi"] != "not installed"


def test_a_plot_is_drawn(tmp_path):
    record = {"cold_s": 1e-3, "warm_s": 1e-4}
    path = tmp_path / "full_task.png"
    plots.draw({"1": {"stiffopt": record}, "2": {"stiffopt": record}}, path)
    assert path.stat().st_size > 5000


@pytest.mark.parametrize(("kind", "seed"), [("lying", 3010), ("bent", 1041)])
def test_a_rod_with_constraints_agrees(kind, seed, tmp_path):
    (case,) = contact.run(range(seed, seed + 1), tmp_path, kind)
    assert contact.is_within(case)
    assert max(case["rod"]["forces"]) > 0.02


@pytest.mark.long
def test_the_quick_form_runs_from_end_to_end(tmp_path):
    command = [sys.executable, str(BENCHMARKS / "run.py"), "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    text = (tmp_path / "results.md").read_text()
    assert "## Bars" in text
    if importlib.util.find_spec("soromox") is None:
        assert "soromox (JAX): soromox is not installed" in text
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["sections"]["Full task: pose and stiffness"]["2"]["stiffopt"]["best"] > 0
