"""Scene files: what they may say, and how mistakes in them are told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stiffopt
from stiffopt.daemon.messages import task_of
from stiffopt.errors import FileError, InputError, MissingExtraError
from stiffopt.files import save_file
from stiffopt.model.obstacles.capsule import Capsule
from stiffopt.model.obstacles.mesh import Mesh
from stiffopt.model.obstacles.sphere import Sphere
from stiffopt.model.scene import Scene, SceneObject, load_scene
from stiffopt.rig.config import load_rig_description

trimesh = pytest.importorskip("trimesh")

pytestmark = pytest.mark.usefixtures("kept_grids")

GOOD = """\
format: stiffopt-scene/1
clearance: 2 mm
objects:
  - {name: rib, capsule: {from: [40 mm, -30 mm, 90 mm], to: [40 mm, 30 mm, 90 mm], radius: 6 mm}}
  - {name: table, half_space: {point: [0 mm, 0 mm, 260 mm], normal: [0, 0, -1]}}
  - name: post
    sphere: {centre: [0 mm, 40 mm, 120 mm], radius: 5 mm}
    contact: {allowed: true, max_force: 0.3 N, friction: 0.2, stiffness: 50 N/m}
  - {name: organ, mesh: {file: organ.stl, scale: 1 mm, centre: [0 mm, 90 mm, 100 mm]}}
  - name: lumen
    inside_tube: {points: [[0 mm, 0 mm, -5 mm], [0 mm, 0 mm, 300 mm]], radius: 150 mm}
  - {name: port, trocar: {centre: [0 mm, 0 mm, 30 mm], axis: [0, 0, 1], radius: 20 mm}}
  - {name: block, box: {centre: [0 mm, -60 mm, 90 mm], size: [20 mm, 20 mm, 20 mm]}}
  - {name: pole, cylinder: {from: [-50 mm, 0 mm, 0 mm], to: [-50 mm, 0 mm, 90 mm], radius: 6 mm}}
