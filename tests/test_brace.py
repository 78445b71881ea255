"""Leaning on objects to be stiff: the part ``brace`` of tasks, its search, and what it answers."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import stiffopt
from conftest import use_compiler
from leaning_arm import few_starts as with_few_starts
from stiffopt.cli.main import main
from stiffopt.cli.solve_report import block
from stiffopt.cli.solved_task import SolvedTask, with_uncertainty
from stiffopt.errors import DerivativeError, FileError, InputError, OutOfTimeError
from stiffopt.model.calibration import Calibration
from stiffopt.optimise import braced
from stiffopt.optimise.brace_uncertainty import BraceUncertainty
from stiffopt.optimise.leaning import MARGIN_ON, BracedProblem
from stiffopt.optimise.local import LocalResult
from stiffopt.optimise.problem import PressureProblem
from stiffopt.optimise.search import Search
from stiffopt.optimise.settings import BRACE
from stiffopt.paths.leaning import way_into_contact

PROBLEMS = Path(__file__).parents[1] / "problems"
POST = """
    - name: post
      capsule: {from: [-35 mm, -60 mm, 100 mm], to: [-35 mm, 60 mm, 100 mm], radius: 5 mm}
      contact: {allowed: true, max_force: 0.3 N, friction: 0.2}
"""
TASK = f"""format: stiffopt-task/1
robot: stiff-flop-2
target: {{position: [-30 mm, 10 mm, 190 mm]}}
stiffness: {{maximise: {{direction: [1, 0, 0]}}}}
brace: {{objects: [post], margin: 20 mN}}
scene:
  clearance: 1 mm
  objects:{POST}"""
RIB = """    - {name: rib, sphere: {centre: [-32 mm, 30 mm, 140 mm], radius: 5 mm}}
"""


@pytest.fixture(scope="module", autouse=True)
def few_starts(code_cache: Path) -> Iterator[None]:
    """A search of few starts: all of it is what `benchmarks/brace.py` looks at."""
    with with_few_starts(), pytest.MonkeyPatch.context() as patch:
        use_compiler(patch, code_cache)
        yield


@pytest.fixture(scope="module")
def robot() -> stiffopt.Manipulator:
    return stiffopt.load_robot("stiff-flop-2")


def written(folder: Path, text: str) -> Path:
    file = folder / "lean.yaml"
    file.write_text(text)
    return file


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> stiffopt.Task:
    return stiffopt.load_task(written(tmp_path_factory.mktemp("brace"), TASK))


@pytest.fixture(scope="module")
def solution(robot: stiffopt.Manipulator, task: stiffopt.Task) -> stiffopt.PressureSolution:
    return stiffopt.solve_pressure(robot, task)


def test_an_answer_holds_at_the_equilibrium_that_is_reached_from_rest(robot, task, solution):
    assert solution.found
    assert solution.pressures is not None
    post = stiffopt.Scene(objects=task.scene.objects)
    eq = robot.contact_equilibrium(solution.pressures, post)
    assert np.linalg.norm(eq.tip_pose[:3, 3] - [-0.03, 0.01, 0.19]) <= 1e-4
    assert solution.position_error <= 1e-4
    assert solution.stiffness == pytest.approx(eq.stiffness([1, 0, 0]), rel=1e-9)
    (contact,) = eq.contacts
    assert np.linalg.norm(contact.force) <= 0.3
    assert eq.stable
    for way in ([1, 0, 0], [-1, 0, 0]):
        assert eq.lift_off(way).force >= 0.02
    assert (solution.pressures >= 0).all()
    assert (solution.pressures <= 1.5e5).all()


def test_leaning_is_several_times_as_stiff_as_the_answer_that_keeps_clear(robot, task, solution):
    free = stiffopt.solve_pressure(robot, task.unbraced)
    assert solution.stiffness_free == pytest.approx(free.stiffness, rel=1e-6)
    assert solution.stiffness > 4 * free.stiffness
    assert solution.free.clearance >= 1e-3 - 1e-5
    assert solution.clearance is None  # there is no other object
    assert solution.limited_by


def test_nothing_stiffer_is_next_to_an_answer(robot, task, solution):
    """First-order: no step that all constraints allow gains more than a thousandth."""
    problem = BracedProblem(robot, task)
    rng = np.random.default_rng(3)
    problem.here = solution.equilibrium
    point = problem.point(solution.pressures / problem.unit)
    for _ in range(12):
        d = rng.normal(size=6)
        d -= np.linalg.pinv(point.jacobian[:3]) @ (point.jacobian[:3] @ d)
        d *= 3e-3 / np.linalg.norm(d)
        x = np.clip(point.x + d, problem.lower, problem.upper)
        problem.here = solution.equilibrium
        there = problem.point(x)
        margins = zip(there.constraints, there.errors, strict=True)
        if all(error <= c.radius for c, error in margins if c.name != "position"):
            off = max(0.0, there.errors[0] - point.errors[0])
            gained = point.terms[0] - there.terms[0]
            assert gained < 2e-3 + 300 * off


def test_derivatives_are_differences(robot, task, solution):
    problem = BracedProblem(robot, task)
    x = solution.pressures / problem.unit
    problem.here = solution.equilibrium
    point = problem.point(x)
    for k in (0, 3, 5):
        sides = []
        for sign in (1, -1):
            problem.here = solution.equilibrium
            sides.append(problem.point(x + sign * 1e-3 * np.eye(6)[k]))
        for name in ("residual", "terms"):
            slope = (getattr(sides[0], name) - getattr(sides[1], name)) / 2e-3
            found = point.jacobian[:, k] if name == "residual" else point.term_gradients[:, k]
            np.testing.assert_allclose(found, slope, rtol=0.02, atol=2e-3)


def test_a_larger_margin_costs_stiffness_and_is_held(robot, task, solution):
    held = min(each.loss.force for each in solution.preloads if each.contacts == "sliding")
    brace = task.brace.model_copy(update={"margin": 1.02 * held})
    (post,) = task.scene.objects
    smooth = post.contact.model_copy(update={"friction": 0.0})  # which keeps this answer away
    scene = task.scene.model_copy(
        update={"objects": (post.model_copy(update={"contact": smooth}),)}
    )
    given = task.model_copy(update={"brace": brace, "scene": scene})
    found = stiffopt.solve_pressure(robot, given, guess=solution.pressures)
    assert found.found
    assert found.contacts
    least = min(each.loss.force for each in found.preloads if each.contacts == "sliding")
    assert least >= brace.margin
    assert found.stiffness < solution.stiffness
    assert f"{MARGIN_ON}post" in found.limited_by


def test_a_margin_that_no_contact_holds_leaves_the_free_answer(robot, task):
    brace = task.brace.model_copy(update={"margin": 5.0})
    found = stiffopt.solve_pressure(robot, task.model_copy(update={"brace": brace}))
    assert found.found
    assert not found.contacts
    assert found.stiffness == found.stiffness_free
    assert "leaning on 'post' at the target, the arm has no equilibrium" in found.message


def test_a_calibrated_arm_holds_back_forces_that_are_in_doubt(robot, task):
    known = Calibration(position_residual=2e-3)
    arm = stiffopt.Manipulator(robot.description.model_copy(update={"calibration": known}))
    found = stiffopt.solve_pressure(arm, task)
    assert found.contacts
    problem, eq = BracedProblem(arm, task), found.equilibrium
    uncertainty = BraceUncertainty(arm, eq)
    doubt = uncertainty.forces
    assert (
        f"smaller or larger by {doubt.max():.2g} N, by errors of the calibration" in found.message
    )
    for push in problem.pushes(eq):
        assert (eq.shifted(push=task.brace.margin * push).normal_forces >= doubt).all()
    # the limit of the force binds, and keeps room for the doubt
    assert "force on post" in found.limited_by
    largest = eq.normal_forces + doubt
    assert (largest <= 0.3).all()
    assert largest.max() == pytest.approx(0.3, rel=0.02)
    # pressures that move the free tip by two standard deviations change no force by more
    J = arm.tip_pose(eq.pressures)[:3, :3] @ arm.tip_jacobian(eq.pressures)[:3]
    ways = np.random.default_rng(0).normal(size=(50, 3))
    ways *= 2 * known.position_residual / np.linalg.norm(ways, axis=1, keepdims=True)
    changes = np.abs([eq.force_gradients @ np.linalg.pinv(J) @ way for way in ways]).max(axis=0)
    assert changes == pytest.approx(doubt, rel=0.1)
    assert (changes <= doubt).all()
    # and the stiffness with them
    low, high = uncertainty.stiffness_interval(task.stiffness.maximise[0], task)
    assert low * high == pytest.approx(found.stiffness**2)
    seen = [eq.shifted(np.linalg.pinv(J) @ way).stiffness([1, 0, 0]) for way in 0.1 * ways]
    assert np.log(np.array(seen) / found.stiffness).max() == pytest.approx(
        0.1 * np.log(high / found.stiffness), rel=0.15
    )
    text = StringIO()
    told = with_uncertainty(SolvedTask("lean.yaml", arm, found))
    Console(file=text, width=200).print(block(told))
    assert f"(95 %: {low:.3f} to {high:.3f}" in text.getvalue()


def test_a_stiffness_that_moves_no_tip_is_in_doubt(robot, task, solution):
    """All moduli and gains larger by the same factor make the braced arm stiffer by that factor."""
    factor = 0.08
    names = ["material.youngs_modulus", *(f"corrections.gain[{channel}]" for channel in range(3))]
    fitted = [
        {"key": f"segments[{k}].{name}", "deviation": factor, "prior": 1.0}
        for k in range(2)
        for name in names
    ]
    known = Calibration(parameters=fitted, correlation=np.ones((len(fitted),) * 2).tolist())
    arm = stiffopt.Manipulator(robot.description.model_copy(update={"calibration": known}))
    eq = arm.contact_equilibrium(solution.pressures, BracedProblem(robot, task).scene)
    interval = BraceUncertainty(arm, eq).stiffness_interval(task.stiffness.maximise[0], task)
    ratios = np.log(np.array(interval) / eq.stiffness([1, 0, 0]))
    assert ratios == pytest.approx([-1.96 * factor, 1.96 * factor], rel=0.01)


def test_a_posture_that_a_likely_error_makes_soft_is_refused(robot, task, solution):
    def arm(residual):
        known = Calibration(position_residual=residual)
        return stiffopt.Manipulator(robot.description.model_copy(update={"calibration": known}))

    measure, scene = task.stiffness.maximise[0], BracedProblem(robot, task).scene
    # the axes of equal errors are those of the base; from rest instead of continued
    known, residual = arm(8e-3), 8e-3
    eq = known.contact_equilibrium(solution.pressures, scene)
    J = known.tip_pose(eq.pressures)[:3, :3] @ known.tip_jacobian(eq.pressures)[:3]
    least = min(
        known.contact_equilibrium(eq.pressures + np.linalg.pinv(J) @ way, scene).stiffness(
            [1, 0, 0]
        )
        for way in residual * np.vstack([np.eye(3), -np.eye(3)])
    )
    found = BraceUncertainty(known, eq).least_stiffness(measure, task)
    assert found == pytest.approx(least, rel=1e-3)
    assert 0.5 * eq.stiffness([1, 0, 0]) < found < eq.stiffness([1, 0, 0])
    said = f"errors of the calibration (one standard deviation) leave {0:.4g} N/m"
    for residual, refused in ((8e-3, False), (30e-3, True), (40e-3, True)):
        eq = arm(residual).contact_equilibrium(solution.pressures, scene)
        reasons = list(BracedProblem(arm(residual), task).refusals(eq))
        assert any("(one standard deviation) leave" in why for why in reasons) == refused
    assert any(said in why for why in reasons)  # lost within one deviation
    assert BraceUncertainty(robot, solution.equilibrium).least_stiffness(measure, task) == (
        pytest.approx(solution.stiffness)
    )


def test_where_forces_are_in_doubt_slips_come_sooner(robot, task, solution):
    """The push that loses a sticking contact is in proportion to the contact's force."""
    known = Calibration(position_residual=8e-3)
    arm = stiffopt.Manipulator(robot.description.model_copy(update={"calibration": known}))
    given = task.model_copy(
        update={"brace": task.brace.model_copy(update={"contacts": "sticking"})}
    )
    problem, way = BracedProblem(arm, given), [1.0, 0.0, 0.0]
    eq = arm.contact_equilibrium(solution.pressures, problem.scene)
    uncertainty = BraceUncertainty(arm, eq)
    slopes = eq.force_gradients[0]
    less = -slopes * uncertainty.forces[0] / (slopes @ slopes)
    weaker = arm.contact_equilibrium(eq.pressures + less, problem.scene)
    share = weaker.lift_off(way, contacts="sticking").force / (
        eq.lift_off(way, contacts="sticking").force
    )
    assert 0.5 < uncertainty.grip < 0.95
    assert uncertainty.grip == pytest.approx(share, abs=0.1)
    held = min(each.loss.force for each in problem.preloads(eq) if each.contacts == "sticking")
    room = 0.5 * (1 + uncertainty.grip)
    asked = given.brace.model_copy(update={"margin": room * held})
    refused = BracedProblem(arm, given.model_copy(update={"brace": asked})).refusals(eq)
    assert any("takes a contact away" in why for why in refused)
    without = BracedProblem(robot, given.model_copy(update={"brace": asked}))
    assert not any("takes a contact away" in why for why in without.refusals(eq))


