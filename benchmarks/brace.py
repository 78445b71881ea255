"""Compare solutions of random tasks with a brace with a many-start reference.

    python benchmarks/brace.py --cases 50 --starts 200 --out out/brace

Random targets of a two-segment arm (`--robot`), bent by up to 60 degrees, with a post, ball or wall
beside the body where it bends, a contact force of at most 0.3 N, a margin of 20 mN and a random
direction of stiffness. Cases are stored in the folder, so that their reference is computed once.

The reference shares no code with the search: from random pressures at which the arm touches the
object, SciPy's SLSQP maximises the stiffness of the model's equilibria in contact. The target's
tolerance (a ball), forces and the margin are constraints; gradients are finite differences. Its
result counts only if the model confirms it from rest.

Metrics: the stiffness of the solution over that of the best one clear of the object, which must
be at least 1; and over the best of the reference.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

import stiffopt
from report import table
from stiffopt.errors import EquilibriumError

ROBOT = "stiff-flop-2"
MAX_FORCE, MARGIN, TOLERANCE = 0.3, 0.02, 1e-4
_STEP = 30.0  # Pa, of differences


def draw(seed: int, name: str = ROBOT, friction: float = 0.0) -> dict[str, Any]:
    """A random task of a robot, whose object is clear of the arm at rest."""
    rng = np.random.default_rng([22, seed])
    robot = stiffopt.load_robot(name)
    while True:
        p = rng.uniform(0, 1.5e5, 6) * (rng.random(6) < 0.8)
        T = robot.pose(p, np.linspace(0, robot.length, 61)[1:])
        tilt = np.degrees(np.arccos(T[-1, 2, 2]))
        if not 10 < tilt < 60:
            continue
        kind = rng.choice(["post", "ball", "wall"], p=[0.5, 0.2, 0.3])
        item = _object(rng, str(kind), T[round(rng.uniform(0.35, 0.9) * 60) - 1])
        item["contact"]["friction"] = friction
        scene = stiffopt.Scene(objects=[stiffopt.SceneObject(**item)])
        if robot.clearance(np.zeros(6), scene) > 1e-3:
            break
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    return {
        "seed": seed, "robot": name, "kind": str(kind), "tilt_deg": float(tilt), "object": item,
        "target": np.round(T[-1, :3, 3], 4).tolist(), "direction": direction.tolist(),
    }  # fmt: skip


def _object(rng: np.random.Generator, kind: str, pose: Any) -> dict[str, Any]:
    """One whose surface is up to 8 mm within, or 4 mm beside, the body of a free arm there."""
    angle, depth = rng.uniform(0, 2 * np.pi), rng.uniform(-0.004, 0.008)
    side = pose[:3, :3] @ [np.cos(angle), np.sin(angle), 0]
    radius = 0.015
    own = float(rng.uniform(0.003, 0.015))
    item: dict[str, Any] = {"name": "it", "contact": {"allowed": True, "max_force": MAX_FORCE}}
    if kind == "wall":
        point = pose[:3, 3] - side * (radius - depth)
        return item | {"half_space": {"point": point.tolist(), "normal": side.tolist()}}
    centre = pose[:3, 3] - side * (radius + own - depth)
    if kind == "ball":
        return item | {"sphere": {"centre": centre.tolist(), "radius": own}}
    across = np.cross(side, pose[:3, 2]) * 0.06
    ends = {"from": (centre - across).tolist(), "to": (centre + across).tolist()}
    return item | {"capsule": {**ends, "radius": own}}


def task_of(case: dict[str, Any]) -> stiffopt.Task:
    """The task of a case."""
    scene = stiffopt.Scene(objects=[stiffopt.SceneObject(**case["object"])])
    grip = "sticking" if case["object"]["contact"].get("friction") else "sliding"
    return stiffopt.Task(
        robot=case.get("robot", ROBOT),
        target=stiffopt.Target(position=case["target"], tolerance={"position": TOLERANCE}),
        stiffness={"maximise": {"direction": case["direction"]}},
        scene=scene,
        brace={"objects": ["it"], "margin": MARGIN, "contacts": grip},
    )


def answered(case: dict[str, Any]) -> dict[str, Any]:
    """What stiffopt answers."""
    task = task_of(case)
    robot = stiffopt.load_robot(task.robot)
    began = time.process_time()
    found = stiffopt.solve_pressure(robot, task)
    return {
        "status": found.status, "stiffness": found.stiffness, "free": found.stiffness_free,
        "contacts": [[each.object, each.at, float(np.linalg.norm(each.force))]
                     for each in found.contacts],
        "confidence": None if found.confidence is None else str(found.confidence),
        "seconds": time.process_time() - began, "message": found.message,
        "limited_by": list(found.limited_by),
        "pressures": None if found.pressures is None else found.pressures.tolist(),
    }  # fmt: skip


class Reference:
    """Random starts of SLSQP on the model's equilibria in contact.

    Of a task with a position and one direction to be stiff in, that leans on all it may touch.
    """

    def __init__(self, robot: stiffopt.Manipulator, task: stiffopt.Task) -> None:
        assert task.scene is not None
        assert task.stiffness is not None
        assert task.brace is not None
        self.robot, self.scene, self.margin = robot, task.scene, task.brace.margin
        self.target = np.array(task.target.position, dtype=float)
        self.tolerance = task.target.tolerance.position
        self.d = np.array(task.stiffness.maximise[0].direction)
        known = (item.contact for item in task.scene.objects if item.contact is not None)
        self.max_force = min(contact.max_force or np.inf for contact in known)
        kept_clear = [item for item in task.scene.objects if item.name not in task.brace.objects]
        self.others = task.scene.model_copy(update={"objects": tuple(kept_clear)})
        self._x: Any = None

    def best(self, starts: int, seed: int) -> dict[str, Any]:
        """The best end of so many starts, and how many ended within 5 % of it.

        Where none ends at something that holds, they are brought to the target first.
        """
        ends: list[float] = []
        for brought in (False, True):
            rng, touching = np.random.default_rng([23, seed]), 0
            for _ in range(starts):
                x = self._touching(rng)
                if x is None:
                    break
                touching += 1
                end = self._end(self._brought(x) if brought else x)
                if end is not None:
                    ends.append(end)
            if ends:
                break
        best = max(ends, default=None)
        agreeing = sum(end > 0.95 * best for end in ends) if best else 0
        return {"starts": touching, "ended": len(ends), "agreeing": agreeing, "best": best}

    def _touching(self, rng: np.random.Generator) -> Any:
        """Random pressures at which the arm touches the object."""
        for _ in range(400):
            x = rng.uniform(0, 1, 6)
            try:
                eq = self.robot.contact_equilibrium(1.5e5 * x, self.scene)
            except EquilibriumError:
                continue
            if eq.contacts:
                self._near = eq
                return x
        return None

    def _brought(self, x: Any) -> Any:
        """The pressures at the target that Newton's method comes to in contact, if it does."""
        self._x = None
        for _ in range(30):
            try:
                self._at(x)
            except EquilibriumError:
                return x
            off = self.target - self._tip
            if np.linalg.norm(off) < self.tolerance / 2:
                return x
            step = np.linalg.pinv(self._slope) @ off
            x = np.clip(x + step * min(1.0, 0.15 / float(np.abs(step).max())), 0, 1)
        return x

    def _end(self, x: Any) -> float | None:
        self._x = None
        ball = {"type": "ineq", "fun": lambda x: self._at(x)[1], "jac": lambda x: self._at(x)[3]}
        try:
            found = minimize(
                lambda x: self._at(x)[0], x, jac=lambda x: self._at(x)[2], bounds=[(0, 1)] * 6,
                constraints=[ball], method="SLSQP", options={"maxiter": 60, "ftol": 1e-6},
            )  # fmt: skip
            x = np.clip(found.x, 0, 1)
            eq = self.robot.contact_equilibrium(1.5e5 * x, self.scene)
        except (EquilibriumError, FloatingPointError, ValueError):
            return None
        off = np.linalg.norm(eq.tip_pose[:3, 3] - self.target)
        if not eq.contacts or off > 1.02 * self.tolerance or not eq.stable:
            return None
        if max(np.linalg.norm(each.force) for each in eq.contacts) > self.max_force * 1.001:
            return None
        if min(eq.lift_off(sign * self.d).force for sign in (1, -1)) < self.margin * 0.999:
            return None
        if not self._is_clear(eq):
            return None
        return eq.stiffness(self.d)

    def _is_clear(self, eq: Any) -> bool:
        """Whether the body keeps clear of spheres that it may not touch; of others nobody asks."""
        points, radius = eq.backbone(300), self.robot.description.segments[0].outer_radius
        for item in self.others.objects:
            ball = item.sphere
            gaps = np.linalg.norm(points - ball.centre, axis=1) - ball.radius - radius
            if gaps.min() < self.others.clearance - 2e-5:
                return False
        return True

    def _at(self, x: Any) -> Any:
        """Objective, constraints (>= 0) and their slopes; all of them by differences."""
        if self._x is None or not np.array_equal(x, self._x):
            self._x = np.array(x)
            try:
                eq = self.robot.contact_equilibrium(
                    1.5e5 * np.clip(x, 0, 1), self.scene, nearby=self._near
                )
            except EquilibriumError:
                eq = None
            if eq is None or not eq.contacts:  # a step of the line search too far
                _, constraints, *slopes = self._known
                self._known = (20.0, np.full(len(constraints), -1e4), *slopes)
                return self._known
            self._near = eq
            base = self._numbers(eq)
            sides = [self._numbers(eq.shifted(_STEP * row)) for row in np.eye(6)]
            slopes = [(np.array(side) - base) * 1.5e5 / _STEP for side in sides]
            J = np.stack(slopes, axis=1)
            tip, k, rest = base[:3], base[3], base[4:]
            self._tip, self._slope = tip, J[:3]
            off = (tip - self.target) / self.tolerance
            self._known = (
                -np.log(k),
                np.concatenate([[1 - off @ off], rest / 0.01]),
                -J[3] / k,
                np.vstack([-2 * off @ J[:3] / self.tolerance, J[4:] / 0.01]),
            )
        return self._known

    def _numbers(self, eq: Any) -> Any:
        forces = [eq.normal_forces.max()]
        pushed = [
            eq.shifted(push=sign * self.margin * self.d).normal_forces.min() for sign in (1, -1)
        ]
        rest = [self.max_force - forces[0], *pushed]
        return np.array([*eq.tip_pose[:3, 3], eq.stiffness(self.d), *rest])


