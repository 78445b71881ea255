"""An arm that leans on objects, in the loop and in motions that are planned."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

import stiffopt
from leaning_arm import (
    PERIOD,
    ROBOT,
    TASK,
    approach_fixture,  # noqa: F401
    few_starts_fixture,  # noqa: F401
    solution_fixture,  # noqa: F401
)
from stiffopt.cli.main import main
from stiffopt.control import planning
from stiffopt.control.checks import check_scene
from stiffopt.control.controller import TipController
from stiffopt.control.state import ControllerStatus
from stiffopt.errors import FileError, InputError
from stiffopt.optimise.solver import PressureSolver
from stiffopt.paths.leaning import GRADUAL, gradual
from stiffopt.paths.motion_file import read_motion
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.plant.settings import PlantLoad, PlantSettings, Silicone
from stiffopt.plots import plot_motion
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import RigDescription, limits_of, slew_of

# -- the loop ---------------------------------------------------------------------------------


class Loop:
    """A controller and a simulated arm without inertia, beside the post or without it."""

    def __init__(
        self, scene: stiffopt.Scene | None = TASK.scene, world: stiffopt.Scene | None = None
    ) -> None:
        settings = PlantSettings(
            scene=world,
            dynamics="quasi-static",
            silicone=Silicone(creep=(), hysteresis=()),
            discretisation={
                "step": 0.01,
                "bending_degree": 2,
                "shear_degree": 1,
                "sub_intervals": 3,
            },
        )
        description = RigDescription(
            robot="stiff-flop-2",
            supply={"driver": "simulated"},
            tracker={"driver": "simulated", "noise": 5e-5},
            safety={"max_pressure": 1.5e5, "max_slew": 5e5},
            scene=scene,
            plant=settings,
        )
        self.rig: Any = make_rig(description, ROBOT.description)
        self.controller = TipController(
            ROBOT, limits_of(description, ROBOT.description),
            slew_of(description, ROBOT.description), period=PERIOD, control=description.control,
            safety=description.safety, vibrates=False, scene=scene, slow_first_motion=False,
        )  # fmt: skip
        self.controller.check()
        self.command = np.zeros(6)
        self.told: list[str] = []
        self.rig.open()
        self.rig.supply.arm()
        self.controller.begin(self.rig.clock.now())

    def until(self, done: Callable[[ControllerStatus], bool], within: float) -> float:
        """Go on until something is so; how long it took, in s."""
        controller, clock = self.controller, self.rig.clock
        begin = clock.now()
        while clock.now() < begin + within:
            now = clock.now()
            controller.observe(now, self.command, self.rig.supply.read(), self.rig.tracker.read())
            self.command = controller.compute(now).pressures
            self.rig.supply.command(self.command)
            self.told += [each.kind for each in controller.notices() if not each.standing]
            clock.sleep_until(now + PERIOD)
            self.status = controller.status(now)
            if done(self.status):
                return float(clock.now() - begin)
        raise AssertionError(f"{self.status.brace}: {self.told}")

    def wait(self, seconds: float) -> None:
        """Go on for so long."""
        end = self.rig.clock.now() + seconds
        self.until(lambda _: self.rig.clock.now() >= end, seconds + 1.0)

    @property
    def force(self) -> float:
        forces = self.rig.world.plant.object_forces()
        return sum(float(np.linalg.norm(each.force)) for each in forces)


def test_the_loop_leans_holds_tells_a_lift_off_and_lets_go(solution, approach, monkeypatch):
    def solver(robot: Any, task: stiffopt.Task) -> Any:
        """What was found before stands for the search."""
        known = SimpleNamespace(solve=lambda: solution)
        return known if task.brace is not None else PressureSolver(robot, task)

    monkeypatch.setattr(planning, "PressureSolver", solver)
    loop = Loop()
    loop.wait(1.0)
    loop.controller.check_ahead(TASK)
    loop.controller.set_task(TASK)
    loop.until(lambda s: s.brace == "held", 20.0)
    assert loop.status.task == "brace"
    assert loop.told == ["braced"]
    missed = loop.status.position_error
    loop.wait(8.0)  # in which it goes to the target
    assert loop.status.position_error < 0.7 * missed
    assert loop.force == pytest.approx(approach.hold.forces[0], rel=0.15)
    assert loop.status.brace_force == pytest.approx(loop.force, rel=0.15)
    assert loop.status.brace_force_deviation == pytest.approx(0.2 * loop.status.brace_force)
    assert loop.status.brace_contacts == "held"
    assert not loop.status.touches
    plant = loop.rig.world.plant
    for push in (0.05, 0.09):
        plant.set_load(PlantLoad(force=(push, 0, 0)))
        loop.wait(0.5)
        assert loop.status.wrench[0] == pytest.approx(push, rel=0.25)
        assert loop.status.brace_force == pytest.approx(loop.force, abs=0.03)
    pushes = iter(np.linspace(0.09, 0.6, 100))
    for push in pushes:
        plant.set_load(PlantLoad(force=(push, 0, 0)))
        loop.wait(0.05)
        if loop.force == 0:
            break
    loop.until(lambda s: s.brace_contacts != "held", 0.3)
    assert "brace-uncertain" in loop.told
    for push in pushes:
        plant.set_load(PlantLoad(force=(push, 0, 0)))
        loop.wait(0.05)
        if loop.status.brace == "releasing":
            break
    assert loop.status.brace_contacts == "lost"
    assert loop.told[-1] == "brace-lost"
    plant.set_load(None)
    loop.until(lambda s: s.brace == "released", 20.0)
    assert loop.force == 0
    loop.controller.set_task(TASK.unbraced.model_copy(update={"scene": None}))
    loop.wait(2.0)
    assert loop.controller._way_back
    loop.controller.set_task(TASK)  # again, and then to a target elsewhere: it lets go first
    loop.until(lambda s: s.brace == "held", 40.0)
    assert not loop.controller._way_back  # a free posture is no way back
    waypoint = Waypoint(time=1.0, target=TASK.target)
    with pytest.raises(InputError, match="give it a task without 'brace' first"):
        loop.controller.follow(Trajectory(waypoints=[waypoint]), loop.rig.clock.now())
    free = TASK.unbraced.model_copy(update={"scene": None})
    loop.controller.set_task(free)
    assert loop.status.brace == "held"
    loop.until(lambda s: s.task == "target", 20.0)
    assert "release" in loop.told
    assert loop.force == 0
    loop.controller.close()


def test_an_arm_that_better_keeps_clear_is_told_of(solution, monkeypatch):
    """The search finds no posture that leans, so that the task is pursued without its brace."""

    def solver(robot: Any, task: stiffopt.Task) -> Any:
        known = SimpleNamespace(solve=lambda: replace(solution, contacts=()))
        return known if task.brace is not None else PressureSolver(robot, task)

    monkeypatch.setattr(planning, "PressureSolver", solver)
    loop = Loop()
    loop.wait(1.0)
    loop.controller.set_task(TASK)
    loop.wait(3.0)
    assert loop.told == ["brace-clear"]
    assert (loop.status.task, loop.status.brace) == ("target", "")
    assert loop.force == 0
    loop.controller.close()


def test_an_object_that_is_not_there_is_told_on_the_way(solution, monkeypatch):
    """The object of the scene stands elsewhere on the rig, so that nothing is touched."""
    known = SimpleNamespace(solve=lambda: solution)
    monkeypatch.setattr(planning, "PressureSolver", lambda robot, task: known)
    away = {"sphere": {"centre": (0.2, 0.2, 0.2), "radius": 0.01}, "contact": {"allowed": True}}
    loop = Loop(world=stiffopt.Scene(objects=[{"name": "far", **away}]))
    loop.wait(1.0)
    loop.controller.set_task(TASK)
    loop.until(lambda s: s.brace == "releasing", 20.0)
    assert loop.told == ["brace-lost"]
    assert loop.command.max() < 0.9 * solution.pressures.max(), "long before the end of the way"
    loop.until(lambda s: s.brace == "released", 20.0)
    loop.controller.close()


def test_a_contact_that_friction_holds_is_brought_to_the_target(solution, monkeypatch):
    """Friction withholds corrections at first; that is no push, so they go on."""
    known = SimpleNamespace(solve=lambda: solution)
    monkeypatch.setattr(planning, "PressureSolver", lambda robot, task: known)
    rough = TASK.scene.objects[0].model_copy(
        update={"contact": TASK.scene.objects[0].contact.model_copy(update={"friction": 0.4})}
    )
    loop = Loop(world=stiffopt.Scene(objects=[rough]))
    loop.wait(1.0)
    loop.controller.set_task(TASK)
    loop.until(lambda s: s.brace == "held", 20.0)
    missed = loop.status.position_error
    loop.wait(40.0)
    assert missed > 2e-3
    assert loop.status.position_error < 0.3 * missed
    assert set(loop.told) <= {"braced", "brace-off-target"}
    loop.controller.close()


@pytest.mark.parametrize("is_placed", [True, False])
def test_contacts_that_are_to_stick_are_relieved_of_friction(is_placed, solution, monkeypatch):
    """The plant's own friction: all that it can after the way into contact, little after a while.

    So it holds a push either way, along the direction of stiffness, and tells when it does not. The
    same if the target has no position, and the tip just stays.
    """
    known = SimpleNamespace(solve=lambda: solution)
    monkeypatch.setattr(planning, "PressureSolver", lambda robot, task: known)
    brace = TASK.brace.model_copy(update={"contacts": "sticking"})
    loop = Loop(world=TASK.scene)
    normal = solution.contacts[0].normal

    def share() -> float:
        """Tangential over normal force of the plant's contact."""
        (contact,) = loop.rig.world.plant.object_forces()
        along = float(normal @ contact.force)
        return float(np.linalg.norm(contact.force - along * normal)) / along

    loop.wait(1.0)
    target = TASK.target
    if not is_placed:
        pointing = tuple(map(float, solution.tip_pose[:3, 2]))
        target = target.model_copy(update={"position": None, "pointing": pointing})
    loop.controller.set_task(TASK.model_copy(update={"brace": brace, "target": target}))
    loop.until(lambda s: s.brace == "held", 20.0)
    loop.wait(8.0)
    assert share() > 0.15
    loop.wait(12.0)
    assert share() < (0.08 if is_placed else 0.12)
    assert loop.status.position_error < 1e-3 or not is_placed
    assert loop.status.brace == "held"
    loop.controller.close()