def test_without_a_calibration_no_force_is_in_doubt(robot, solution):
    assert not BraceUncertainty(robot, solution.equilibrium).forces.any()
    assert "calibration" not in solution.message


def test_objects_that_are_not_named_keep_their_clearance(robot, solution, tmp_path):
    task = stiffopt.load_task(written(tmp_path, TASK + RIB))
    found = stiffopt.solve_pressure(robot, task, guess=solution.pressures)
    assert found.found
    assert {each.object for each in found.contacts} == {"post"}
    points = found.equilibrium.backbone(400)
    distance = np.linalg.norm(points - [-0.032, 0.03, 0.14], axis=1).min() - 0.005 - 0.015
    assert distance >= 1e-3 - 2e-5
    assert found.clearance == pytest.approx(distance, abs=2e-5)
    assert found.nearest_object == "rib"


def test_sticking_contacts_hold_the_margin_without_slipping(robot, task, solution):
    brace = task.brace.model_copy(update={"contacts": "sticking"})
    scene = task.scene.objects[0]
    rough = scene.contact.model_copy(update={"friction": 0.6})
    scene = stiffopt.Scene(objects=[scene.model_copy(update={"contact": rough})])
    given = task.model_copy(update={"brace": brace, "scene": scene})
    found = stiffopt.solve_pressure(robot, given, guess=solution.pressures)
    assert found.found
    assert found.contacts
    eq = found.equilibrium
    assert found.stiffness == pytest.approx(eq.stiffness([1, 0, 0], contacts="sticking"), rel=1e-9)
    for way in ([1, 0, 0], [-1, 0, 0]):
        assert eq.lift_off(way, contacts="sticking").force >= 0.02 * (1 - 1e-6)


