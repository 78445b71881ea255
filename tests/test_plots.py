"""Pictures: that they are drawn, to scale, and say what they show."""

from __future__ import annotations

import sys
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

import stiffopt
from conftest import is_long
from examples import run_examples
from stiffopt import plots
from stiffopt.cli.main import main
from stiffopt.display import display_units
from stiffopt.model.obstacles import OBSTACLES
from stiffopt.optimise.solution import PressureSolution
from stiffopt.plots.contact import plot_contact
from stiffopt.plots.view import ViewAngles

MAXIMISE = {"maximise": {"direction": (1, 0, 0)}}


@cache
def solved(
    robot: str = "stiff-flop-2", **changes: Any
) -> tuple[stiffopt.Manipulator, PressureSolution]:
    target = changes.pop("target", (-0.03, 0.01, 0.19))
    task = stiffopt.Task(robot=robot, target={"position": target}, stiffness=MAXIMISE)
    arm = stiffopt.load_robot(robot)
    return arm, stiffopt.solve_pressure(arm, task)


def answer(arm: stiffopt.Manipulator, task: stiffopt.Task, p: Any) -> PressureSolution:
    """Return an answer with some pressures (n,), without a solver."""
    return PressureSolution(
        "solved", "", task, p, arm.tip_pose(p), 0.0, compliance=arm.tip_compliance(p),
        stiffnesses=(1.0,) * len(task.measures), robot=arm,
    )  # fmt: skip


def texts(figure: Any) -> str:
    """All that a figure says."""
    figure.canvas.draw()
    found = figure.findobj(lambda artist: hasattr(artist, "get_text"))
    return "\n".join(artist.get_text() for artist in found)