def test_the_loop_tells_that_there_is_nothing_to_lean_on():
    away = {"sphere": {"centre": (0.2, 0.2, 0.2), "radius": 0.01}}
    nothing = stiffopt.Scene(objects=[{"name": "far", **away}])
    loop = Loop(scene=nothing)
    with pytest.raises(InputError, match=r"no object 'post' in the scene.*the rig's scene"):
        loop.controller.check_ahead(TASK)
    loop = Loop(scene=None)
    with pytest.raises(InputError, match="the rig file has no scene"):
        loop.controller.set_task(TASK)
    loop.controller.close()


SCENE = TASK.scene
POST = SCENE.objects[0]
EYE = stiffopt.SceneObject(name="eye", sphere={"centre": (-0.055, 0.01, 0.175), "radius": 0.012})


def own(**changes) -> stiffopt.Task:
    return TASK.model_copy(update={"scene": SCENE.model_copy(update=changes)})


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (own(objects=(POST, EYE)), "the rig has no object 'eye'"),
        (own(clearance=SCENE.clearance + 1e-3), "its clearance is greater"),
        (
            own(objects=(POST.model_copy(update={"capsule": None, "sphere": EYE.sphere}),)),
            "'post' has another place or shape in the rig's scene",
        ),
        (
            own(objects=(POST.model_copy(update={"contact": POST.contact.model_copy(
                update={"max_force": 0.1})}),)),
            "'post' may be pressed with more than 'max_force' in the rig's scene",
        ),
        (own(objects=(EYE,)).model_copy(update={"brace": None}), "the rig has no object 'eye'"),
    ],
)  # fmt: skip
def test_a_task_may_not_ask_for_more_than_the_scene_of_the_rig(task, reason):
    loop = Loop()
    for give in (loop.controller.check_ahead, loop.controller.set_task):
        with pytest.raises(
            InputError, match=f"{reason}.*on a rig the scene of the rig file counts"
        ):
            give(task)
    loop.controller.close()


