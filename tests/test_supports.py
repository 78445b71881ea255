"""Where a post or a wall would help: the map, the places that are tested, and the command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt
from cli_tasks import TWO, Write, lines, run, write_fixture  # noqa: F401
from conftest import use_compiler
from leaning_arm import few_starts as with_few_starts
from stiffopt.cli.solve_report import _supports
from stiffopt.cli.solved_task import SolvedTask, _with_supports
from stiffopt.errors import InputError
from stiffopt.optimise import supports
from stiffopt.optimise.supports import SupportMap, suggest_supports

ROBOT = stiffopt.load_robot("stiff-flop-2")
DIRECTION = (1.0, 0.0, 0.0)
TARGET = {"position": (-0.03, 0.01, 0.19)}


@pytest.fixture(scope="module", autouse=True)
def few_starts(code_cache: Path) -> Iterator[None]:
    with with_few_starts(), pytest.MonkeyPatch.context() as patch:
        use_compiler(patch, code_cache)
        patch.setattr(supports, "_TESTS", 2)
        yield


def task(**more: object) -> stiffopt.Task:
    goal = {"maximise": {"direction": DIRECTION}}
    given = {"robot": "stiff-flop-2", "target": TARGET, "stiffness": goal} | more
    return stiffopt.Task.model_validate(given)


@pytest.fixture(scope="module")
def found() -> SupportMap:
    return suggest_supports(ROBOT, task())


def test_the_map_is_the_limit_of_contacts_that_hardly_press(monkeypatch):
    """Spheres that the best answer without them enters by a hair."""
    monkeypatch.setattr(supports, "_POSTURES", 0)
    monkeypatch.setattr(supports, "_TESTS", 0)
    one = suggest_supports(ROBOT, task())
    assert one.supports == ()
    p, known = one.free.pressures, one.stiffness["post"]
    rows, columns = np.nonzero(np.isfinite(known))
    for index in np.random.default_rng(4).choice(len(rows), 6, replace=False):
        at, side = one.at[rows[index]], one.sides[columns[index]]
        T = ROBOT.pose(p, at)
        out = T[:3, :3] @ [np.cos(side), np.sin(side), 0.0]
        centre = T[:3, 3] + out * (ROBOT.body_radius(p, at) + 0.005 - 1e-5)
        ball = stiffopt.SceneObject(
            name="ball", sphere={"centre": tuple(centre), "radius": 0.005},
            contact={"allowed": True},
        )  # fmt: skip
        eq = ROBOT.contact_equilibrium(p, stiffopt.Scene(objects=[ball]), approach="objects")
        assert [each.object for each in eq.contacts] == ["ball"]
        assert eq.contacts[0].at == pytest.approx(at, abs=1e-3)
        assert known[rows[index], columns[index]] == pytest.approx(
            eq.stiffness(DIRECTION), rel=0.02
        )


def test_what_is_suggested_is_an_answer_of_the_solver(found):
    assert found.supports
    assert {each.kind for each in found.supports} == {"post", "wall"}
    ratios = [found.times(each) for each in found.supports]
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[0] > 10
    for each in found.supports:
        robot = each.solution.robot
        scene = stiffopt.Scene(objects=[each.object])
        eq = robot.contact_equilibrium(each.solution.pressures, scene)
        assert eq.stiffness(DIRECTION) / found.free.stiffness == pytest.approx(
            found.times(each), rel=1e-6
        )
        assert np.linalg.norm(eq.tip_pose[:3, 3] - TARGET["position"]) < 1.001e-4
        assert eq.within_limits
        assert max(contact.at for contact in eq.contacts) < ROBOT.length - 0.015
        assert all(held.loss.force >= 0.02 * (1 - 1e-6) for held in each.solution.preloads)
        row = np.abs(found.at - each.at).argmin()
        column = np.abs(found.sides - each.side).argmin()
        estimate = found.stiffness[each.kind][row, column] / found.free.stiffness
        assert 0.4 < estimate / found.times(each) < 2.5


def test_a_support_is_clear_of_the_arm_at_rest_and_leaves_the_scene_as_it_is(found, monkeypatch):
    for each in found.supports:
        scene = stiffopt.Scene(objects=[each.object])
        assert ROBOT.clearance(np.zeros(6), scene) > 0
    rib = {"name": "new post", "sphere": {"centre": (0.0, 0.06, 0.15), "radius": 0.005}}
    monkeypatch.setattr(supports, "_TESTS", 1)
    crowded = task(scene={"clearance": 0.001, "objects": [rib]})
    for each in suggest_supports(ROBOT, crowded, 0.2).supports:
        assert each.object.name in ("new post 2", "new wall")
        assert each.object.contact.max_force == 0.2
        assert each.force <= 0.2
        assert each.solution.task.scene.objects[0].name == "new post"


def test_no_support_is_too_near_the_base():
    far = {"name": "far", "sphere": {"centre": (0.4, 0.0, 0.1), "radius": 0.005}}
    for each in suggest_supports(ROBOT, task(scene={"clearance": 0.03, "objects": [far]})).supports:
        each.solution.task.scene.check_against(ROBOT.description)


def test_tasks_for_which_nothing_can_be_suggested():
    with pytest.raises(InputError, match="stiffness against translation"):
        suggest_supports(ROBOT, task(stiffness=None))
    turning = {"maximise": {"direction": DIRECTION, "kind": "rotation"}}
    with pytest.raises(InputError, match="stiffness against translation"):
        suggest_supports(ROBOT, task(stiffness=turning))
    with pytest.raises(InputError, match="max_force must be positive"):
        suggest_supports(ROBOT, task(), 0.0)
    with pytest.raises(InputError, match="has no answer: unreachable"):
        suggest_supports(ROBOT, task(target={"position": (0.0, 0.0, 0.5)}))


def test_the_command_prints_and_draws_it(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    known: list[SupportMap] = []  # of the first of both commands

    def once(*given: Any, **options: Any) -> SupportMap:
        known.extend([] if known else [suggest_supports(*given, **options)])
        return known[0]

    monkeypatch.setattr("stiffopt.cli.solved_task.suggest_supports", once)
    picture, path = tmp_path / "post.png", write("two.yaml", TWO)
    result = run("--suggest-post", str(picture), "--post-force", "0.25 N", path)
    assert result.exit_code == 0
    assert "would help" in result.stdout
    assert "times as stiff" in result.stdout
    assert picture.stat().st_size > 10_000
    assert {each.object.contact.max_force for each in known[0].supports} == {0.25}
    result = run("--suggest-post", str(picture), "--json", path)
    (record,) = lines(result.stdout)
    best = record["supports"][0]
    again = stiffopt.Scene.model_validate({"objects": [json.loads(json.dumps(best["object"]))]})
    eq = ROBOT.contact_equilibrium(best["pressures_pa"], again)
    assert eq.stiffness(DIRECTION) == pytest.approx(best["stiffnesses"][0], rel=1e-6)
    assert max(np.linalg.norm(each.force) for each in eq.contacts) == pytest.approx(
        best["force_n"], rel=1e-6
    )


def test_what_is_softer_than_what_the_task_leans_on_is_no_help(found, monkeypatch):
    monkeypatch.setattr("stiffopt.cli.solved_task.suggest_supports", lambda *_, **__: found)
    first, second = found.supports[:2]
    leaning = _with_supports(SolvedTask("task.yaml", ROBOT, second.solution), 0.3, seed=0)
    assert leaning.supports.supports == (first,)
    (text,) = (text for _, text in _supports(leaning.supports, leans=True))
    assert f"{found.times(first):.3g} times as stiff as clear of all objects; touched" in text
    free = _with_supports(SolvedTask("task.yaml", ROBOT, found.free), 0.3, seed=0)
    assert free.supports.supports == found.supports


def test_the_command_refuses_what_it_cannot_do(write: Write, tmp_path: Path) -> None:
    path = write("two.yaml", TWO[: TWO.index("stiffness")])
    result = run("--suggest-post", str(tmp_path / "post.png"), path)
    assert result.exit_code == 2
    assert "maximises a stiffness against translation" in result.stderr
    assert "pressures" in result.stdout  # the answer itself is still given
    result = run("--suggest-post", str(tmp_path / "post.png"), "--post-force", "3 mm", path)
    assert result.exit_code == 2
    assert "--post-force" in result.stderr
    result = run("--suggest-post", str(tmp_path / "post.png"), "--post-force", "0 N", path)
    assert result.exit_code == 2
    assert "--post-force: must be greater than 0, not '0 N'" in result.stderr
    result = run("--suggest-post", str(tmp_path / "post.png"), "--post-force", "", path)
    assert result.exit_code == 2
    assert "--post-force" in result.stderr
    result = run("--post-force", "0.1 N", path)
    assert result.exit_code == 2
    assert "--post-force: needs --suggest-post" in result.stderr