def test_a_guess_is_where_the_search_begins(robot, task, solution):
    again = stiffopt.solve_pressure(robot, task, guess=solution.pressures)
    assert again.found
    assert again.stiffness == pytest.approx(solution.stiffness, rel=2e-3)
    assert str(again.confidence).startswith("local answer")


def test_a_search_that_is_ended_keeps_the_free_answer(task, monkeypatch):
    monkeypatch.setenv("STIFFOPT_COMPILER", "none")
    robot = stiffopt.load_robot("stiff-flop-2")
    calls = iter(range(10**6))
    found = stiffopt.solve_pressure(robot, task, cancel=lambda: next(calls) > 2)
    assert found.status in {"solved", "failed"}
    assert not found.contacts
    assert "ended" in found.message or "cancelled" in found.message


def test_other_ways_to_solve_lean_too(robot, task, solution):
    solver = stiffopt.PressureSolver(robot, task)
    assert solver.solve_at_once() is None
    assert solver.reachable()
    answer = solver.warm(None, solution.pressures)
    assert answer.found
    assert answer.solution.contacts
    (batched,) = stiffopt.solve_batch(robot, [task], [solution.pressures])
    assert batched.contacts


def test_an_answer_can_be_copied_and_has_no_derivatives(solution):
    copied = pickle.loads(pickle.dumps(solution))
    assert copied.contacts[0].object == "post"
    poses = copied.equilibrium.tip_pose, solution.equilibrium.tip_pose
    np.testing.assert_allclose(*poses, rtol=0, atol=1e-7)  # both to the precision of the solver
    with pytest.raises(DerivativeError, match="leans on objects"):
        solution.gradient("stiffness", by="target")
    assert "leaning on 'post' with 0." in repr(solution)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("objects: [post]", "objects: [pots]", "no object 'pots' in the scene; it has 'post'"),
        ("objects: [post]", "objects: [post, post]", "names 'post' twice"),
        ("objects: [post]", "objects: []", "brace.objects"),
        ("allowed: true", "allowed: false", "'post' may not be touched"),
        ("margin: 20 mN", "margin: 0 N", "brace.margin"),
        ("margin: 20 mN", "margin: 20", "bare number"),
        ("stiffness: {maximise: {direction: [1, 0, 0]}}\n", "", "needs stiffness.maximise"),
        ("{maximise: {", "{at_least: {value: 1 N/m, ", "needs stiffness.maximise"),
        ("[1, 0, 0]}}", "[1, 0, 0], kind: rotation}}", "against translation"),
        ("brace:", "press: {force: 30 mN, direction: [1, 0, 0]}\nbrace:", "with press"),
    ],
)
def test_refusals(tmp_path, old, new, message):
    text = TASK.replace(old, new)
    assert text != TASK
    with pytest.raises(InputError, match=r"brace|margin") as caught:
        stiffopt.load_task(written(tmp_path, text))
    assert message in str(caught.value)