def test_an_object_of_a_task_is_found_by_its_shape_whatever_its_name():
    renamed = POST.model_copy(update={"name": "rod"})
    check_scene(own(objects=(renamed,)), SCENE)
    contact = POST.contact.model_copy(update={"max_force": 0.1})
    with pytest.raises(InputError, match="'rod' may be pressed with more than 'max_force'"):
        check_scene(own(objects=(renamed.model_copy(update={"contact": contact}),)), SCENE)
    ends = stiffopt.SceneObject(name="post", cylinder=POST.capsule.model_dump(by_alias=True))
    with pytest.raises(InputError, match="'post' has another place or shape"):
        check_scene(own(objects=(ends,)), SCENE)


def test_a_task_may_ask_for_less_than_the_scene_of_the_rig():
    loop = Loop(scene=SCENE.model_copy(update={"objects": (POST, EYE), "clearance": 2e-3}))
    shifted = float(np.nextafter(POST.capsule.radius, 1.0))  # rounded otherwise
    post = POST.model_copy(update={"capsule": POST.capsule.model_copy(update={"radius": shifted})})
    loop.controller.check_ahead(own(objects=(post,), clearance=1e-3))
    loop.controller.close()


# -- motions ----------------------------------------------------------------------------------


def test_a_motion_goes_to_rest_and_then_into_contact(solution, approach):
    start = np.array([0.0, 0, 2e4, 0, 1e4, 0])
    found = stiffopt.plan_motion(ROBOT, start, [TASK], slew=2e5)
    assert found.found
    assert "into contact: at the end it leans on 'post' with 0." in found.message
    assert found.pressures[0] == pytest.approx(start)
    assert (np.abs(found.pressures).max(axis=1) < 1e-6).any()
    assert found.pressures[-1] == pytest.approx(solution.pressures)
    assert found.tip_poses[-1][:3, 3] == pytest.approx(approach.tips[-1].pose[:3, 3], abs=1e-5)
    assert (np.abs(np.diff(found.pressures, axis=0)).max(axis=1)
            <= 2e5 * np.diff(found.times) * (1 + 1e-6)).all()  # fmt: skip
    assert found.equilibrium(0) is None
    assert found.equilibrium(len(found.times) - 1) is found.equilibria[-1]
    (contact,) = found.equilibria[-1].contacts
    assert np.linalg.norm(contact.force) == pytest.approx(approach.forces[-1], rel=1e-4)
    assert found.stiffness[0] == pytest.approx(ROBOT.stiffness(start, [1, 0, 0]))
    assert found.stiffness[-1] == pytest.approx(solution.stiffness, rel=1e-3)
    assert found.stiffness[-1] > 4 * found.stiffness[0]
    for ends in ((TASK, TASK), (start, [TASK, start])):
        with pytest.raises(InputError, match="the only goal of a motion, or its start"):
            stiffopt.plan_motion(ROBOT, *ends, slew=2e5)
    given_up = stiffopt.plan_motion(ROBOT, start, TASK, slew=2e5, cancel=lambda: True)
    assert given_up.status == "failed"
    assert "cancelled" in given_up.message


