"""The studio's model, without a browser: designs, their answers, what is said and copied."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from stiffopt.cli.path_records import csv_text
from stiffopt.errors import FileError, InputError
from stiffopt.model.calibration import Calibration, ErrorModel
from stiffopt.plots.shapes import surface_mesh
from stiffopt.studio import objects, texts, workbench
from stiffopt.studio.cloud import StiffnessCloud, check_map
from stiffopt.studio.design import Design
from stiffopt.studio.leaning import force_arrows
from stiffopt.studio.sources import kind_of, timeline_of
from stiffopt.studio.timeline import Timeline
from stiffopt.studio.workbench import NewestWins, Workbench

ROOT = Path(__file__).resolve().parent.parent
TASK = ROOT / "problems" / "two_segment_stiff_x.yaml"


def never() -> bool:
    return False


@pytest.fixture
def design() -> Design:
    return Design.of_task(stiffopt.load_task(TASK))


@pytest.fixture
def bench(design: Design, compiled: Path, monkeypatch: pytest.MonkeyPatch) -> Workbench:
    monkeypatch.setattr("stiffopt.studio.workbench.QUICK", 10.0)  # the machine may be busy
    bench = Workbench(design)
    assert bench.answer_best(never)
    return bench


# -- designs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", stiffopt.builtin_robots())
def test_a_bare_robot_gets_a_task(robot: str) -> None:
    design = Design.of_robot(robot)
    assert design.measure is not None
    assert not any(design.free)
    assert not design.has_own_robot


def test_a_dragged_pose_changes_what_is_asked_for_and_no_more(design: Design) -> None:
    turned = (0.9238795, 0.3826834, 0.0, 0.0)  # by 45 degrees about x
    moved = design.with_free((False, True, False), (0, 0, 0)).at_pose((0.01, 0.5, 0.18), turned)
    assert moved.task.target.position == (0.01, None, 0.18)
    assert moved.task.target.pointing is None
    pointed = moved.with_angular("pointing", (1, 0, 0, 0)).at_pose((0.0, 0.0, 0.18), turned)
    np.testing.assert_allclose(pointed.task.target.pointing, (0, -(0.5**0.5), 0.5**0.5), atol=1e-4)
    oriented = pointed.with_angular("orientation", turned)
    np.testing.assert_allclose(oriented.task.target.orientation, turned, atol=1e-4)
    assert oriented.angular == "orientation"
    held = oriented.with_free((False, False, False), (0.1, 0.02, 0.3))
    assert held.task.target.position == (0.0, 0.02, 0.18)


def test_what_makes_no_sense_is_refused_and_changes_nothing(design: Design) -> None:
    bench = Workbench(design)
    with pytest.raises(InputError, match="asks for nothing"):
        bench.change("free", lambda d: d.with_free((True, True, True), (0, 0, 0)))
    with pytest.raises(InputError, match="tip_mass"):
        bench.change("gravity", lambda d: d.with_gravity((0, 0, 9.81), -0.1))
    assert bench.design == design
    assert not bench.undo()


def test_undo_takes_back_a_whole_drag(design: Design) -> None:
    bench = Workbench(design)
    for x in (0.0, 0.01, 0.02):
        assert bench.change("target", lambda d, x=x: d.with_target(position=(x, 0.0, 0.19)))
    assert not bench.change("target", lambda d: d)
    bench.end_step()
    bench.change("target", lambda d: d.with_target(position=(0.03, 0.0, 0.19)))
    bench.change("direction", lambda d: d.with_measure(direction=(0, 1, 0)))
    assert bench.undo()
    assert bench.design.measure == design.measure
    assert bench.undo()
    assert bench.design.task.target.position == (0.02, 0.0, 0.19)
    assert bench.undo()
    assert bench.design == design


# -- answers --------------------------------------------------------------------------------------


def test_answers_are_those_of_the_solver(bench: Workbench) -> None:
    answer, expected = (
        bench.answer,
        stiffopt.solve_pressure(stiffopt.load_robot("stiff-flop-2"), stiffopt.load_task(TASK)),
    )
    assert answer is not None
    assert answer.is_best
    np.testing.assert_allclose(answer.pressures, expected.pressures, atol=1.0)
    assert answer.plain_stiffness is not None
    assert answer.plain_stiffness < answer.solution.stiffness
    html = texts.answer_html(bench)
    assert "solved" in html
    assert "1.445 N/m" in html
    assert "plain pressures: 1.308 (+10 %)" in html
    assert "segment 1: 1, 2, 3 at min" in html


def test_an_answer_where_the_calibration_saw_nothing_says_so() -> None:
    errors = ErrorModel(
        residual=1e-3, discrepancy=2e3, reach=3e4, gain=0.1, degrees_of_freedom=8.0,
        recorded=[[0.0] * 6, [1e3] * 6],
    )  # fmt: skip
    robot = stiffopt.load_robot("stiff-flop-2").description
    known = robot.model_copy(update={"calibration": Calibration(errors=errors)})
    design = Design.of_task(stiffopt.load_task(TASK))
    bench = Workbench(replace(design, description=known))
    bench.answer_best(never)
    assert bench.answer is not None
    text = known.extrapolation(bench.answer.pressures)
    assert text.endswith("kPa away: the model extrapolates")
    assert text in texts.answer_html(bench)


def test_an_answer_follows_a_drag_and_says_what_limits_it(bench: Workbench) -> None:
    bench.change("target", lambda d: d.with_target(position=(-0.028, 0.01, 0.19)))
    assert bench.answer_quickly(never)
    answer = bench.answer
    assert answer is not None
    assert not answer.is_best
    assert answer.solution.found
    np.testing.assert_allclose(answer.solution.tip_pose[:3, 3], (-0.028, 0.01, 0.19), atol=1.1e-4)
    assert bench.keep()
    assert not bench.keep()
    bench.change("target", lambda d: d.with_target(position=(-0.15, 0.0, 0.19)))
    bench.answer_quickly(never)
    bench.answer_best(never)
    html = texts.answer_html(bench)
    assert "out of reach" in html
    assert "6.562 mm away; held back by segment 1 channel 1 max" in html
    compared = texts.compared_html(bench)
    assert compared.count("<tr>") == 3
    assert "(-28.0, 10.0, " in compared


def test_a_drag_out_of_reach_is_followed_without_a_search_everywhere(
    design: Design, compiled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Workbench(design)
    bench.answer_best(never)
    monkeypatch.setattr(workbench, "QUICK", 60.0)
    monkeypatch.setattr(stiffopt.PressureSolver, "_found", None)
    bench.change("target", lambda d: d.with_target(position=(-0.15, 0.0, 0.19)))
    assert bench.answer_quickly(never)
    assert bench.answer is not None
    assert bench.answer.solution.status == "unreachable"
    assert "6.562 mm away; held back by" in texts.answer_html(bench)


def test_a_search_that_is_given_up_keeps_the_answer(bench: Workbench) -> None:
    before = bench.answer
    bench.change("target", lambda d: d.with_target(position=(0.0, 0.01, 0.19)))
    bench.answer_best(lambda: True)
    assert bench.answer is before or bench.answer.solution.found


def test_the_newest_request_wins() -> None:
    asked, is_full, go = [], threading.Event(), threading.Event()
    value = 0

    def quickly(cancel: object) -> None:
        asked.append(value)
        go.wait(10)

    def fully(cancel: object) -> None:
        is_full.set()

    worker = NewestWins(quickly, fully)
    for value in (1, 2, 3):  # noqa: B007 - read in the other thread
        worker.request()
    go.set()
    assert is_full.wait(10)
    worker.close()
    assert asked[-1] == 3
    assert len(asked) <= 2


# -- copies ---------------------------------------------------------------------------------------


def changes() -> Iterator[object]:
    rib = stiffopt.SceneObject(
        name="rib", capsule={"from": (0.08, -0.03, 0.09), "to": (0.08, 0.03, 0.09), "radius": 0.006}
    )
    yield pytest.param(lambda d: d, id="as it was")
    yield pytest.param(
        lambda d: (
            d.with_angular("pointing", (0.99, 0.1, 0.05, 0.0))
            .with_measure(kind="rotation", boundary="clamped", direction=(1, 2, 3))
            .with_force((0.0, 0.01, -0.02))
            .with_highest(1.2e5)
            .with_tolerance(5e-4, 0.05)
        ),
        id="task",
    )
    yield pytest.param(lambda d: d.with_objects([rib]).with_clearance(0.002), id="scene")
    yield pytest.param(lambda d: d.with_least_pressure(), id="least pressure")


@pytest.mark.parametrize("change", list(changes()))
def test_copies_load_as_they_are(change: object, design: Design, tmp_path: Path) -> None:
    changed = change(design)
    path = tmp_path / "task.yaml"
    path.write_text(texts.task_text(changed), encoding="utf-8")
    loaded = stiffopt.load_task(path)
    assert loaded.model_copy(update={"source": None}) == changed.task.model_copy(
        update={"robot": "stiff-flop-2", "source": None}
    )
    names = ran(texts.python_text(changed))
    assert names["task"] == changed.task.model_copy(update={"robot": None, "source": None})
    assert names["robot"].description == changed.description


def test_a_changed_robot_is_copied_with_its_task(tmp_path: Path) -> None:
    design = Design.of_robot("stiff-flop-2-hanging").with_gravity((0.0, 0.0, 0.0), 0.012)
    assert design.has_own_robot
    (tmp_path / texts.ROBOT_FILE).write_text(texts.robot_text(design), encoding="utf-8")
    path = tmp_path / "task.yaml"
    path.write_text(texts.task_text(design), encoding="utf-8")
    again = Design.of_task(stiffopt.load_task(path))
    assert again.description == design.description
    assert ran(texts.python_text(design))["robot"].description == design.description


def ran(program: str) -> dict[str, object]:
    """Run a copied program but for its search, and return its names."""
    names: dict[str, object] = {}
    exec(program.partition("solution =")[0], names)
    return names


def test_what_files_say_is_escaped(design: Design) -> None:
    bench = Workbench(design)
    bench.trouble = "<script>alert(1)</script>"
    assert "<script>" not in texts.answer_html(bench)
    assert "&lt;script&gt;" in texts.answer_html(bench)
    assert "</textarea><" not in texts.copy_html("", "</textarea><script>").removesuffix(
        "</textarea></div>"
    )


# -- the page -------------------------------------------------------------------------------------

viser = pytest.importorskip("viser", reason="viser is missing: pip install 'stiffopt[studio]'")


@pytest.fixture
def page() -> Iterator[object]:
    from stiffopt.studio.page import StudioPage

    page = StudioPage()
    yield page
    page.close()


UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "c3RpZmZvcHQgc3R1ZGlvIQ==",
}


def asked(page: object, path: str = "/", **headers: str) -> tuple[int, dict[str, str]]:
    """Return the status and the headers of the answer to a request."""
    connection = HTTPConnection("127.0.0.1", page.port, timeout=10)
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    connection.request("GET", path, headers=named)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders())
    connection.close()
    return found


def test_only_the_key_opens_the_page_and_its_socket(page: object) -> None:
    key = page.url.partition("?key=")[2]
    assert asked(page)[0] == 403
    assert asked(page, "/?key=wrong")[0] == 403
    assert asked(page, **UPGRADE)[0] == 403
    assert asked(page, f"/?key={key}", Host="evil.example")[0] == 403
    from websockets.datastructures import Headers

    from stiffopt.studio.page import KeyCheck

    refusal = KeyCheck()("/", Headers({"Host": "evil.example"}))
    assert b"this studio" in refusal.body
    assert b"rig" not in refusal.body
    status, headers = asked(page, f"/?key={key}")
    assert (status, headers["Location"]) == (303, "/")
    assert "HttpOnly; SameSite=Lax" in headers["Set-Cookie"]
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert asked(page, Cookie=cookie)[0] == 200
    assert asked(page, Cookie=cookie, **UPGRADE)[0] == 101
    for origin, expected in (
        ("http://evil.example", 403),
        ("null", 403),
        (f"http://127.0.0.1:{page.port + 1}", 403),
        (f"http://127.0.0.1:{page.port}", 101),
    ):
        assert asked(page, Cookie=cookie, Origin=origin, **UPGRADE)[0] == expected
    assert asked(page, Cookie=cookie, Host=f"evil.example:{page.port}", **UPGRADE)[0] == 403


def test_the_page_is_never_published(page: object) -> None:
    assert page.server.request_share_url() is None


def test_a_port_in_use_is_told(page: object) -> None:
    from stiffopt.studio.page import StudioPage

    with pytest.raises(InputError, match="cannot listen on 127"):
        StudioPage(port=page.port)


def test_what_the_studio_does_not_show_is_told(tmp_path: Path) -> None:
    assert kind_of("stiff-flop-2") == "robot"
    assert kind_of(str(TASK)) == "task"
    path = tmp_path / "result.yaml"
    path.write_text("format: stiffopt-result/1\n", encoding="utf-8")
    with pytest.raises(FileError, match="cannot be shown in the studio"):
        kind_of(str(path))
    with pytest.raises(FileError, match="no such file"):
        kind_of("nowhere.yaml")


# -- scenes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "cylinder", "half_space"])
def test_objects_are_placed_moved_and_saved(kind: str, design: Design, tmp_path: Path) -> None:
    first = objects.new_object(kind, (), design.description.length)
    second = objects.new_object(kind, (first,), design.description.length)
    assert {first.name, second.name} == {f"{kind} 1", f"{kind} 2"}
    there = np.array([0.09, -0.02, 0.11])
    moved = objects.moved(first, there)
    np.testing.assert_allclose(objects.place_of(moved.shape), there, atol=1e-4)
    size = objects.size_of(first.shape)
    if size is not None:
        assert objects.size_of(objects.resized(moved, 2 * size).shape) == pytest.approx(2 * size)
    vertices, faces = surface_mesh(moved.shape, 0.2)
    assert faces.max() < len(vertices)
    with_both = design.with_objects([first, second])
    changed = with_both.with_objects(objects.replaced(with_both.objects, moved))
    assert changed.objects == (moved, second)
    path = tmp_path / "scene.yaml"
    objects.save_scene(path, changed.task.scene)
    assert stiffopt.load_scene(path).objects == changed.objects
    objects.save_scene(path, with_both.task.scene)
    with pytest.raises(FileError, match="no scene file"):
        objects.save_scene(TASK, changed.task.scene)
    with pytest.raises(FileError, match=r"ends in \.yaml"):
        objects.save_scene(tmp_path / "scene.txt", changed.task.scene)


def test_held_pressures_lean_on_an_object_that_is_dragged(bench: Workbench) -> None:
    assert bench.answer is not None
    side = np.array([1.0, 0.0, 0.0])
    middle = bench.answer.robot.pose(bench.answer.pressures, 0.12)[:3, 3]
    ball = objects.new_object("sphere", (), 0.18)
    bench.hold(held=True)
    with pytest.raises(InputError, match="nothing to lean on"):
        bench.answer_quickly(never)
    forces = []
    for gap in (0.06, 0.022, 0.020):  # the arm and the ball are 15 and 11 mm wide
        item = objects.leant_on(objects.moved(ball, middle + gap * side), allowed=True)
        bench.change("move", lambda d, item=item: d.with_objects([item]))
        assert bench.answer_quickly(never)
        assert not bench.answer_best(never)  # which would move the arm away
        leaning = bench.leaning
        forces.append(sum(np.linalg.norm(each.force) for each in leaning.equilibrium.contacts))
        free, braced = leaning.stiffness
        said = texts.answer_html(bench)
        assert "times the free arm" in said
        assert (f"on {item.name}" in said) == bool(forces[-1])
        if forces[-1]:
            assert braced > 5 * free
            assert leaning.pushes()[0].force > 0
        else:
            assert braced == pytest.approx(free, rel=1e-3)
            assert leaning.pushes() is None
    assert forces[0] == 0 < forces[1] < forces[2]
    bench.hold(held=False)
    assert bench.leaning is None
    assert bench.answer_best(never)


def test_an_object_on_the_base_is_refused(design: Design) -> None:
    item = objects.moved(objects.new_object("sphere", (), 0.2), (0.0, 0.0, 0.01))
    with pytest.raises(InputError, match="the arm's base"):
        design.with_objects([item])


# -- timelines ------------------------------------------------------------------------------------


def test_a_path_plays(compiled: Path, tmp_path: Path) -> None:
    path = stiffopt.load_path(ROOT / "problems" / "paths" / "path_line_stiff_x.yaml")
    path = path.model_copy(update={"count": 6})
    solution = stiffopt.solve_path(stiffopt.load_robot("stiff-flop-2"), path)
    timeline = Timeline.of_path(path, solution)
    assert timeline.charts[0].title == "stiffness (N/m)"
    assert timeline.charts[-1].values.shape == (6, 3)
    halfway = timeline.at(float(solution.times[2:4].mean()))
    np.testing.assert_allclose(halfway.pressures, solution.pressures[2:4].mean(axis=0))
    assert halfway.row == 2
    np.testing.assert_array_equal(timeline.at(1e9).pressures, solution.pressures[-1])
    np.testing.assert_array_equal(timeline.at(-1.0).pressures, solution.pressures[0])
    html = texts.moment_html(timeline, 0.0)
    assert "solved" in html
    assert "tip of the model" in html

    motion = tmp_path / "motion.csv"
    motion.write_text(csv_text(solution), encoding="utf-8")
    again = timeline_of(str(motion), "stiff-flop-2")
    np.testing.assert_allclose(again.pressures, solution.pressures, rtol=1e-8)
    with pytest.raises(FileError, match="has more channels"):
        timeline_of(str(motion), "stiff-flop-1")


def test_a_recording_plays_with_what_was_seen(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text(
        "time_s,p1_pa,p2_pa,p3_pa,tip_x_m,tip_y_m,tip_z_m\n"
        "10,0,0,0,0,0,0.09\n10.5,20000,0,0,,,\n11,40000,0,0,0.001,0,0.09\n",
        encoding="utf-8",
    )
    timeline = timeline_of(str(file), "stiff-flop-1")
    assert timeline.duration == 1.0
    np.testing.assert_allclose(timeline.at(0.75).pressures, (30000, 0, 0))
    np.testing.assert_allclose(timeline.at(0.75).seen, (0, 0, 0.09))
    np.testing.assert_allclose(timeline.at(1.0).seen, (0.001, 0, 0.09))
    assert "tip seen" in texts.moment_html(timeline, 1.0)
    with pytest.raises(FileError, match="name the robot that was recorded"):
        timeline_of(str(file), "stiff-flop-2")


# -- maps -----------------------------------------------------------------------------------------


def test_a_map_becomes_a_coloured_cloud() -> None:
    robot = stiffopt.load_robot("stiff-flop-1")
    found = stiffopt.map_workspace(robot, samples=300, directions=[(1, 0, 0), (0, 0, 1)])
    cloud = StiffnessCloud.of(found, 1)
    assert cloud.points.shape == cloud.colours.shape == (len(found.centres), 3)
    stiffest = int(np.argmax(found.best[1]))
    assert cloud.colours[stiffest].tolist() == [253, 231, 37]
    assert cloud.legend.startswith("stiffest along z: violet ")
    assert len(StiffnessCloud.of(found, 1, 0.0).points) == (found.centres[:, 1] >= 0).sum()
    with pytest.raises(InputError, match="no cells"):
        StiffnessCloud.of(found, 1, 1.0)
    check_map(found, robot.description)
    with pytest.raises(InputError, match="another arm than 'stiff-flop-2'"):
        check_map(found, stiffopt.load_robot("stiff-flop-2").description)


def test_an_object_that_was_checked_can_be_moved() -> None:
    item = objects.new_object("sphere", (), 0.18)
    assert item.sphere is not None
    _ = item.sphere.from_base  # which is kept in the object
    moved = objects.moved(item, (0.05, 0.0, 0.1))
    assert moved.sphere is not None
    assert moved.sphere.centre == (0.05, 0.0, 0.1)


def test_a_braced_answer_says_where_it_leans(design: Design, compiled: Path) -> None:
    post = stiffopt.SceneObject(
        name="post",
        capsule={"from": (-0.03, -0.04, 0.11), "to": (-0.03, 0.04, 0.11), "radius": 0.005},
        contact={"allowed": True, "max_force": 0.3},
    )
    braced = design.with_task(
        scene=stiffopt.Scene(objects=[post]), brace=stiffopt.Brace(objects=["post"])
    )
    bench = Workbench(braced)
    assert bench.answer_best(never)
    assert bench.answer is not None
    (contact,) = bench.answer.solution.contacts
    said = texts.answer_html(bench)
    assert "on post" in said
    assert "clear of all" in said
    arrows = force_arrows(bench.answer.solution.equilibrium, 0.18)
    np.testing.assert_allclose(arrows[0, 1], contact.position, atol=1e-6)
    assert force_arrows(None, 0.18).shape == (1, 2, 3)