"""


@pytest.fixture
def folder(tmp_path: Path, organ: Path) -> Path:
    (tmp_path / "organ.stl").write_bytes(organ.read_bytes())
    (tmp_path / "scene.yaml").write_text(GOOD)
    return tmp_path


def test_a_scene_file_is_read(folder):
    scene = stiffopt.load_scene(folder / "scene.yaml")
    assert scene.clearance == 0.002
    names = ["rib", "table", "post", "organ", "lumen", "port", "block", "pole"]
    assert [item.name for item in scene.objects] == names
    assert scene.objects[0].shape == Capsule(
        start=(0.04, -0.03, 0.09), end=(0.04, 0.03, 0.09), radius=0.006
    )
    contact = scene.objects[2].contact
    assert contact is not None
    assert (contact.allowed, contact.max_force) == (True, 0.3)
    assert (contact.friction, contact.stiffness) == (0.2, 50.0)
    mesh = scene.objects[3].shape
    assert isinstance(mesh, Mesh)
    assert mesh.file == folder / "organ.stl"
    scene.check_against(stiffopt.load_robot("stiff-flop-2").description)


def test_a_scene_file_may_have_the_key_that_other_files_have(folder):
    lines = GOOD.splitlines()
    text = "\n".join([lines[0], "scene:", *(f"  {line}" for line in lines[1:])])
    (folder / "other.yaml").write_text(text)
    plain, other = load_scene(folder / "scene.yaml"), load_scene(folder / "other.yaml")
    assert plain.objects == other.objects
    (folder / "other.yaml").write_text(text.replace("radius: 6 mm", "radius: 0 mm", 1))
    with pytest.raises(FileError) as caught:
        load_scene(folder / "other.yaml")
    assert (caught.value.line, caught.value.key) == (5, "scene.objects[0].capsule.radius")


def test_a_scene_is_written_as_it_is_read(folder):
    scene = load_scene(folder / "scene.yaml")
    (folder / "sub").mkdir()
    save_file(folder / "sub" / "copy.yaml", "scene", scene)
    assert "from:" in (folder / "sub" / "copy.yaml").read_text()
    again = load_scene(folder / "sub" / "copy.yaml")
    assert again.objects == scene.objects


BAD = {
    "radius: 5 mm": ("radius: 0 mm", 7, "objects[2].sphere.radius", "must be greater than 0"),
    "radius: 20 mm": ("radius: -20 mm", 12, "objects[5].trocar.radius", "greater than 0"),
    "radius: 150 mm": ("radius: .nan", 11, "objects[4].inside_tube.radius", "not a finite number"),
    "name: post": ("name: rib", 6, "objects[2].name", "objects 1 and 3 are both called 'rib'"),
    "sphere: {c": ("shpere: {c", 7, "objects[2].shpere", "did you mean 'sphere'?"),
    "sphere: {centre": ("sphere: {center", 7, "objects[2].sphere", "mean 'centre'?"),
    "capsule: {from": ("capsule: {form", 4, "objects[0].capsule", "did you mean 'from'?"),
    "to: [40 mm, 30 mm": ("to: [40 mm, -30 mm", 4, "objects[0].capsule.to", "ends where it begins"),
    "[0 mm, 0 mm, 300 mm]]": ("[0 mm, 0 mm, -5 mm]]", 11, "objects[4].inside_tube.points",
                              "point 2 is where point 1 is"),
    ", [0 mm, 0 mm, 300 mm]]": ("]", 11, "objects[4].inside_tube.points", "at least 2 points"),
    "normal: [0, 0, -1]": ("normal: [0, 0, 0]", 5, "objects[1].half_space.normal", "is zero"),
    "clearance: 2 mm": ("clearance: 2", 2, "clearance", "has no unit"),
    "clearance: 2 m": ("clearance: -2 m", 2, "clearance", "must be at least 0"),
    "file: organ.stl": ("file: lung.stl", 9, "objects[3].mesh.file", "there is no file"),
    "file: organ": ("file: ../organ", 9, "objects[3].mesh.file", "there is no file"),
    "scale: 1 mm": ("scale: 0 mm", 9, "objects[3].mesh.scale", "must be greater than 0"),
    "{allowed: true": ("{allowed: true, grip: 3", 8, "objects[2].contact.grip",
                       "the keys here are allowed, max_force, friction, stiffness"),
    "max_force: 0.3 N": ("max_force: 0.3 m", 8, "objects[2].contact.max_force", "not a unit of"),
    "block, box: {": ("block, sphere: {centre: [1 m, 1 m, 1 m], radius: 1 mm}, box: {", 13,
                      "objects[6].sphere", "second shape, beside box"),
}  # fmt: skip


@pytest.mark.parametrize("given", BAD)
def test_a_mistake_in_a_scene_is_told_with_line_and_key(folder, given):
    instead, line, key, words = BAD[given]
    assert given in GOOD
    (folder / "scene.yaml").write_text(GOOD.replace(given, instead, 1))
    with pytest.raises(FileError, match=words.replace("?", r"\?")) as caught:
        load_scene(folder / "scene.yaml")
    assert (caught.value.line, caught.value.key) == (line, key)


def test_an_object_without_a_shape_and_a_scene_without_objects_are_refused():
    with pytest.raises(InputError, match="has no shape; expected the key box, capsule"):
        SceneObject(name="nothing")
    with pytest.raises(InputError, match="must not be empty"):
        Scene(objects=[])


def write_mesh(folder: Path, mesh: Any) -> None:
    mesh.export(folder / "organ.stl")


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (lambda mesh: mesh.update_faces(np.arange(len(mesh.faces)) > 2), "is not closed: [0-9]+"),
        (lambda mesh: mesh.update_faces(np.arange(len(mesh.faces)) < 0), "is empty"),
        (lambda mesh: mesh.apply_scale([1, 1, 1e-13]), "encloses no volume|is empty|not closed"),
        (lambda mesh: mesh.faces.__setitem__(3, mesh.faces[3, ::-1]), "are not wound alike"),
    ],
)
def test_a_mesh_that_is_no_body_is_refused(folder, broken, words):
    mesh = trimesh.load_mesh(folder / "organ.stl")
    broken(mesh)
    write_mesh(folder, mesh)
    with pytest.raises(FileError, match=words) as caught:
        load_scene(folder / "scene.yaml")
    assert (caught.value.line, caught.value.key) == (9, "objects[3].mesh.file")


@pytest.mark.parametrize("content", [b"", b"solid nothing\nendsolid", b"\0" * 200, b"v 1 2"])
def test_a_file_that_is_no_mesh_is_refused(folder, content):
    for name in ("organ.stl", "organ.obj", "organ.ply"):
        (folder / name).write_bytes(content)
        (folder / "scene.yaml").write_text(GOOD.replace("organ.stl", name))
        with pytest.raises(FileError) as caught:
            load_scene(folder / "scene.yaml")
        assert caught.value.key == "objects[3].mesh.file"


def test_a_mesh_wound_inside_out_and_one_in_obj_are_the_same_body(folder):
    mesh = trimesh.load_mesh(folder / "organ.stl")
    mesh.export(folder / "organ.obj")
    mesh.invert()
    mesh.export(folder / "turned.stl")
    points = np.random.default_rng(11).uniform(-0.03, 0.03, (50, 3))
    found = [
        Mesh(file=folder / name, scale=0.001).surface.distances(points)
        for name in ("organ.stl", "organ.obj", "turned.stl")
    ]
    assert found[1] == pytest.approx(found[0], abs=1e-7)
    assert found[2] == pytest.approx(found[0], abs=1e-9)
    assert found[0].min() < 0 < found[0].max()


def test_a_mesh_without_its_packages_says_what_to_install(folder, monkeypatch):
    from stiffopt.model import distance_grid

    distance_grid.read_surface.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "igl", None)
    with pytest.raises(MissingExtraError, match=r"stiffopt\[mesh\]"):
        load_scene(folder / "scene.yaml")


MISFITS = {
    "centre: [0 mm, 40 mm, 120 mm]": (
        "centre: [0 mm, 15 mm, 0 mm]", 7, "objects[2].sphere", "lies 5 mm within it"),
    "point: [0 mm, 0 mm, 260 mm]": (
        "point: [0 mm, 0 mm, 16 mm]", 5, "objects[1].half_space", "has 1 mm of the clearance of 2"),
    "radius: 20 mm": (
        "radius: 14 mm", 12, "objects[5].trocar.radius", "14 mm is too narrow for the arm"),
    "radius: 150 mm": (
        "radius: 16 mm", 11, "objects[4].inside_tube.radius", "15 mm with 2 mm of clearance"),
    "[[0 mm, 0 mm, -5 mm]": (
        "[[0 mm, 0 mm, 200 mm]", 11, "objects[4].inside_tube", "lies 65 mm outside of it"),
    "scale: 1 mm": ("scale: 1 m", 9, "objects[3].mesh.scale", "1 mm for files in millimetres"),
    "scale: 1 m": ("scale: 1 u", 9, "objects[3].mesh.scale", "0.04 mm across and the arm"),
    "90 mm, 100 mm": ("0 mm, 25 mm", 9, "objects[3].mesh", "within it"),
}  # fmt: skip


@pytest.mark.parametrize("given", MISFITS)
def test_a_scene_that_makes_no_sense_for_an_arm_is_refused(folder, given):
    instead, line, key, words = MISFITS[given]
    assert given in GOOD
    (folder / "scene.yaml").write_text(GOOD.replace(given, instead, 1))
    robot = stiffopt.load_robot("stiff-flop-2").description
    with pytest.raises(FileError, match=words) as caught:
        load_scene(folder / "scene.yaml").check_against(robot)
    assert (caught.value.line, caught.value.key) == (line, key)


def test_a_scene_built_in_code_is_refused_by_its_place():
    scene = Scene(objects=[SceneObject(name="ball", sphere=Sphere(centre=(0, 0, 0), radius=0.01))])
    robot = stiffopt.load_robot("stiff-flop-2").description
    with pytest.raises(InputError, match=r"Scene.objects\[0\].sphere: ball: the arm's base"):
        scene.check_against(robot)


def half_space(z: float, normal: tuple[float, ...] = (0, 0, 1)) -> dict[str, Any]:
    return {"half_space": {"point": (0, 0, z), "normal": normal}}


def box(top: float, x: float = 0.0) -> dict[str, Any]:
    return {"box": {"centre": (x, 0, top - 0.01), "size": (0.2, 0.2, 0.02)}}


@pytest.mark.parametrize("shape", [half_space(0), half_space(-0.005), box(0), box(-0.001, 0.08)])
@pytest.mark.parametrize("clearance", [0.0, 0.002])
def test_an_arm_may_be_mounted_on_a_plate(shape, clearance):
    robot = stiffopt.load_robot("stiff-flop-2")
    scene = Scene(clearance=clearance, objects=[{"name": "plate", **shape}])
    scene.check_against(robot.description)
    kind = scene.objects[0].shape
    depth = kind.distance_of((0, 0, 0))
    begin = 1.25 * (0.015 + clearance - depth)
    assert kind.begin(0.015, clearance) == pytest.approx(begin, abs=1e-9)
    assert robot.clearance(np.zeros(6), scene) == pytest.approx(begin + depth - 0.015, abs=1e-8)


@pytest.mark.parametrize(
    "shape",
    [
        half_space(0.001), half_space(0, (0.01, 0, 1)), half_space(0, (0, 0, -1)), box(0.001),
        box(0, 0.105), {"sphere": {"centre": (0.015, 0, 0), "radius": 0.006}},
        {"inside_tube": {"points": [(0, 0, 0.01), (0, 0, 0.3)], "radius": 0.016}},
    ],
)  # fmt: skip
def test_an_object_that_the_base_is_in_or_beside_is_no_mount(shape):
    robot = stiffopt.load_robot("stiff-flop-2").description
    scene = Scene(clearance=0.0005, objects=[{"name": "plate", **shape}])
    with pytest.raises(InputError, match="the arm's base, a body of radius 15 mm"):
        scene.check_against(robot)


def test_a_clearance_that_leaves_out_too_much_of_a_mounted_arm_is_refused():
    robot = stiffopt.load_robot("stiff-flop-2").description
    scene = Scene(clearance=0.03, objects=[{"name": "plate", **half_space(0)}])
    with pytest.raises(InputError, match=r"counts from 56\.25 mm up the arm; expected less than"):
        scene.check_against(robot)


def test_a_rig_file_may_have_a_scene_which_is_checked_against_its_arm(folder):
    rig = Path(__file__).parent.parent / "rig" / "sim-two-segment.yaml"
    text = rig.read_text() + "scene: scene.yaml\n"
    (folder / "rig.yaml").write_text(text)
    scene = load_rig_description(folder / "rig.yaml").scene
    assert scene is not None
    assert scene == load_scene(folder / "scene.yaml")
    (folder / "rig.yaml").write_text(text.replace("scene.yaml", "nothing.yaml"))
    with pytest.raises(FileError, match=r"scene: .*nothing.yaml: there is no such file"):
        load_rig_description(folder / "rig.yaml")
    own = "scene: {objects: [{name: a, sphere: {centre: [0 mm, 0 mm, 0 mm], radius: 1 mm}}]}"
    (folder / "rig.yaml").write_text(text.replace("scene: scene.yaml", own))
    with pytest.raises(FileError, match="within it") as caught:
        load_rig_description(folder / "rig.yaml")
    assert caught.value.key == "scene.objects[0].sphere"
    assert caught.value.line == len(text.splitlines())


def test_a_task_may_have_a_scene_which_is_checked_against_its_arm(folder):
    text = (
        "format: stiffopt-task/1\nrobot: stiff-flop-2\n"
        "target: {position: [0 mm, 0 mm, 180 mm]}\nscene: scene.yaml\n"
    )
    (folder / "task.yaml").write_text(text)
    task = stiffopt.load_task(folder / "task.yaml")
    assert task.scene == load_scene(folder / "scene.yaml")
    task.check_scene(task.resolve_robot())
    own = "scene: {objects: [{name: a, sphere: {centre: [0 mm, 0 mm, 0 mm], radius: 1 mm}}]}"
    (folder / "task.yaml").write_text(text.replace("scene: scene.yaml", own))
    task = stiffopt.load_task(folder / "task.yaml")
    with pytest.raises(FileError, match="within it") as caught:
        stiffopt.solve_pressure(stiffopt.load_robot("stiff-flop-2"), task)
    assert (caught.value.line, caught.value.key) == (4, "scene.objects[0].sphere")


def test_a_mesh_with_too_fine_a_grid_is_refused_with_its_line(organ, tmp_path):
    path = tmp_path / "scene.yaml"
    mesh = f"{{file: {organ}, scale: 1 mm, centre: [60 mm, 0 mm, 90 mm], resolution: 0.01 mm}}"
    path.write_text(f"format: stiffopt-scene/1\nobjects:\n  - {{name: organ, mesh: {mesh}}}\n")
    scene = load_scene(path)
    with pytest.raises(FileError, match="expected a coarser 'resolution'") as caught:
        scene.check_against(stiffopt.load_robot("stiff-flop-2").description)
    assert (caught.value.line, caught.value.key) == (3, "objects[0].mesh.resolution")


MESH = {"objects": [{"name": "a", "mesh": {"file": "a.stl", "scale_m": 1}}]}


@pytest.mark.parametrize("scene", ["scene.yaml", MESH])
def test_no_message_has_a_file_read(scene):
    given = {"target": {"position_m": [0, 0, 0.18]}, "scene": scene}
    with pytest.raises(InputError, match=r"valid dictionary|mesh: Extra inputs"):
        task_of(given, "stiff-flop-2")
    text = f"format: stiffopt-task/1\ntarget: {{}}\nscene: {scene}\n"
    with pytest.raises(InputError, match="scene: no file is read here"):
        task_of({"text": text}, "stiff-flop-2")


def test_a_message_may_have_a_scene():
    sphere = {"centre_m": [0, 0.05, 0.1], "radius_m": 0.01}
    scene = {"clearance_m": 0.002, "objects": [{"name": "post", "sphere": sphere}]}
    task = task_of({"target": {"position_m": [0, 0, 0.18]}, "scene": scene}, "stiff-flop-2")
    assert task.scene is not None
    assert task.scene.objects[0].shape == Sphere(centre=(0, 0.05, 0.1), radius=0.01)