def test_a_motion_from_a_brace_lets_go_on_the_way_to_rest(solution, monkeypatch):
    """It is the way into contact backwards, without what goes past its end, and then goes on."""
    monkeypatch.setattr("stiffopt.paths.leaning.eased", None)  # which would go past it
    goal = np.array([0.0, 0, 2e4, 0, 1e4, 0])
    found = stiffopt.plan_motion(ROBOT, TASK, goal, slew=2e5, timeout=None)
    assert found.found
    assert "at the start it leans on 'post' with 0." in found.message
    assert "lets go on the way to rest; from there on the body is at least" in found.message
    assert found.pressures[0] == pytest.approx(solution.pressures)
    assert found.pressures[-1] == pytest.approx(goal)
    rest = int(np.argmin(np.abs(found.pressures).max(axis=1)))
    assert np.abs(found.pressures[rest]).max() < 1e-6
    lowered = found.pressures[: rest + 1, :].max(axis=1) / solution.pressures.max()
    assert (np.diff(lowered) < 0).all()
    assert found.pressures[: rest + 1] == pytest.approx(np.outer(lowered, solution.pressures))
    assert (np.abs(np.diff(found.pressures, axis=0)).max(axis=1)
            <= 2e5 * np.diff(found.times) * (1 + 1e-6)).all()  # fmt: skip
    speeds = np.linalg.norm(np.diff(found.tip_poses[: rest + 1, :3, 3], axis=0), axis=1)
    assert (speeds <= 0.02 * np.diff(found.times[: rest + 1]) * (1 + 1e-6)).all()
    assert found.leans[0]
    assert not found.leans[rest:].any()
    assert found.equilibrium(len(found.times) - 1) is None
    assert found.stiffness[0] == pytest.approx(solution.stiffness, rel=1e-3)
    assert found.stiffness[-1] == pytest.approx(ROBOT.stiffness(goal, [1, 0, 0]))
    with pytest.raises(InputError, match="leans on objects"):
        found.trajectory()
    wide = stiffopt.plan_motion(ROBOT, TASK, goal, clearance=0.04, timeout=None)
    assert wide.message.startswith("at rest: the body is 25 mm too near 'post'")