def test_a_wrong_name_is_told_beside_mistakes_elsewhere(tmp_path):
    text = TASK.replace("[post]", "[pots]").replace("[-30 mm, 10 mm", "[-30, 10 mm")
    with pytest.raises(FileError) as caught:
        stiffopt.load_task(written(tmp_path, text))
    keys = [each.key for each in (caught.value, *caught.value.others)]
    assert keys == ["target.position[0]", "brace.objects[0]"]


def test_nothing_sticks_to_an_object_without_friction(tmp_path):
    text = TASK.replace("20 mN}", "20 mN, contacts: sticking}")
    assert stiffopt.load_task(written(tmp_path, text)).brace.contacts == "sticking"
    with pytest.raises(InputError, match=r"brace\.contacts: nothing sticks to 'post'"):
        stiffopt.load_task(written(tmp_path, text.replace(", friction: 0.2", "")))


def test_a_brace_needs_a_scene(tmp_path):
    with pytest.raises(InputError, match="brace: needs a scene"):
        stiffopt.load_task(written(tmp_path, TASK[: TASK.index("scene:")]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("margin: 20 mN", "margin: 1 N", "no equilibrium under a push of 1 N, the margin"),
        (
            "capsule: {from: [-35 mm, -60 mm, 100 mm], to: [-35 mm, 60 mm, 100 mm], radius: 5 mm}",
            "sphere: {centre: [0 mm, 0 mm, 90 mm], radius: 30 mm}",
            "inside 'post', which cannot push it out continuously",
        ),
    ],
)
def test_the_reason_for_no_brace(tmp_path, robot, old, new, message):
    text = TASK.replace(old, new)
    assert text != TASK
    found = stiffopt.solve_pressure(robot, stiffopt.load_task(written(tmp_path, text)))
    assert not found.contacts
    assert message in found.message


