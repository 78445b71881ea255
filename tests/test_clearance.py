"""The clearance of arms: against many stations and another library, by differences, in C and VM."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import stiffopt
from independent.arms import ARMS, FLOP, Arm, neo_hookean
from independent.elements import discretise
from stiffopt.errors import EquilibriumError, InputError, PressureError
from stiffopt.model import arm_clearance
from stiffopt.model.scene import Scene

CASES = {
    "free": Arm((FLOP, FLOP)),
    "mixed": ARMS["3 segments, mixed"],
    "neo-Hookean": Arm((neo_hookean(FLOP), neo_hookean(FLOP))),
    "hanging": Arm((FLOP, FLOP)).under((0.0, 0.0, 9.81), 0.02),
}


@cache
def robot(case: str) -> stiffopt.Manipulator:
    return stiffopt.Manipulator(stiffopt.RobotDescription(**CASES[case].mapping()))


@cache
def scene() -> Scene:
    around = (0.03, 0.03, 0.06), (0.05, -0.02, 0.12), (-0.05, 0.01, 0.1), (-0.02, -0.06, 0.17)
    shapes: list[dict[str, Any]] = [
        *({"sphere": {"centre": centre, "radius": 0.008}} for centre in around[1:]),
        {"capsule": {"from": (0.04, -0.03, 0.09), "to": (0.04, 0.03, 0.12), "radius": 0.006}},
        {"box": {"centre": (0.0, 0.07, 0.14), "size": (0.03, 0.02, 0.05)}},
        {"cylinder": {"start": (-0.06, -0.03, 0.1), "end": (-0.06, 0.04, 0.1), "radius": 0.01}},
        {"half_space": {"point": (0.0, 0.0, 0.25), "normal": (0.1, 0.0, -1.0)}},
        {"inside_tube": {"points": [(0, 0, -0.02), (0, 0, 0.1), (0.02, 0, 0.3)], "radius": 0.03}},
        {"trocar": {"centre": (0.002, 0.0, 0.05), "axis": (0.0, 0.1, 1.0), "radius": 0.025}},
    ]
    objects = [{"name": f"{k} {next(iter(shape))}", **shape} for k, shape in enumerate(shapes)]
    return Scene(clearance=0.001, objects=objects)


def pressures(case: str, count: int, seed: int = 1) -> np.ndarray:
    model = robot(case)
    return np.random.default_rng(seed).uniform(0.0, 0.8e5, (count, model.n_pressures))


@pytest.fixture
def machine_code(compiled: Any) -> Iterator[None]:
    """Robots that have found no machine code before, and leave none behind."""
    robot.cache_clear()
    yield
    robot.cache_clear()


def by_many_stations(model: stiffopt.Manipulator, p: np.ndarray, count: int) -> np.ndarray:
    """Least distances of all objects but the ring, from stations alone."""
    at = np.linspace(0.0, model.length, count)
    positions = model._body.poses(p[None], at)[0, :, :3, 3]
    radii = model.body_radius(p, at)
    measured = arm_clearance.measured_scene(scene(), model.description)
    items = [item for item in measured.items if not item.is_ring]
    return np.array([(item.distances(positions).values - radii).min() for item in items])


@pytest.mark.parametrize("case", CASES)
def test_clearances_are_those_of_very_many_stations(case):
    model = robot(case)
    for p in pressures(case, 2 if case == "hanging" else 5):
        found = model.clearances(p, scene())
        brute = by_many_stations(model, p, 2000)
        assert (found.distances[:-1] < brute + 4e-6).all()
        assert (found.distances[:-1] > brute - 1e-5).all()
        assert model.clearance(p, scene()) == pytest.approx(found.distances.min(), abs=1e-8)
        assert found.nearest == found.names[found.distances.argmin()]


def shortened(arm: Arm, length: float) -> Arm:
    """What of two segments is between the base and an arc length at rest."""
    first = min(length, arm.tubes[0].length)
    lengths = first, max(length - first, 1e-9)
    pairs = zip(arm.tubes, lengths, strict=True)
    return Arm(tuple(replace(tube, length=each) for tube, each in pairs))


def test_the_clearance_of_an_independent_shape_is_the_same():
    arm, model = CASES["free"], robot("free")
    only = Scene(objects=[item for item in scene().objects if item.sphere is not None])
    for p in pressures("free", 1):
        arms = [shortened(arm, s) for s in np.linspace(1e-6, arm.length, 250)]
        positions = np.array([discretise(each, p, 1).pose[:3, 3] for each in arms])
        far = [
            np.linalg.norm(positions - np.array(item.shape.centre), axis=1).min()
            - item.shape.radius
            - FLOP.outer_radius
            for item in only.objects
        ]
        assert model.clearance(p, only) == pytest.approx(min(far), abs=5e-6)


@pytest.mark.parametrize("case", CASES)
def test_gradients_are_those_of_differences(case):
    model, (p,) = robot(case), pressures(case, 1, seed=3)
    found = model.clearances(p, scene())
    step = 20.0
    for k in range(model.n_pressures):
        aside = step * np.eye(model.n_pressures)[k]
        more, less = model.clearances(p + aside, scene()), model.clearances(p - aside, scene())
        slopes = (more.distances - less.distances) / (2 * step)
        scale = np.abs(found.gradients).max(axis=1)
        assert (np.abs(found.gradients[:, k] - slopes) < 2e-4 * scale + 1e-12).all()


@pytest.mark.usefixtures("machine_code")
@pytest.mark.parametrize("case", ["free", "neo-Hookean", "hanging"])
def test_machine_code_finds_what_python_finds(case, monkeypatch):
    model, p = robot(case), pressures(case, 6, seed=4)
    assert model._body.machine_code(10_000) is not None
    fast, least = model.clearances(p, scene()), model.clearance(p, scene())
    assert least == pytest.approx(fast.distances.min(axis=1), abs=5e-6)
    monkeypatch.setattr(arm_clearance, "scene_library", lambda: None)
    slow = model.clearances(p[:3], scene())
    for name, tolerance in (
        ("distances", 2e-8), ("positions", 2e-5), ("normals", 1e-3), ("gradients", 1e-9),
    ):  # fmt: skip
        assert getattr(fast, name)[:3] == pytest.approx(getattr(slow, name), abs=tolerance)
    assert model.clearance(p[:2], scene()) == pytest.approx(least[:2], abs=5e-6)


@pytest.mark.usefixtures("machine_code")
def test_a_batch_is_its_rows_one_by_one():
    model, p = robot("free"), pressures("free", 40, seed=5)
    assert model._body.machine_code(10_000) is not None
    distances, found = model.clearance(p, scene()), model.clearances(p, scene())
    assert distances.shape == (40,)
    assert found.gradients.shape == (40, len(found.names), 6)
    for k in (0, 17, 39):
        assert model.clearance(p[k], scene()) == distances[k]
        one = model.clearances(p[k], scene())
        for name in ("distances", "at", "positions", "normals", "gradients"):
            np.testing.assert_array_equal(getattr(one, name), getattr(found, name)[k])


def test_the_straight_arm_ends_in_a_hemisphere():
    model = stiffopt.load_robot("stiff-flop-2")
    above = Scene(objects=[{"name": "a", "sphere": {"centre": (0, 0, 0.25), "radius": 0.01}}])
    assert model.clearance(np.zeros(6), above) == pytest.approx(0.25 - 0.18 - 0.025, abs=1e-9)
    beside = Scene(objects=[{"name": "a", "sphere": {"centre": (0.06, 0, 0.05), "radius": 0.01}}])
    found = model.clearances(np.zeros(6), beside)
    assert found.distances[0] == pytest.approx(0.035, abs=1e-9)
    assert found.at[0] == pytest.approx(0.05, abs=1e-6)
    assert found.normals[0] == pytest.approx([-1, 0, 0], abs=1e-6)


def test_a_body_passes_through_a_trocar_beside_it_or_not_at_all():
    model, p = stiffopt.load_robot("stiff-flop-2"), np.zeros(6)

    def of(centre: tuple[float, float, float], radius: float = 0.02) -> float:
        ring = {"centre": centre, "axis": (0, 0, -1), "radius": radius}
        return float(model.clearance(p, Scene(objects=[{"name": "port", "trocar": ring}])))

    assert of((0.0, 0.0, 0.03)) == pytest.approx(0.005, abs=1e-9)
    assert of((0.002, 0.0, 0.03)) == pytest.approx(0.003, abs=1e-9)
    assert of((0.0, 0.019, 0.03)) == pytest.approx(-0.014, abs=1e-9)
    assert of((0.0, 0.021, 0.03)) == pytest.approx(-0.016, abs=1e-9)  # beside the disc
    assert of((0.0, 0.05, 0.03)) == pytest.approx(-0.045, abs=4e-6)  # of a least distance
    assert of((0.0, 0.0, 0.19)) == pytest.approx(-0.01, abs=1e-9)  # not reached
    assert of((0.0, 0.05, 0.22)) == pytest.approx(-0.05, abs=1e-9)
    assert of((0.0, 0.0, 0.0)) == pytest.approx(0.005, abs=1e-9)


PLATE = {"name": "plate", "half_space": {"point": (0.0, 0.0, 0.0), "normal": (0.0, 0.0, 1.0)}}


@pytest.mark.parametrize("asked", [0.0, 2e-3])
def test_a_mounted_arm_that_is_clear_has_no_disc_nearer_to_its_plate(asked):
    model = stiffopt.load_robot("stiff-flop-2")
    plate = Scene(clearance=asked, objects=[PLATE])
    most = model.pressure_max
    ends = np.array([[k >> i & 1 for i in range(6)] for k in range(64)]) * most
    p = np.vstack([ends, np.random.default_rng(2).uniform(0, most, (200, 6))])
    begin = 1.25 * (0.015 + asked)
    at = np.sort(np.append(np.linspace(0, model.length, 181)[1:], begin))
    poses = model.pose(p, at)
    rims = poses[..., 2, 3] - 0.015 * np.sqrt(1 - np.minimum(poses[..., 2, 2] ** 2, 1))
    balls = poses[..., 2, 3] - 0.015
    found = model.clearance(p, plate)
    counted = at >= begin
    np.testing.assert_allclose(found, balls[:, counted].min(axis=1), atol=4e-4)
    assert (balls[:, np.argmax(counted)] > asked + 1e-3).all()  # bent arms are clear there too
    clear = found >= asked
    assert 20 < clear.sum() < len(p)
    assert (rims[clear] > -1e-9).all()
    assert (rims[clear][:, at > 1.5 * asked] >= asked).all()


@pytest.mark.usefixtures("machine_code")
def test_machine_code_counts_a_mounted_arm_as_python_does(monkeypatch):
    model, p = robot("free"), pressures("free", 6, seed=7)
    p[0] = [0.0, 0.0, 1.5e5, 0.0, 0.0, 1.5e5]
    p[1] = 0.0
    assert model._body.machine_code(10_000) is not None
    plate = Scene(clearance=0.002, objects=[PLATE, *scene().objects[:1]])
    fast, least = model.clearances(p, plate), model.clearance(p, plate)
    assert fast.at[1, 0] == pytest.approx(1.25 * 0.017)
    monkeypatch.setattr(arm_clearance, "scene_library", lambda: None)
    slow = model.clearances(p, plate)
    np.testing.assert_allclose(fast.distances, slow.distances, atol=2e-8)
    np.testing.assert_allclose(least, slow.distances.min(axis=1), atol=5e-6)
    np.testing.assert_allclose(fast.gradients, slow.gradients, atol=1e-9)


def test_an_arm_that_swells_has_less_clearance():
    model = robot("neo-Hookean")
    p = np.full(6, 0.6e5)
    tube = {"points": [(0, 0, -0.05), (0, 0, 0.5)], "radius": 0.03}
    found = model.clearance(p, Scene(objects=[{"name": "tube", "inside_tube": tube}]))
    assert found == pytest.approx(0.03 - model.body_radius(p, 0.01), abs=1e-7)
    assert model.body_radius(p, 0.01) != pytest.approx(0.015, abs=1e-5)


@pytest.mark.parametrize("case", ["free", "hanging"])
@pytest.mark.parametrize("fast", [False, True])
def test_what_is_wrong_is_told(case, fast, request):
    if fast:
        request.getfixturevalue("machine_code")
    model = robot(case)
    assert (model._body.machine_code(10_000) is not None) == fast
    with pytest.raises(InputError, match="expected a Scene, as load_scene returns it"):
        model.clearance(np.zeros(6), "scene.yaml")  # type: ignore[arg-type]
    with pytest.raises(PressureError, match="expected pressures of shape"):
        model.clearance(np.zeros(5), scene())
    with pytest.raises(PressureError, match="finite"):
        model.clearances([0, 0, 0, 0, 0, np.nan], scene())
    with pytest.raises(PressureError, match="lower the pressure"):
        model.clearance(np.full((2, 6), 5e6), scene())
    assert model.clearance(np.zeros((0, 6)), scene()).shape == (0,)
    heavy = model.with_load((0.0, 0.0, -5.0))
    with pytest.raises(EquilibriumError):
        heavy.clearance(np.zeros((1, 6)), scene())
