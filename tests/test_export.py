"""Exported arms: MuJoCo, which shares no code with the model, finds the same tip and stiffness."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import stiffopt
from stiffopt.cli.main import main
from stiffopt.errors import InputError
from stiffopt.model.robot_files import load_description

BAR = 1e5
ROBOTS = ("stiff-flop-1", "stiff-flop-2-hanging", "ucl-2x55-calibrated", "bent")


def robot_named(name: str) -> stiffopt.Manipulator:
    """A built-in robot, or one whose axes are coupled: an odd chamber, and bends that stiffen."""
    if name != "bent":
        return stiffopt.load_robot(name)
    data = load_description("stiff-flop-2").model_dump(by_alias=True)
    for segment in data["segments"]:
        segment["compensation"]["bending_radius"] = 0.03
        segment["chambers"]["angles"] = [*segment["chambers"]["angles"][:5], 4.5]
    return stiffopt.Manipulator(stiffopt.RobotDescription.model_validate(data))


class Simulated:
    """A model in MuJoCo at rest: where all springs, weights and a push at the tip balance."""

    def __init__(self, text: str) -> None:
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.tip = self.model.site("tip").id

    def settle(self, force: np.ndarray | None = None) -> np.ndarray:
        """Return the tip (3,) with a force on it, by Newton's method on MuJoCo's forces."""
        d, step = self.data, 1e-7
        for _ in range(15):
            residual = self._unbalanced(force)
            slopes = np.empty((self.model.nv, self.model.nv))
            for k in range(self.model.nv):
                kept = d.qpos[k]
                d.qpos[k] = kept + step
                slopes[:, k] = (self._unbalanced(force) - residual) / step
                d.qpos[k] = kept
            change = -np.linalg.solve(slopes, residual)
            largest = np.abs(change).max()
            if largest < 1e-8:
                break
            d.qpos += change * min(1, 0.2 / largest)
        self._unbalanced(force)
        return np.array(d.site_xpos[self.tip])

    def _unbalanced(self, force: np.ndarray | None) -> np.ndarray:
        m, d = self.model, self.data
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        total = d.qfrc_passive - d.qfrc_bias
        if force is not None:
            push = np.zeros(m.nv)
            at, body = d.site_xpos[self.tip], m.site_bodyid[self.tip]
            mujoco.mj_applyFT(m, d, force, np.zeros(3), at, body, push)
            total = total + push
        return np.asarray(total)


@pytest.mark.parametrize("name", ROBOTS)
def test_mujoco_finds_the_tip_and_the_stiffness(name: str, request: pytest.FixtureRequest) -> None:
    robot, rng = robot_named(name), np.random.default_rng(23)
    agrees(robot, rng.uniform(robot.pressure_min, robot.pressure_max), rng)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(50))
def test_mujoco_finds_the_tip_and_the_stiffness_of_many(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = sorted({*stiffopt.builtin_robots(), "bent"})
    robot = robot_named(names[seed % len(names)])
    agrees(robot, rng.uniform(robot.pressure_min, robot.pressure_max), rng)


def agrees(robot: stiffopt.Manipulator, p: np.ndarray, rng: np.random.Generator) -> None:
    simulated = Simulated(stiffopt.mjcf(robot, p))
    rest = simulated.settle()
    tip = robot.tip_pose(p)
    np.testing.assert_allclose(rest, tip[:3, 3], atol=2e-3 * robot.length)
    turn = simulated.data.site_xmat[simulated.tip].reshape(3, 3)
    np.testing.assert_allclose(turn, tip[:3, :3], atol=0.02)
    for direction in (np.array([0.0, 0.0, 1.0]), *rng.normal(size=(2, 3))):
        u = direction / np.linalg.norm(direction)
        stiffness = robot.stiffness(p, u)
        push = 2e-5 * stiffness * u  # that moves the tip by 20 um
        moved = simulated.settle(push) - simulated.settle(-push)
        assert u @ moved == pytest.approx(4e-5, rel=0.03)


def test_axes_that_are_coupled_become_tendons() -> None:
    robot = robot_named("bent")
    assert mujoco.MjModel.from_xml_string(stiffopt.mjcf(robot, [0.0] * 6)).ntendon == 24 * 6
    straight = stiffopt.load_robot("stiff-flop-2")
    assert mujoco.MjModel.from_xml_string(stiffopt.mjcf(straight, [BAR] * 6)).ntendon == 0


def test_the_simulation_swings_and_comes_to_rest() -> None:
    robot, p = stiffopt.load_robot("stiff-flop-1"), np.array([0.5, 0, 0.2]) * BAR
    simulated = Simulated(stiffopt.mjcf(robot, p, pieces=8, damping=0.2))
    m, d = simulated.model, simulated.data
    mujoco.mj_forward(m, d)
    rest = np.array(d.site_xpos[simulated.tip])
    d.qpos[m.jnt_type == mujoco.mjtJoint.mjJNT_HINGE] = 0.03  # bent
    swings = []
    for _ in range(int(1.5 / m.opt.timestep)):
        mujoco.mj_step(m, d)
        swings.append(float(np.linalg.norm(d.site_xpos[simulated.tip] - rest)))
    assert max(swings) > 0.01
    assert max(swings[-20:]) < 1e-4


def test_masses_are_those_of_the_robot() -> None:
    robot = stiffopt.load_robot("stiff-flop-2-hanging")
    model = mujoco.MjModel.from_xml_string(stiffopt.mjcf(robot, [0.0] * 6))
    area = np.pi * (0.015**2 - 0.0045**2 - 6 * 0.00225**2)
    assert model.body_mass.sum() == pytest.approx(1070 * area * 0.18 + 0.02, rel=1e-6)
    np.testing.assert_allclose(model.opt.gravity, [0, 0, 9.81])


def test_the_mesh_is_the_body() -> None:
    robot = stiffopt.load_robot("stiff-flop-2")
    p = np.array([0.6, 0, 0.2, 0, 0, 0.4]) * BAR
    mesh = stiffopt.surface_mesh(robot, p)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    # a body and the ball that its clearance is measured to
    for centre in ([0.06, 0, 0.1], [-0.05, 0.02, 0.2], [0, 0.04, 0.02]):
        ball = stiffopt.SceneObject(name="ball", sphere={"centre": centre, "radius": 0.005})
        gap = robot.clearance(p, stiffopt.Scene(objects=[ball]))
        nearest = np.linalg.norm(mesh.vertices - centre, axis=1).min() - 0.005
        assert nearest == pytest.approx(gap, abs=1.0e-3)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
def test_mesh_files_are_read_back(ending: str, tmp_path: Path) -> None:
    import trimesh

    path = tmp_path / f"arm.{ending}"
    assert (
        main(["export", "mesh", "stiff-flop-1", "--pressures", "0.5, 0, 0 bar", "--out", str(path)])
        == 0
    )
    robot = stiffopt.load_robot("stiff-flop-1")
    whole = stiffopt.surface_mesh(robot, [0.5 * BAR, 0, 0])
    assert trimesh.load_mesh(path).volume == pytest.approx(whole.volume, rel=1e-4)


def test_the_command_writes_or_prints_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = ["export", "mjcf", "stiff-flop-1", "--pressures", "0.5, 0, 0 bar", "--pieces", "4"]
    assert main(wanted) == 0
    printed = capsys.readouterr().out
    assert main([*wanted, "--out", str(tmp_path / "arm.xml")]) == 0
    assert (tmp_path / "arm.xml").read_text() == printed
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml")).nv == 24


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--pressures", "9, 0, 0 bar"], "lower the pressure"),
        (["--pressures", "0.5, 0 bar"], "shape (3,)"),
        (["--pressures", "0.5, 0, 0 mm"], "pressure"),
        (["--pressures", "0, 0, 0 bar", "--pieces", "1"], "2 to 100 pieces"),
        (["--pressures", "0, 0, 0 bar", "--damping", "0"], "damping"),
        (["--pressures", "0, 0, 0 bar", "--out", "arm.urdf"], ".xml"),
    ],
)
def test_bad_input_is_refused(
    more: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "mjcf", "stiff-flop-1", *more]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_one_configuration_at_a_time() -> None:
    robot = stiffopt.load_robot("stiff-flop-1")
    for export in (stiffopt.mjcf, stiffopt.surface_mesh):
        with pytest.raises(InputError, match="one set of pressures"):
            export(robot, np.zeros((2, 3)))
    with pytest.raises(InputError, match="spacing"):
        stiffopt.surface_mesh(robot, np.zeros(3), spacing=1.0)