FREE = TASK.unbraced.model_copy(update={"scene": None})
FAR = stiffopt.Scene(
    objects=[{"name": "ball", "sphere": {"centre": (0.06, 0.06, 0.1), "radius": 7e-3}}]
)


@pytest.mark.parametrize("leaves", [True, False])
def test_a_motion_with_a_brace_has_one_scene_with_what_the_arm_leans_on(leaves):
    def plan(other, **options):
        ends = (TASK, other) if leaves else (other, TASK)
        return stiffopt.plan_motion(ROBOT, *ends, slew=2e5, timeout=None, **options)

    with pytest.raises(InputError, match="have different scenes"):
        plan(FREE.model_copy(update={"scene": FAR}))
    with pytest.raises(InputError, match="no object 'post' in the scene; it has 'ball'"):
        plan(np.zeros(6), scene=FAR)
    with pytest.raises(InputError, match="scene must be a Scene"):
        plan(np.zeros(6), scene="far")
    same = TASK.scene.model_copy(update={"source": None})
    for other in (FREE, FREE.model_copy(update={"scene": same})):
        assert plan(other).leans[0 if leaves else -1]


@pytest.mark.parametrize("leaves", [True, False])
def test_a_motion_with_a_brace_has_its_load(leaves):
    load = stiffopt.Load(force=(0.05, 0.0, 0.0))
    heavy = FREE.model_copy(update={"load": load})
    for other, given in ((heavy, None), (FREE, load), (np.zeros(6), load)):
        ends = (TASK, other) if leaves else (other, TASK)
        with pytest.raises(InputError, match="has that task's load"):
            stiffopt.plan_motion(ROBOT, *ends, slew=2e5, load=given)


