"""A custom planner: the tip follows a line of 40 mm while the whole body passes a sphere.

    python examples/plan_past_a_sphere.py [FIGURE.png]

The planner uses two calls of stiffopt. `PressureSolver.warm` returns configurations for each of the
50 poses, the stiffest within boxes about those of the previous pose. `robot.clearance` decides
which of them, and which straight lines between them in the space of pressures, keep the body clear.
The shortest way through this layered graph, within the rates of the pressures, becomes a trajectory
of pressures. A simulated rig plays it. Its arm differs from the model, and the clearance is
measured on its true body.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from simulated_rig import SimulatedArm

import stiffopt
from stiffopt.model.scene import Scene
from stiffopt.plots.scene import draw_objects
from stiffopt.rig.config import load_rig_description

BAR, MM = 1e5, 1e-3
RIG = Path(__file__).resolve().parent.parent / "rig" / "sim-two-segment.yaml"
LINE = np.linspace((-0.02, -0.02, 0.188), (-0.02, 0.02, 0.188), 50)
SPHERE, RADIUS, CLEARANCE = (0.0117, -0.0385, 0.143), 0.006, 0.005
GUESSES, SEEDS = 6, 6  # for each pose at random, and of those of the pose before
BOX, ASIDE = 0.15 * BAR, 0.1 * BAR  # half the size of a box of pressures, and how far it is off
STEP, APPROACH = 0.1, 2.0  # s from pose to pose, and to the first one
BETWEEN = np.arange(1, 5)[:, None] / 5  # shares of a step at which it is checked


def configurations(
    solver: stiffopt.PressureSolver, robot: stiffopt.Manipulator, scene: Scene
) -> list[np.ndarray]:
    """Clear configurations (k, n) of each pose, in Pa."""
    rng, found, seeds = np.random.default_rng(1), [], []
    for position in LINE:
        guesses = [*seeds, *rng.uniform(robot.pressure_min, robot.pressure_max, (GUESSES, 6))]
        answers = [solver.warm(position, guess) for guess in guesses]
        for seed in seeds:
            middle = seed + rng.normal(0, ASIDE, len(seed))
            low = np.clip(middle - BOX, robot.pressure_min, robot.pressure_max - BOX)
            high = np.clip(middle + BOX, robot.pressure_min + BOX, robot.pressure_max)
            answers.append(solver.warm(position, np.clip(seed, low, high), limits=(low, high)))
        solved = np.array([each.pressures for each in answers if each.found])
        clear = solved[robot.clearance(solved, scene) >= scene.clearance]
        different: list[np.ndarray] = []
        for p in clear:
            if all(np.abs(p - other).max() > 0.01 * BAR for other in different):
                different.append(p)
        if not different:
            raise SystemExit(f"no clear configuration at {position / MM} mm")
        found.append(np.array(different))
        seeds = [different[k] for k in rng.permutation(len(different))[:SEEDS]]
    return found


def shortest(
    layers: list[np.ndarray], robot: stiffopt.Manipulator, scene: Scene, rates: np.ndarray
) -> np.ndarray:
    """The way (50, n) through the configurations that moves the pressures least."""
    costs, parents = np.zeros(len(layers[0])), []
    for before, after in pairwise(layers):
        steps = after[None] - before[:, None]  # (j, k, n)
        length = np.abs(steps).sum(axis=2)
        length[(np.abs(steps) > rates * STEP).any(axis=2)] = np.inf
        for j, k in np.argwhere(np.isfinite(length)):
            states = before[j] + BETWEEN * steps[j, k]
            if robot.clearance(states, scene).min() < scene.clearance:
                length[j, k] = np.inf
        totals = costs[:, None] + length
        parents.append(totals.argmin(axis=0))
        costs = totals.min(axis=0)
    index = int(costs.argmin())
    if not np.isfinite(costs[index]):
        raise SystemExit("no way leads from pose to pose")
    way = [layers[-1][index]]
    for layer, parent in zip(layers[-2::-1], parents[::-1], strict=True):
        index = parent[index]
        way.append(layer[index])
    return np.array(way[::-1])


def main(figure: str = "plan_past_a_sphere.png") -> None:
    """Plan, play, measure and draw."""
    ball = {"name": "sphere", "sphere": {"centre": SPHERE, "radius": RADIUS}}
    scene = Scene(clearance=CLEARANCE, objects=[ball])
    rig = load_rig_description(RIG).model_copy(update={"scene": scene})
    robot = stiffopt.load_robot(rig.robot)
    task = stiffopt.Task(
        robot=rig.robot,
        target={"position": tuple(LINE[0])},
        stiffness={"maximise": {"direction": (1, 0, 0)}},
    )
    solver = stiffopt.PressureSolver(robot, task)
    naive = [np.array(solver.solve().pressures)]
    for position in LINE[1:]:
        naive.append(solver.warm(position, naive[-1]).pressures)
    layers = configurations(solver, robot, scene)
    rates = 0.8 * np.array(robot.description.pressure_slew)
    way = shortest(layers, robot, scene, rates)
    print(f"warm starts alone: {report(robot, np.array(naive), scene)}")
    print(f"the way that is planned: {report(robot, way, scene)}")

    trajectory = stiffopt.Trajectory(
        waypoints=[
            stiffopt.Waypoint(
                time=APPROACH + STEP * index, target={"position": tuple(point)}, pressures=tuple(p)
            )
            for index, (point, p) in enumerate(zip(LINE.tolist(), way.tolist(), strict=True))
        ]
    )
    arm = SimulatedArm(rig)
    played = arm.play(trajectory)
    arm.close()
    true = clearance_of(played["bodies"], arm.radii.max())
    on_line = played["times"] - played["times"][0] > APPROACH + 1.0
    off = np.linalg.norm(played["tips"][on_line][:, None] - LINE[None], axis=2).min(axis=1)
    print(f"played, the true body keeps {true.min() / MM:.1f} mm from the sphere")
    print(f"the true tip is at most {off.max() / MM:.1f} mm from the poses of the line")
    print(f"the loop was {', '.join(sorted(set(played['states'])))}")
    draw(figure, scene, played, true)


def clearance_of(bodies: np.ndarray, radius: float) -> np.ndarray:
    """Distance (N,) of true bodies, by nodes (N, m, 3) of their centre lines, from the sphere."""
    away = np.linalg.norm(bodies - np.array(SPHERE), axis=2).min(axis=1)
    return away - radius - RADIUS


def report(robot: stiffopt.Manipulator, pressures: np.ndarray, scene: Scene) -> str:
    """Clearance and stiffness of configurations (k, n)."""
    stiffness = [robot.stiffness(p, direction=(1, 0, 0)) for p in pressures]
    clear = robot.clearance(pressures, scene).min()
    return f"{clear / MM:.1f} mm of clearance; at least {min(stiffness):.2f} N/m"


def draw(path: str, scene: Scene, played: dict[str, np.ndarray], true: np.ndarray) -> None:
    """Draw the arm on its way, and clearance and pressures over time."""
    figure = plt.figure(figsize=(11, 6))
    space = figure.add_subplot(1, 2, 1, projection="3d")
    for share in np.linspace(0.35, 1, 5):
        body = played["bodies"][int(share * (len(true) - 1))] / MM
        space.plot(*body.T, color=plt.cm.viridis(share), linewidth=5, alpha=0.6)
    space.plot(*(LINE / MM).T, color="black", linestyle="--", zorder=20)
    draw_objects(space, scene, 200.0, LINE / MM)
    space.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    space.set_aspect("equal")
    space.invert_zaxis()
    space.locator_params(axis="x", nbins=3)
    space.locator_params(axis="y", nbins=3)
    space.view_init(elev=20, azim=-125)
    space.set_title("arm on the line (dashed), from dark to light")
    space.set_position((0.02, 0.05, 0.36, 0.86))
    times = played["times"] - played["times"][0]
    near, pressure = figure.add_subplot(2, 2, 2), figure.add_subplot(2, 2, 4)
    near.plot(times, true / MM, label="true body")
    near.axhline(scene.clearance / MM, color="black", linestyle="--", label="asked")
    near.set(ylabel="clearance (mm)", ylim=(0, None))
    near.legend()
    pressure.plot(times, played["pressures"] / BAR)
    pressure.plot(times, played["plan"] / BAR, color="black", linewidth=0.7, linestyle=":")
    pressure.set(xlabel="time (s)", ylabel="pressure (bar); dotted: posture")
    figure.savefig(path, dpi=110)
    print(f"drawn in {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
