"""Plan a motion around a box, play it on a simulated rig, and draw the motion of its arm.

    python examples/plan_around_a_box.py [FIGURE.png]

`stiffopt.plan_motion` (extra ``plan``) finds pressures over time with the whole body clear of the
scene; the control loop checks the same way again before it accepts the trajectory.
"""

from __future__ import annotations

import sys
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
RIG = Path(__file__).resolve().parent.parent / "rig" / "sim.yaml"
CENTRE, SIZE, CLEARANCE = (-0.021, -0.036, 0.09), (0.02, 0.02, 0.05), 0.006
ONE_SIDE, OTHER_SIDE = np.array([1.2, 0.0, 0.0]) * BAR, np.array([0.0, 1.2, 0.0]) * BAR
RATE = 0.5 * BAR  # Pa/s, slower than the arm may be


def main(figure: str = "plan_around_a_box.png") -> None:
    """Plan, play, measure and draw."""
    box = {"name": "box", "box": {"centre": CENTRE, "size": SIZE}}
    scene = Scene(clearance=CLEARANCE, objects=[box])
    rig = load_rig_description(RIG).model_copy(update={"scene": scene})
    robot = stiffopt.load_robot(rig.robot)
    motions = [
        stiffopt.plan_motion(robot, start, goal, scene=scene, slew=RATE)
        for start, goal in ((np.zeros(3), ONE_SIDE), (ONE_SIDE, OTHER_SIDE))
    ]
    for motion in motions:
        print(motion)
    straight = ONE_SIDE + np.linspace(0, 1, 200)[:, None] * (OTHER_SIDE - ONE_SIDE)
    print(f"the straight way: {robot.clearance(straight, scene).min() / MM:.1f} mm clear")

    arm = SimulatedArm(rig)
    played = [arm.play(motion.trajectory()) for motion in motions]
    arm.close()
    true = np.concatenate([distances(each["bodies"], arm.radii.max()) for each in played])
    states = {state for each in played for state in each["states"]}
    print(f"played, the true body keeps {true.min() / MM:.1f} mm from the box")
    print(f"the loop was {', '.join(sorted(states))}")
    draw(figure, scene, played, true)


def distances(bodies: np.ndarray, radius: float) -> np.ndarray:
    """Distance (N,) of true bodies, by nodes (N, m, 3) of their centre lines, from the box."""
    beyond = np.abs(bodies - np.array(CENTRE)) - np.array(SIZE) / 2
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=2)
    return (outside + np.minimum(beyond.max(axis=2), 0)).min(axis=1) - radius


def draw(path: str, scene: Scene, played: list[dict[str, np.ndarray]], true: np.ndarray) -> None:
    """Draw the arm on its way around the box, and clearance and pressures over time."""
    figure = plt.figure(figsize=(11, 6))
    space = figure.add_subplot(1, 2, 1, projection="3d")
    bodies = played[1]["bodies"] / MM
    for share in np.linspace(0, 1, 6):
        body = bodies[int(share * (len(bodies) - 1))]
        space.plot(*body.T, color=plt.cm.viridis(share), linewidth=6, alpha=0.6)
    space.plot(*bodies[:, -1].T, color="black", linewidth=1, zorder=20)
    draw_objects(space, scene, 100.0, bodies[0])
    space.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    space.set_aspect("equal")
    space.view_init(elev=25, azim=60)
    space.set_title("arm around the box, from dark to light")
    times = np.concatenate([each["times"] for each in played])
    times -= times[0]
    near, pressure = figure.add_subplot(2, 2, 2), figure.add_subplot(2, 2, 4)
    near.plot(times, true / MM, label="true body")
    near.axhline(scene.clearance / MM, color="black", linestyle="--", label="asked")
    near.set(ylabel="clearance (mm)", ylim=(0, None))
    near.legend()
    for key, style in (("pressures", {}), ("plan", {"color": "black", "linestyle": ":"})):
        rows = np.concatenate([each[key] for each in played]) / BAR
        pressure.plot(times, rows, linewidth=1, **style)
    pressure.set(xlabel="time (s)", ylabel="pressure (bar); dotted: posture")
    figure.savefig(path, dpi=110)
    print(f"drawn in {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