def test_the_file_is_a_picture_with_something_in_it(tmp_path: Path) -> None:
    path = tmp_path / "answer.png"
    plots.save_figure(plots.plot_solution(*solved()), path)
    image = imread(path)
    height, width = image.shape[:2]
    assert 600 < height < 2000
    assert 1000 < width < 3000
    grey = image[..., :3].mean(axis=2)
    for half in (grey[:, : width // 2], grey[:, width // 2 :]):  # the arm, the pressures
        assert 0.02 < (half < 0.97).mean() < 0.6
    assert [entry.name for entry in tmp_path.iterdir()] == ["answer.png"]


def test_it_says_what_it_shows() -> None:
    figure = plots.plot_solution(*solved(), plain=1.308, title="push [a] $5 & more_")
    text = texts(figure)
    for part in (
        r"push [a] \$5 & more_",
        "solved",
        "tip error 0.1 mm (tolerance 0.1 mm)",
        "1.445 N/m (plain: 1.308, +10 %)",
        "x (mm)",
        "z (mm)",
        "pressure (bar)",
        "segment 2",
        "stiffness ellipsoid",
        "target",
        "at a limit",
    ):
        assert part in text


def test_all_three_axes_have_one_scale() -> None:
    figure = plots.plot_solution(*solved())
    axes = figure.axes[0]
    sides = [np.ptp(getattr(axes, f"get_{name}lim")()) for name in "xyz"]
    shape = np.array(axes._box_aspect)
    assert np.allclose(shape / shape.max(), np.array(sides) / max(sides), rtol=1e-6)


def test_bars_are_the_pressures() -> None:
    arm, solution = solved()
    figure = plots.plot_solution(arm, solution)
    heights = [bar.get_height() for bar in figure.axes[1].patches]
    assert solution.pressures is not None
    assert heights[-6:] == pytest.approx(solution.pressures * 1e-5)
    assert heights[:6] == pytest.approx([1.5] * 6)


def test_the_ellipsoid_squared_is_the_free_stiffness() -> None:
    """The identity that the legend states."""
    arm, solution = solved()
    assert solution.tip_pose is not None
    assert solution.compliance is not None
    R = solution.tip_pose[:3, :3]
    C = R @ solution.compliance[:3, :3] @ R.T
    d = np.array([0.6, 0.0, 0.8])
    radius = 1 / np.sqrt(d @ C @ d)  # of {f: f'Cf = 1} along d
    assert radius**2 == pytest.approx(arm.stiffness(solution.pressures, d))


@pytest.mark.parametrize(
    "target",
    [
        {"position": (-0.02, None, None)},
        {"pointing": (-0.3, 0.1, 0.95), "tolerance": {"angle": 0.1}},
        {"orientation": (1, 0, 0, 0), "position": (None, None, 0.18)},
        {"position": (-0.2, 0.0, 0.3)},
    ],
)
def test_every_kind_of_target_is_drawn(target: dict[str, Any]) -> None:
    task = stiffopt.Task(
        robot="stiff-flop-2",
        target=target,
        stiffness={
            "maximise": {"direction": (0, 0, 1), "frame": "tip", "boundary": "guided"},
            "at_least": {"direction": (0, 0, 1), "kind": "rotation", "value": 1e-4},
        },
    )
    arm = stiffopt.load_robot("stiff-flop-2")
    away = target.get("position") == (-0.2, 0.0, 0.3)
    if is_long() or away:
        solution = stiffopt.solve_pressure(arm, task)
        assert solution.found != away
    else:
        solution = answer(arm, task, np.full(6, 0.5e5))
    text = texts(plots.plot_solution(arm, solution))
    assert "tip axes, guided" in text
    if "orientation" in target:
        assert "target orientation" in text
    if "pointing" in target:
        assert "target pointing" in text
    if target.get("position", (0,)).count(None) == 2:
        assert "free)" in text


def test_a_load_is_drawn() -> None:
    task = stiffopt.Task(
        robot="stiff-flop-1",
        target={"position": (-0.01, 0, None), "tolerance": {"position": 1e-3}},
        load={"force": (0, 0, -0.02)},
    )
    arm = stiffopt.load_robot("stiff-flop-1")
    solution = (
        stiffopt.solve_pressure(arm, task) if is_long() else answer(arm, task, np.full(3, 0.5e5))
    )
    assert "load 0.02 N" in texts(plots.plot_solution(arm, solution))


def test_a_hanging_arm_hangs() -> None:
    arm = stiffopt.load_robot("stiff-flop-2-hanging")
    p = np.full(6, 2e4)
    task = stiffopt.Task(robot="stiff-flop-2-hanging", target={"position": (0, 0, 0.18)})
    solution = PressureSolution(
        "solved", "", task, p, arm.tip_pose(p), 0.0, compliance=arm.tip_compliance(p)
    )
    figure = plots.plot_solution(arm, solution)
    figure.canvas.draw()
    axes = figure.axes[0]
    from mpl_toolkits.mplot3d import proj3d

    base, tip = (proj3d.proj_transform(0, 0, z, axes.get_proj())[1] for z in (0, 180))
    assert tip < base  # downwards on the page
    assert "gravity" in texts(figure)


def on_page(axes: Any, *points: tuple[float, float, float]) -> Any:
    """Points in mm in the plane of the picture, (k, 2)."""
    from mpl_toolkits.mplot3d import proj3d

    return np.stack([proj3d.proj_transform(*point, axes.get_proj())[:2] for point in points])


@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
@pytest.mark.parametrize("channel", [1, 5])
def test_all_figures_have_one_view_with_x_to_the_right(name: str, channel: int) -> None:
    """Wherever the arm bends to."""
    from matplotlib.figure import Figure

    arm = stiffopt.load_robot(name)
    axes = Figure().add_subplot(projection="3d", computed_zorder=False)
    pressures = np.zeros(6)
    pressures[channel] = 6e4
    assert [each.get_label() for each in plots.draw_arm(axes, arm, pressures)] == [
        "segment 1",
        "segment 2",
    ]
    origin, x, z = on_page(axes, (0, 0, 0), (10, 0, 0), (0, 0, 10))
    assert x[0] - origin[0] > 3 * abs(x[1] - origin[1])
    assert z[0] == pytest.approx(origin[0], abs=0.1 * abs(z[1] - origin[1]))
    assert (z[1] > origin[1]) == (name == "stiff-flop-2")
    assert abs(axes.elev) == pytest.approx(14)
    assert abs(axes.azim) == pytest.approx(66)


def test_the_arm_fills_its_panel() -> None:
    axes = plots.plot_solution(*solved()).axes[0]
    axes.apply_aspect()
    low, high = axes.transData.transform(on_page(axes, (0, 0, 0), (-30, 10, 190)))
    assert high[1] - low[1] > 0.6 * axes.bbox.height
    assert axes.bbox.y0 < low[1] < high[1] < axes.bbox.y1


def test_a_view_is_asked_for_in_radians_or_with_a_unit() -> None:
    arm, solution = solved()
    for view in ((np.radians(30), np.radians(10)), ("30 deg", "10 deg")):
        axes = plots.plot_solution(arm, solution, view=view).axes[0]
        assert (axes.elev, axes.azim, axes.roll) == pytest.approx((30, 10, 0))
    for wrong in (("30 deg",), "30 deg", ("100 deg", "0 deg"), ("1 mm", "2 mm"), (np.nan, 0.0)):
        with pytest.raises(stiffopt.InputError, match=r"view|angle|finite"):
            plots.plot_solution(arm, solution, view=wrong)


def test_help_and_page_say_the_default_view(capsys: pytest.CaptureFixture[str]) -> None:
    main(["solve", "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    page = (Path(__file__).parent.parent / "docs" / "command.md").read_text(encoding="utf-8")
    for name in ("stiff-flop-2", "stiff-flop-2-hanging"):
        view = ViewAngles.of(stiffopt.load_robot(name))
        angles = f"'{np.degrees(view.elevation):g} deg, {np.degrees(view.azimuth):g} deg'"
        assert angles in shown
        assert angles in page


TASKS: dict[str, dict[str, Any]] = {
    "one": {},
    "several": {
        "stiffness": {
            "maximise": [{"direction": (1, 0, 0)}, {"direction": (0, 1, 0)}],
            "at_least": {"direction": (0, 0, 1), "frame": "tip", "value": 0.5},
        }
    },
    "load": {"load": {"force": (0, 0, -0.02)}},
    "scene": {
        "scene": {
            "objects": [
                {"name": "post", "sphere": {"centre": (0.05, 0.0, 0.15), "radius": 0.01}},
                {"name": "rib", "sphere": {"centre": (-0.07, 0.02, 0.19), "radius": 0.01}},
            ]
        }
    },
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", TASKS)
@pytest.mark.parametrize("bend", [(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (0.5, 0.5, 0.5)])
def test_labels_cover_neither_each_other_nor_the_arm(kind: str, bend: tuple[float, ...]) -> None:
    arm = stiffopt.load_robot("stiff-flop-2")
    p = 1e5 * np.array([*bend, *bend[::-1]])
    tip = arm.tip_pose(p)
    changes = {"stiffness": MAXIMISE, **TASKS[kind]}
    task = stiffopt.Task(robot="stiff-flop-2", target={"position": tuple(tip[:3, 3])}, **changes)
    figure = plots.plot_solution(arm, answer(arm, task, p))
    axes = figure.axes[0]
    figure.canvas.draw()
    labels = [each for each in axes.texts if each.get_text()]
    assert len(labels) >= 2
    assert any("ellipsoid" in each.get_text() for each in labels)
    assert any("along x" in each.get_text() for each in labels)
    boxes = [Text.get_window_extent(each) for each in labels]  # without its line
    backbone = axes.transData.transform(
        on_page(axes, *(tuple(point) for point in arm.backbone(p, 60)[:, :3, 3] * 1e3))
    )
    for number, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:number])
        assert not any(box.contains(*point) for point in backbone)  # with the target at its end
        assert box.x0 > 0
        assert box.y1 < figure.bbox.y1


def test_numbers_on_bars_are_those_of_the_table() -> None:
    arm, solution = solved()
    assert solution.pressures is not None
    text = texts(plots.plot_solution(arm, solution))
    for pressure in solution.pressures:
        assert display_units().pressure.number(pressure, ".3f") in text


@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-3"])
def test_numbers_on_bars_stand_apart(name: str) -> None:
    arm = stiffopt.load_robot(name)
    p = np.full(arm.n_pressures, 1.1e5)
    task = stiffopt.Task(robot=name, target={"position": (0, 0, 0.1)})
    solution = PressureSolution("solved", "", task, p, arm.tip_pose(p), compliance=np.eye(6))
    figure = plots.plot_solution(arm, solution)
    figure.canvas.draw()
    boxes = [each.get_window_extent() for each in figure.axes[1].texts if "." in each.get_text()]
    assert len(boxes) == arm.n_pressures
    assert all(not one.overlaps(other) for one, other in pairwise(boxes))


def test_the_legend_keeps_clear_of_the_box() -> None:
    from stiffopt.plots.view import box_corners

    arm, solution = solved("stiff-flop-3", target=(-0.06, 0.02, 0.25))
    figure = plots.plot_solution(arm, solution)
    figure.canvas.draw()
    axes, panel = figure.axes[:2]
    corners = axes.transData.transform(on_page(axes, *map(tuple, box_corners(axes))))
    (legend,) = figure.legends
    assert legend.get_window_extent().x1 < corners[:, 0].min()
    assert corners[:, 0].max() < panel.bbox.x0


def test_many_channels_have_no_numbers_on_top_of_each_other() -> None:
    arm, solution = solved("stiff-flop-3", target=(-0.06, 0.02, 0.25))
    assert len(plots.plot_solution(arm, solution).axes[1].get_xticks()) == 9


def test_pareto_is_drawn_alone_and_beside() -> None:
    arm, solution = solved()
    front = stiffopt.pareto_front(arm, solution.task, 3)
    alone = plots.plot_pareto(front, plain=1.3, title="trade")
    assert "tip error (mm)" in texts(alone)
    beside = plots.plot_solution(arm, solution, front=front, plain=1.3)
    assert len(beside.axes) == 3
    x, y = beside.axes[2].lines[0].get_data()
    assert x == pytest.approx([(point.position_error or 0) * 1e3 for point in front])
    assert y == pytest.approx([point.stiffness for point in front])
    assert "out of reach" in texts(plots.plot_pareto([]))


def test_a_failure_cannot_be_drawn() -> None:
    arm, solution = solved()
    with pytest.raises(stiffopt.InputError, match="nothing to draw"):
        plots.plot_solution(arm, PressureSolution("failed", "", solution.task))


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, solution = solved()
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for draw in (lambda: plots.plot_solution(arm, solution), lambda: plots.plot_pareto([])):
        with pytest.raises(stiffopt.MissingExtraError, match="stiffopt\\[plot\\]"):
            draw()


def test_a_picture_that_cannot_be_written(tmp_path: Path) -> None:
    figure = plots.plot_pareto([])
    for name in ("no/folder/a.png", "a.xyz"):
        with pytest.raises(stiffopt.FileError, match="cannot be"):
            plots.save_figure(figure, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_the_scene_is_drawn_with_the_names_of_its_objects(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((0.02, 0.03, 0.04)).export(tmp_path / "box.stl")
    shapes: dict[str, dict[str, Any]] = {
        "sphere": {"centre": (0, 0.05, 0.1), "radius": 0.01},
        "capsule": {"from": (0.04, -0.03, 0.09), "to": (0.04, 0.03, 0.09), "radius": 0.006},
        "cylinder": {"from": (-0.06, 0.04, 0), "to": (-0.06, 0.04, 0.1), "radius": 0.008},
        "box": {"centre": (0.05, 0.05, 0.15), "size": (0.03, 0.02, 0.04)},
        "half_space": {"point": (0, 0, 0.23), "normal": (0, 0, -1)},
        "mesh": {"file": tmp_path / "box.stl", "scale": 1.0, "centre": (-0.05, -0.05, 0.1)},
        "inside_tube": {"points": [(0, 0, -0.01), (0, 0, 0.08), (-0.02, 0, 0.15)], "radius": 0.03},
        "trocar": {"centre": (0, 0, 0.03), "axis": (0, 0, 1), "radius": 0.02},
    }
    objects = [{"name": f"the {key}", key: shape} for key, shape in shapes.items()]
    figure = plots.plot_solution(*solved(), scene=stiffopt.Scene(objects=objects))
    text = texts(figure)
    assert set(shapes) == set(OBSTACLES)
    for part in ("scene", *(f"the {key}" for key in shapes)):
        assert part in text
    far = {"name": "far", "sphere": {"centre": (9, 0, 0), "radius": 0.01}}
    figure = plots.plot_solution(*solved(), scene=stiffopt.Scene(objects=[far]))
    assert figure.axes[0].get_xlim()[1] < 400  # mm


def test_the_page_of_figures_runs() -> None:
    page = Path(__file__).resolve().parent.parent / "docs" / "figures.md"
    assert run_examples(page.read_text(encoding="utf-8"), page.name) == 1


def test_panels_of_an_empty_path_say_so() -> None:
    arm = stiffopt.load_robot("stiff-flop-1")
    nothing = stiffopt.PathSolution("failed", "", arm, *[np.empty(0)] * 3)
    draws: tuple[Any, ...] = (
        lambda: plots.draw_path(None, nothing),
        lambda: plots.draw_stiffness_along(None, nothing),
        lambda: plots.draw_clearance_along(None, nothing),
        lambda: plots.draw_pressures_along(None, nothing, 1),
    )
    for draw in draws:
        with pytest.raises(stiffopt.InputError, match="nothing to draw"):
            draw()


def test_a_contact_force_is_labelled_with_its_object():
    arm = stiffopt.load_robot("stiff-flop-2")
    rib = stiffopt.SceneObject(
        name="rib",
        capsule={"from": (0.02, -0.05, 0.12), "to": (0.02, 0.05, 0.12), "radius": 0.005},
        contact={"allowed": True},
    )
    scene = stiffopt.Scene(objects=[rib])
    leaning = arm.contact_equilibrium(np.zeros(6), scene, load=[0.02, 0, 0, 0, 0, 0])
    size = np.linalg.norm(leaning.contacts[0].force)
    assert f"{size:.3g} N by 'rib'" in texts(plot_contact(arm, leaning, scene))
