"""Messages to the daemon say all that a task, target or trajectory says, or refuse to."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from pydantic import Discriminator, Tag

from simulated_loop import TASK, Lab
from stiffopt.control.checks import (
    check_target,
    check_task,
    check_trajectory,
    contents,
    differences,
)
from stiffopt.control.state import State
from stiffopt.daemon.messages import (
    TargetMessage,
    TaskMessage,
    TrajectoryMessage,
    message_of,
    task_of,
    trajectory_of,
)
from stiffopt.errors import InputError
from stiffopt.model.obstacles import OBSTACLES
from stiffopt.model.obstacles.mesh import Mesh
from stiffopt.model.scene import AllowedContact, Scene, SceneObject
from stiffopt.optimise.brace import Brace
from stiffopt.optimise.goal import (
    AtLeast,
    MatchMatrix,
    MatchValue,
    StiffnessGoal,
    StiffnessMeasure,
)
from stiffopt.optimise.press import Press
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import Load, PressureRange, Task, load_task
from stiffopt.optimise.terms import TERMS
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.rig.interface import PressureLimits
from stiffopt.schema import Items, Schema, Vector
from stiffopt.units import Length, Number, Speed, TranslationalStiffness
from test_measures import MeanStiffness

PROBLEMS = Path(__file__).resolve().parent.parent / "problems"
LIMITS = PressureLimits([0.0] * 3, [1.5e5] * 3)  # type: ignore[arg-type]
SLEW = np.full(3, 5e5)
X = (1.0, 0.0, 0.0)
MESSAGES: tuple[type[Schema], ...] = (
    *(Task, Target, Tolerance, StiffnessGoal, StiffnessMeasure, AtLeast, MatchValue, MatchMatrix),
    *(Load, Brace, Press, PressureRange, Waypoint, Trajectory),
    *(Scene, SceneObject, AllowedContact, *(kind for kind in OBSTACLES.values() if kind != Mesh)),
)
UNSAID: dict[type[Schema], set[str]] = {
    Task: {"source"},
    Scene: {"source"},
    MatchMatrix: {"unit"},
    SceneObject: {"mesh"},
}


class GentleTarget(Target):
    speed: float | None = None


class GentleTolerance(Tolerance):
    time: float | None = None


class GentleMeasure(StiffnessMeasure):
    damping: float | None = None


class GentleAtLeast(AtLeast):
    damping: float | None = None


class GentleMatch(MatchValue):
    damping: float | None = None


class GentleMatrix(MatchMatrix):
    damping: float | None = None


class GentleGoal(StiffnessGoal):
    dynamics: str | None = None


class GentleLoad(Load):
    rate: float | None = None


class GentleRange(PressureRange):
    spread: float | None = None


class GentleTask(Task):
    gentle: bool | None = None


class GentleWaypoint(Waypoint):
    speed: float | None = None


class GentleTrajectory(Trajectory):
    repeat: int | None = None


def task(**parts: Any) -> Task:
    return Task(robot="stiff-flop-1", **{"target": TASK.target, **parts})


def goal(**parts: Any) -> Task:
    return task(stiffness=StiffnessGoal(**parts))


def gentle_tasks(more: float | None) -> list[tuple[Task, str]]:
    """Return tasks that say one thing more than a task can, if there is more, and where."""
    matrix = ((100.0, 0.0, 0.0), (0.0, 100.0, 0.0), (0.0, 0.0, 900.0))
    position = TASK.target.position
    tolerance = GentleTolerance(time=more)
    return [
        (
            GentleTask(robot="stiff-flop-1", target=TASK.target, gentle=more and bool(more)),
            "gentle",
        ),
        (task(target=GentleTarget(position=position, speed=more)), "target.speed"),
        (task(target=Target(position=position, tolerance=tolerance)), "target.tolerance.time"),
        (
            task(
                stiffness=GentleGoal(
                    at_least=AtLeast(direction=X, value=9.0), dynamics=more and "slow"
                )
            ),
            "stiffness.dynamics",
        ),
        (
            goal(
                maximise=[StiffnessMeasure(direction=X), GentleMeasure(direction=X, damping=more)]
            ),
            "stiffness.maximise[1].damping",
        ),
        (
            goal(at_least=GentleAtLeast(direction=X, value=9.0, damping=more)),
            "stiffness.at_least[0].damping",
        ),
        (
            goal(match=GentleMatch(direction=X, value=9.0, damping=more)),
            "stiffness.match.damping",
        ),
        (goal(match=GentleMatrix(matrix=matrix, damping=more)), "stiffness.match.damping"),
        (task(load=GentleLoad(rate=more)), "load.rate"),
        (task(pressure=GentleRange(spread=more)), "pressure.spread"),
    ]


@pytest.mark.parametrize("index", range(len(gentle_tasks(1.0))))
def test_what_a_message_cannot_say_is_refused_and_named(index: int) -> None:
    given, key = gentle_tasks(1.0)[index]
    with pytest.raises(InputError, match="cannot contain this, so it would be lost") as caught:
        TaskMessage.of(given)
    assert str(caught.value).startswith(f"{key}: ")
    with pytest.raises(InputError, match="unknown key") as caught:
        check_task(given, LIMITS)
    assert key.split(".")[-1] in str(caught.value)
    plain, _ = gentle_tasks(None)[index]
    check_task(plain, LIMITS)
    TaskMessage.of(plain)


def test_a_message_of_a_target_or_trajectory_says_all_of_it() -> None:
    target = GentleTarget(position=TASK.target.position, speed=0.1)
    with pytest.raises(InputError, match="speed: the daemon's messages cannot contain this"):
        TargetMessage.of(target)
    with pytest.raises(InputError, match=r"Target\.speed: unknown key"):
        check_target(target)
    plain = Waypoint(time=0.0, target=TASK.target)
    for trajectory, key in (
        (Trajectory(waypoints=(plain, Waypoint(time=1.0, target=target))), "target.speed"),
        (Trajectory(waypoints=(GentleWaypoint(time=1.0, target=TASK.target, speed=1.0),)), "speed"),
        (GentleTrajectory(waypoints=(plain,), repeat=2), "repeat"),
    ):
        with pytest.raises(InputError, match=f"{key}: the daemon's messages cannot contain"):
            TrajectoryMessage.of(trajectory)
        with pytest.raises(InputError, match=f"{key}: unknown key"):
            check_trajectory(trajectory, LIMITS, SLEW)


def test_a_mesh_is_refused_and_not_dropped() -> None:
    mesh = Mesh.model_construct(file=Path("organ.stl"), scale=1e-3)
    item = SceneObject.model_construct(name="organ", mesh=mesh, contact=None)
    given = task().model_copy(update={"scene": Scene.model_construct(objects=(item,))})
    with pytest.raises(
        InputError, match=r"scene\.objects\[0\]\.mesh: the daemon's messages cannot"
    ):
        TaskMessage.of(given)


def test_the_loop_refuses_what_its_steering_does_not_understand() -> None:
    lab = Lab().under_pressure()
    calls = list(lab.controller.calls)
    for given, key in gentle_tasks(1.0):
        with pytest.raises(InputError, match=key.split(".")[-1]):
            lab.loop.set_task(given)
    assert lab.controller.calls == calls
    assert lab.tick().state is State.ACTIVE


def test_a_floor_among_what_is_maximised_is_not_forgotten() -> None:
    given = goal(maximise=AtLeast(direction=X, value=9.0))
    with pytest.raises(InputError, match=r"stiffness\.maximise\[0\]\.value"):
        TaskMessage.of(given)
    with pytest.raises(InputError, match="value"):
        check_task(given, LIMITS)


def test_a_goal_with_another_measure_survives_its_message() -> None:
    """Each kind of measure is read as itself, and as many may be sent as of one kind."""

    class Goal(StiffnessGoal):
        maximise: Items[  # type: ignore[assignment]
            Annotated[
                Annotated[StiffnessMeasure, Tag("<direction>")]
                | Annotated[MeanStiffness, Tag("<mean>")],
                Discriminator(lambda value: "<mean>" if "mean" in value else "<direction>"),
            ]
        ] = ()

    given = Goal(maximise=[{"mean": "translation"}, {"direction": X}])
    message = message_of(Goal)
    sent = json.loads(json.dumps(message.of(given).model_dump()))
    assert sent["maximise"][0] == {"mean": "translation"}
    assert message.model_validate(sent).read() == given
    with pytest.raises(InputError, match=r"maximise: .* at most 50"):
        message.of(Goal(maximise=[{"mean": "translation"}] * 51))
    with pytest.raises(InputError, match=r"^maximise\[0\]\.value: Extra"):
        message.of(Goal.model_construct(maximise=(AtLeast(direction=X, value=9.0),)))


def test_too_much_for_a_message_is_refused_as_input() -> None:
    with pytest.raises(InputError, match=r"maximise: .* at most 50"):
        TaskMessage.of(goal(maximise=[StiffnessMeasure(direction=X)] * 51))
    with pytest.raises(InputError, match=r"position_m"):
        TargetMessage.of(Target.model_construct(position=(1.0, float("nan"), 0.0)))


@pytest.mark.parametrize(
    ("match", "expected"),
    [
        ({"direction": list(X), "value": 1.0, "valeu": 1.0}, "match.valeu: Extra"),
        ({"matrix_n_per_m": [[1.0, 0.0, 0.0]] * 2}, "match.matrix_n_per_m: List"),
        ({"frame": "base"}, "match.direction: Field required; also stiffness.match.value: Field"),
    ],
)
def test_a_mistake_in_a_measure_is_named_by_its_key_alone(
    match: dict[str, Any], expected: str
) -> None:
    sent = {"target": {"position_m": [0.0, 0.0, 0.18]}, "stiffness": {"match": match}}
    with pytest.raises(InputError) as caught:
        task_of(sent, "a robot")
    assert str(caught.value).startswith(f"stiffness.{expected}")
    assert "Message." not in str(caught.value)


@pytest.mark.parametrize("path", sorted(PROBLEMS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_problem_survives_its_message(path: Path) -> None:
    given = load_task(path)
    sent = json.loads(json.dumps(TaskMessage.of(given, robot="the arm").model_dump()))
    assert task_of(sent, "the arm") == given.model_copy(update={"robot": "the arm", "source": None})
    assert not differences(contents(given), contents(task_of({**sent, "robot": None}, given.robot)))


def test_a_trajectory_survives_its_message() -> None:
    target = Target(position=(0.01, None, -0.0), tolerance=Tolerance(position=2e-3, angle=0.3))
    given = Trajectory(waypoints=[Waypoint(time=t, target=target) for t in (0.0, 0.1, 2.0)])
    sent = json.loads(json.dumps(TrajectoryMessage.of(given).model_dump()))
    assert trajectory_of(sent) == given


SHAPES: list[dict[str, Any]] = [
    {"sphere": {"centre": X, "radius": 0.1}},
    {"capsule": {"from": X, "to": (0, 0, 1), "radius": 0.1}},
    {"cylinder": {"from": X, "to": (0, 0, 1), "radius": 0.1}},
    {"box": {"centre": X, "size": (0.1, 0.1, 0.2), "orientation": (0, 1, 0, 0)}},
    {"half_space": {"point": X, "normal": (0, 0, -1)}},
    {"inside_tube": {"points": [X, (0, 0, 1)], "radius": 0.1}},
    {"trocar": {"centre": X, "axis": (0, 0, 1), "radius": 0.1}},
]
SCENE = Scene(
    clearance=0.001,
    objects=[
        {
            "name": f"{k}",
            "contact": {"allowed": True, "max_force": 0.3, "friction": 0.2, "stiffness": 50.0},
            **shape,
        }
        for k, shape in enumerate(SHAPES)
    ],
)
EVERYTHING: list[Schema] = [
    Task(robot="stiff-flop-1", target=TASK.target, scene=SCENE),
    Task(
        robot="stiff-flop-1",
        target=Target(
            position=(0.01, None, 0.1),
            pointing=(0.0, 0.6, 0.8),
            tolerance=Tolerance(position=2e-3, angle=0.3),
        ),
        stiffness=StiffnessGoal(
            maximise=[
                StiffnessMeasure(direction=X, frame="tip", kind="rotation", boundary="guided")
            ],
            at_least=[
                AtLeast(direction=X, frame="tip", kind="rotation", boundary="clamped", value=9.0)
            ],
        ),
        load=Load(force=(0.0, 0.1, -0.02), moment=(1e-3, 0.0, 0.0), frame="tip"),
        pressure=PressureRange(min=1e3, max=(None, 1.2e5, 1e5)),
    ),
    Task(
        robot="stiff-flop-1",
        target=Target(position=(0.01, 0.0, 0.1)),
        press=Press(
            force=0.03, direction=X, frame="tip", tolerance=1e-3, speed=1e-3, travel=5e-3
        ),
    ),
    goal(maximise=[StiffnessMeasure(direction=X)]).model_copy(
        update={
            "scene": Scene(
                objects=[
                    SceneObject(
                        name="post", sphere={"centre": (0.1, 0.0, 0.1), "radius": 0.01},
                        contact=AllowedContact(allowed=True, friction=0.3),
                    )
                ]
            ),
            "brace": Brace(
                objects=("post",), margin=0.03, contacts="sticking", approach="objects"
            ),
        }
    ),
    task(
        target=Target(orientation=(0.6, 0.0, 0.8, 0.0)),
        stiffness=StiffnessGoal(
            match=MatchValue(
                direction=X, frame="tip", kind="rotation", boundary="guided", value=9.0,
                tolerance=0.1,
            )
        ),
    ),
    goal(
        match=MatchMatrix(
            matrix=((100.0, 1.0, 0.0), (1.0, 100.0, 0.0), (0.0, 0.0, 900.0)),
            frame="tip", boundary="clamped", tolerance=0.2,
        )
    ),
    Trajectory(waypoints=[Waypoint(time=t, target=TASK.target) for t in (0.0, 0.5)]),
    Trajectory(waypoints=[Waypoint(time=0.0, target=TASK.target, pressures=(1e4, 0.0, 2e4))]),
    *(
        task(target=Target.model_validate({kind.key: kind.example}, context={"from_file": True}))
        for kind in TERMS
    ),
]  # fmt: skip
"""Descriptions in which each field has another value than by default, once at least."""


def schemas_in(value: Any) -> Iterator[Schema]:
    """Yield a description and those in it."""
    if isinstance(value, Schema):
        yield value
        value = [getattr(value, name) for name in type(value).model_fields]
    if isinstance(value, list | tuple):
        for item in value:
            yield from schemas_in(item)


def test_every_field_of_every_schema_survives_its_message() -> None:
    for given in EVERYTHING:
        sent = json.loads(json.dumps(message_of(type(given)).of(given).model_dump()))
        message = message_of(type(given)).model_validate(sent)
        assert message.read() == given
    seen = {
        (type(each), name)
        for given in EVERYTHING
        for each in schemas_in(given)
        for name, info in type(each).model_fields.items()
        if info.is_required() or getattr(each, name) != info.default
    }
    models = {model for model, _ in seen}
    in_terms = {type(each) for given in EVERYTHING[-len(TERMS) :] for each in schemas_in(given)}
    assert models == {*MESSAGES, *in_terms}
    for model in models:
        unsaid = UNSAID.get(model, set())
        wanted = {(model, name) for name in model.model_fields if name not in unsaid}
        assert wanted <= seen, f"EVERYTHING lacks {wanted - seen}"
        assert set(message_of(model).names) == {name for _, name in wanted}


class Obstacle(Schema):
    distance: Length = 0.01
    normal: Vector[Number]


class Rich(Schema):
    stiffening: TranslationalStiffness | None = None
    obstacles: Items[Obstacle] = ()
    speeds: Items[Speed | None]


def test_a_field_that_is_new_is_in_its_message_with_its_unit() -> None:
    given = Rich(stiffening=3.0, obstacles=[Obstacle(normal=X)], speeds=(0.1, None))
    sent = message_of(Rich).of(given).model_dump()
    assert sent == {
        "stiffening_n_per_m": 3.0,
        "obstacles": [{"distance_m": 0.01, "normal": [1.0, 0.0, 0.0]}],
        "speeds_m_per_s": [0.1, None],
    }
    assert message_of(Rich).model_validate(sent).read() == given


def test_differences_are_named_by_their_place() -> None:
    one = {"a": [1, {"b": 2}], "c": 3, "d": None}
    assert differences(one, one) == []
    assert differences(one, {"a": [1, {"b": 3}], "c": 3}) == ["a[1].b"]
    assert differences(one, {"a": [1], "c": 4}) == ["a", "c"]
    assert differences({"x": float("nan")}, {"x": float("nan")}) == ["x"]