@pytest.mark.parametrize(
    ("x", "approach", "message"),
    [(-35, "pressures", ""), (-5, "pressures", "15 mm inside 'post'"), (-5, "objects", "")],
)
def test_an_object_that_is_in_the_arm_at_rest_is_told(tmp_path, robot, x, approach, message):
    text = TASK.replace("[-35 mm, ", f"[{x} mm, ").replace(
        "20 mN}", f"20 mN, approach: {approach}}}"
    )
    problem = BracedProblem(robot, stiffopt.load_task(written(tmp_path, text)))
    assert message in braced.at_rest(problem)
    assert bool(message) == bool(braced.at_rest(problem))


def test_a_rigid_object_at_the_tip_is_no_brace(tmp_path, robot):
    """Its stiffness along the normal has no limit, and is not the arm's."""
    capsule = "capsule: {from: [-35 mm, -60 mm, 100 mm], to: [-35 mm, 60 mm, 100 mm], radius: 5 mm}"
    wall = "half_space: {point: [-40 mm, 0 mm, 0 mm], normal: [1, 0, 0]}"
    problem = BracedProblem(
        robot, stiffopt.load_task(written(tmp_path, TASK.replace(capsule, wall)))
    )
    eq = robot.contact_equilibrium(np.array([5e4, 0, 0, 5e4, 0, 0]), problem.scene)
    assert [each.at for each in eq.contacts] == [pytest.approx(robot.length)]
    assert any("holds the tip itself" in why for why in problem.refusals(eq))