def run(
    seeds: range, starts: int, folder: Path, name: str, friction: float
) -> Iterator[dict[str, Any]]:
    """All cases; the reference from the folder where it is there, the answer always anew."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        file = folder / f"{seed}.json"
        case = json.loads(file.read_text()) if file.exists() else draw(seed, name, friction)
        case["answer"] = answered(case)
        if starts and case.get("reference", {}).get("asked") != starts:
            reference = Reference(stiffopt.load_robot(name), task_of(case))
            case["reference"] = {"asked": starts, **reference.best(starts, seed)}
        file.write_text(json.dumps(case))
        yield case


def report(cases: list[dict[str, Any]]) -> str:
    """The tables of a run, as Markdown."""
    solved = [case for case in cases if case["answer"]["status"] == "solved"]
    both = [case for case in solved if case["answer"]["free"]]
    gains = np.array([case["answer"]["stiffness"] / case["answer"]["free"] for case in both])
    leant = sum(bool(case["answer"]["contacts"]) for case in solved)
    lines = [
        f"{len(cases)} tasks; {len(solved)} solved, {leant} of them by leaning; "
        f"{len(solved) - len(both)} cannot be had without.",
        "",
        f"Stiffness over that of the best answer that keeps clear, {len(both)} tasks:",
        "",
        *table(
            ["least", "10 %", "25 %", "median", "75 %", "90 %", "largest", "1 or more"],
            [[*(f"{np.quantile(gains, q):.2f}" for q in (0, 0.1, 0.25, 0.5, 0.75, 0.9, 1)),
              f"{(gains >= 1).sum()} of {len(gains)}"]],
        ),
        "",
    ]  # fmt: skip
    compared = [
        case
        for case in cases
        if case.get("reference", {}).get("best") and case["answer"]["stiffness"]
    ]
    if compared:
        ratios = np.array(
            [case["answer"]["stiffness"] / case["reference"]["best"] for case in compared]
        )
        starts = compared[0]["reference"]["asked"]
        lines += [
            f"Against the best of {starts} random starts, {len(compared)} tasks in which one ended "
            "at something that holds:",
            "",
            *table(
                ["least", "5 %", "median", "largest", "0.95 or more"],
                [[*(f"{np.quantile(ratios, q):.3f}" for q in (0, 0.05, 0.5, 1)),
                  f"{(ratios >= 0.95).sum()} of {len(ratios)}"]],
            ),
            "",
            *(
                f"- case {case['seed']} ({case['kind']}): {ratio:.3f} of the reference"
                for case, ratio in zip(compared, ratios, strict=True)
                if ratio < 0.95
            ),
        ]  # fmt: skip
    lines += [
        f"- case {case['seed']}: {case['answer']['status']}, {case['answer']['message']}"
        for case in cases
        if case not in solved
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run, and print the report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robot", default=ROBOT, help="one of two segments")
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--starts", type=int, default=200, help="of the reference; 0: none")
    parser.add_argument(
        "--friction", type=float, default=0.0,
        help="of the objects; above 0 contacts are to stick, which the reference ignores",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("out/brace"))
    parser.add_argument("--keep", type=Path, help="write the report here too")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    cases = []
    seeds = range(arguments.first, arguments.first + arguments.cases)
    chosen = arguments.starts, arguments.out, arguments.robot, arguments.friction
    for case in run(seeds, *chosen):
        cases.append(case)
        answer = case["answer"]
        print(
            case["seed"], case["kind"], answer["status"], answer["stiffness"], answer["free"],
            case.get("reference"), f"{answer['seconds']:.1f} s", answer["contacts"],
            answer["confidence"], answer["message"], flush=True,
        )  # fmt: skip
    text = report(cases)
    print(text)
    if arguments.keep:
        arguments.keep.write_text(text)


if __name__ == "__main__":
    main()