def test_the_command_leaves_a_brace_in_its_own_scene(tmp_path, capsys):
    braced, other = "problems/braced/post.yaml", tmp_path / "other.yaml"
    text = "format: stiffopt-task/1\nrobot: stiff-flop-2\n"
    text += "target: {position: [30 mm, -10 mm, 190 mm]}\n"
    other.write_text(text)
    arguments = ["plan", "--from", braced, "--to", str(other), "--slew", "2 bar/s"]
    assert main(arguments) == 0
    assert "it leans on 'post'" in " ".join(capsys.readouterr().out.split())
    ball = "{name: ball, sphere: {centre: [60 mm, 60 mm, 100 mm], radius: 7 mm}}"
    other.write_text(f"{text}scene: {{objects: [{ball}]}}\n")
    assert main(arguments) == 2
    assert "have different scenes" in " ".join(capsys.readouterr().err.split())


def test_the_picture_of_a_motion_shows_the_arm_in_contact(solution):
    """The drawn centre line at the end is the braced one, and its force is labelled."""
    found = stiffopt.plan_motion(ROBOT, np.zeros(6), [TASK], slew=2e5)
    figure = plot_motion(found, TASK.scene)
    space = figure.axes[0]
    ends = [np.array(line.get_data_3d()).T[-1] for line in space.lines if len(line.get_xdata())]
    near = 1e-3 * np.array(ends) - found.equilibria[-1].tip_pose[:3, 3]
    assert (np.linalg.norm(near, axis=1) < 1e-6).sum() >= 2  # the tip's way, and the arm
    free = 1e-3 * np.array(ends) - ROBOT.tip_pose(found.pressures[-1])[:3, 3]
    assert np.linalg.norm(free, axis=1).min() > 2e-3
    (contact,) = found.equilibria[-1].contacts
    assert f"{np.linalg.norm(contact.force):.3g} N by 'post'" in [
        text.get_text() for text in figure.findobj(Text)
    ]


@pytest.mark.parametrize("name", ["motion.csv", "motion.yaml"])
def test_a_written_motion_that_leans_is_not_played(tmp_path, name):
    out, begin = tmp_path / name, "0,0,0,0,0,0 bar"
    arguments = ["--to", "problems/braced/post.yaml", "--slew", "2 bar/s", "--quiet"]
    assert main(["plan", "--from", begin, *arguments, "--out", str(out)]) == 0
    with pytest.raises(FileError, match=r"leans on objects.*give the rig its task"):
        read_motion(out, ROBOT.description)
    found = stiffopt.plan_motion(ROBOT, np.zeros(6), [TASK], slew=2e5)
    assert found.leans[-1]
    assert not found.leans[0]
    with pytest.raises(InputError, match="leans on objects"):
        found.trajectory()


def test_the_json_of_a_motion_names_its_contacts(capsys):
    file = "problems/braced/post.yaml"
    assert (
        main(["plan", "--from", "0,0,0,0,0,0 bar", "--to", file, "--slew", "2 bar/s", "--json"])
        == 0
    )
    said = json.loads(capsys.readouterr().out)
    (contact,) = said["contacts"]
    assert contact["object"] == "post"
    assert said["stiffness"][-1] > 4 * said["stiffness"][0]


def test_the_way_of_a_motion_begins_and_ends_gradually(approach):
    """The points are passed in order, at the given speed but for a second at each end."""
    for way in (approach.times, 0.1 * approach.times):  # the second one is too short to reach it
        times, duration = gradual(way), way[-1]
        pace = np.diff(way) / np.diff(times)
        assert (pace > 0).all()
        assert pace.max() <= 1 + 1e-9
        assert np.abs(pace - pace[::-1]).max() < 0.35  # points are not spaced alike at both ends
        middle = (times[1:] + times[:-1]) / 2
        left = np.minimum(middle, times[-1] - middle)
        assert (pace <= left / GRADUAL + 0.05).all() or duration > GRADUAL
        assert (pace[left < GRADUAL] <= left[left < GRADUAL] / GRADUAL + 0.2).all()
        extra = GRADUAL if duration > GRADUAL else 2 * np.sqrt(GRADUAL * duration) - duration
        assert times[-1] == pytest.approx(duration + extra)