@pytest.mark.parametrize("file", sorted(PROBLEMS.glob("leaning_*.yaml")), ids=lambda p: p.stem)
def test_the_gallery_holds_at_its_golden_pressures(file, monkeypatch):
    monkeypatch.setenv("STIFFOPT_COMPILER", "none")
    robot = stiffopt.load_robot("stiff-flop-2")
    task = stiffopt.load_task(file)
    golden = json.loads((PROBLEMS / "golden" / f"{file.stem}.json").read_text())
    problem = BracedProblem(robot, task)
    eq = robot.contact_equilibrium(np.array(golden["pressures_pa"]), problem.scene)
    judgement = problem.judgement(eq)
    assert judgement.holds, judgement.shortfalls
    assert judgement.stiffnesses[0] == pytest.approx(golden["stiffness"], rel=1e-5)
    assert {each.object for each in eq.contacts} == set(task.brace.objects)
    assert robot.clearance(np.zeros(6), task.scene) >= task.scene.clearance
    answer = SimpleNamespace(
        task=task, pressures=eq.pressures, tip_pose=eq.tip_pose, contacts=eq.contacts,
        stiffness=judgement.stiffnesses[0], stiffness_unit="N/m",
    )  # fmt: skip
    states = way_into_contact(robot, answer)
    assert not states[0].contacts
    assert states[-1].normal_forces == pytest.approx(eq.normal_forces, rel=1e-3)


LYING = """format: stiffopt-task/1
robot: lying.yaml
target: {position: [11 mm, -4 mm, 190 mm], tolerance: {position: 2 mm}}
stiffness: {maximise: {direction: [0, 1, 0]}}
brace: {objects: [bench], margin: 5 mN}
scene:
  objects:
    - name: bench
      half_space: {point: [26 mm, 0 mm, 0 mm], normal: [-1, 0, 0]}
      contact: {allowed: true, max_force: 0.5 N, friction: 0.2}
"""


def test_an_arm_that_lies_on_an_object_at_rest_moves_along_it(tmp_path, capsys):
    robot_file = (PROBLEMS.parent / "src/stiffopt/robots/stiff-flop-2.yaml").read_text()
    lying = robot_file.replace("name: stiff-flop-2", "name: lying")
    assert "gravity" not in lying.partition("segments:")[2]
    (tmp_path / "lying.yaml").write_text(f"{lying}\ngravity: [6 m/s^2, 0 m/s^2, 0 m/s^2]\n")
    file = tmp_path / "task.yaml"
    file.write_text(LYING)
    out = str(tmp_path / "motion.png")
    arguments = ["--from", "0, 0.1, 0, 0, 0, 0.1 bar", "--to", str(file), "--json", "--plot", out]
    code = main(["plan", *arguments])
    said = json.loads(capsys.readouterr().out)
    assert code == 0, said["message"]
    assert "leans on 'bench'" in said["message"]
    pressures = np.array(said["pressures_pa"])
    at_rest = np.flatnonzero(~pressures.any(axis=1))
    assert len(at_rest) == 1
    assert 0 < at_rest[0] < len(pressures) - 1
    model = stiffopt.load_robot(tmp_path / "lying.yaml")
    task = stiffopt.load_task(file)
    # each state is the equilibrium that is reached from rest, by itself
    for index in (0, 10, at_rest[0], len(pressures) - 1):
        found = model.contact_equilibrium(pressures[index], task.scene)
        assert found.contacts
        assert said["tip_position_m"][index] == pytest.approx(found.tip_pose[:3, 3], abs=2e-5)
    assert np.diff(said["times_s"]).min() > 0


def test_json_files_and_picture(tmp_path, capsys):
    file, picture, results = written(tmp_path, TASK), tmp_path / "a.png", tmp_path / "out.yaml"
    outputs = ["--plot", str(picture), "--out", str(results)]
    assert main(["solve", "--json", str(file), *outputs]) == 0
    said: dict[str, Any] = json.loads(capsys.readouterr().out)
    (contact,) = said["contacts"]
    assert contact["object"] == "post"
    assert 0.08 < contact["at_m"] < 0.12
    assert len(contact["force_n"]) == 3
    assert said["stiffness"] > 4 * said["stiffness_free"]
    assert {each["how"] for each in said["preload"]} <= {"lifts off", "slips", "holds", "snaps"}
    assert said["clearance_m"] is None
    assert picture.stat().st_size > 20000
    assert "stiffness_free" in results.read_text()


def test_the_table_tells_where_it_leans_and_what_that_gives(robot, solution):
    text = StringIO()
    Console(file=text, width=100).print(block(SolvedTask("lean.yaml", robot, solution)))
    words = ("leans on", "'post' at 100", "of at most 0.3 N", "clear of it", "times as stiff",
             "'post' lifts off, which leaves", "limited by")  # fmt: skip
    for each in words:
        assert each in text.getvalue()


def just_outside(robot, problem, solution) -> braced.Braced:
    """An optimum moved to where the tip, from rest, is 5 um outside its tolerance."""
    problem.here = solution.equilibrium
    point = problem.point(solution.pressures / problem.unit)
    outwards = point.residual[:3] / np.linalg.norm(point.residual[:3])
    missing = 1e-4 + 5e-6 - np.linalg.norm(point.residual[:3])
    step, *_ = np.linalg.lstsq(point.jacobian[:3], outwards * missing, rcond=None)
    moved = LocalResult.at(problem, problem.point(point.x + step))
    seen = braced.from_rest(problem, moved)
    assert seen is not None
    assert not seen.judgement.holds
    return seen


def test_an_optimum_that_fails_from_rest_is_reached_again(robot, task, solution):
    problem = BracedProblem(robot, task)
    seen = just_outside(robot, problem, solution)
    again = braced.reached_again(problem, seen)
    assert again is not None
    assert again.judgement.holds
    assert np.linalg.norm(again.equilibrium.tip_pose[:3, 3] - [-0.03, 0.01, 0.19]) <= 1e-4
    assert again.least == pytest.approx(solution.stiffness, rel=0.01)


def test_an_optimum_that_fails_and_is_reached_again_is_answered(robot, task, solution, monkeypatch):
    problem, from_rest = BracedProblem(robot, task), braced.from_rest
    moved = just_outside(robot, problem, solution)
    calls = iter([moved])
    monkeypatch.setattr(braced, "from_rest", lambda p, r: next(calls, None) or from_rest(p, r))
    answer = stiffopt.solve_pressure(robot, task)
    assert answer.stiffness == pytest.approx(solution.stiffness, rel=0.01)
    assert answer.confidence.agreeing >= 1
    assert "left out" not in answer.message


def test_a_stiffer_posture_that_is_left_out_is_told(robot, task, solution, monkeypatch):
    """An optimum that fails from rest, and again after a second descent, gives way to the next."""
    problem = BracedProblem(robot, task)
    moved = just_outside(robot, problem, solution)
    stiffer = tuple(1.5 * each for each in moved.judgement.stiffnesses)
    failing = moved._replace(judgement=moved.judgement._replace(stiffnesses=stiffer))
    from_rest = braced.from_rest
    calls = iter([failing])
    monkeypatch.setattr(braced, "reached_again", lambda problem, seen: None)
    found = braced.braced_answers
    monkeypatch.setattr(braced, "braced_answers", lambda *args: _twice(found(*args)))
    monkeypatch.setattr(braced, "from_rest", lambda p, r: next(calls, None) or from_rest(p, r))
    answer = stiffopt.solve_pressure(robot, task)
    assert answer.found
    assert "N/m was left out; when it is reached from rest, " in answer.message


def _twice(found: Search) -> Search:
    return replace(found, results=(found.results[0], *found.results))


def test_a_guess_outside_the_limits_is_taken_to_them(robot, task, solution):
    found = stiffopt.solve_pressure(robot, task, guess=np.full(6, 4e5))
    assert found.found
    assert (found.pressures <= 1.5e5).all()


def test_a_search_that_is_stopped_leaves_the_free_answer(robot, task, monkeypatch):
    free = stiffopt.solve_pressure(robot, task.unbraced)

    def late(*_: Any) -> Any:
        raise OutOfTimeError("no answer within 1 s")

    def search(*_: Any) -> Any:
        monkeypatch.setattr(PressureProblem, "point", late)  # nothing can be explained any more
        return late()

    monkeypatch.setattr(braced, "braced_answers", search)
    found = braced.lean(BracedProblem(robot, task), late, free, None)
    assert found.found
    assert found.stiffness == free.stiffness
    assert "the search for where to lean was ended: no answer within 1 s" in found.message


def test_an_optimum_that_misses_by_little_from_rest_gets_more_to_spare(robot, task):
    problem = BracedProblem(robot, task)
    tightened = problem.tightened()
    (position, *_), (own, *_) = problem.constraints, tightened.constraints
    assert own.radius == pytest.approx(0.995e-4)
    assert own.radius < position.radius < 1e-4
    assert tightened.spare > problem.spare == BRACE.spare
