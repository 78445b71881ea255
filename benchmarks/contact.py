"""Compare equilibria of arms that lean on objects with independent rods.

    python benchmarks/contact.py --cases 100 --out out/contact

Random arms, with and without weight, at random pressures, half of them with a load, among one to
three spheres, capsules and walls that the free arm would enter by up to 20 mm. With `--strong`
objects are early on the arm's way from rest, and bend it far; with `--enclosed` the arms are in
tubes, or pass through rings. The rod is that of `pressed_rod.py`, which needs JAX and compiles for
a minute; a case takes some ten seconds. With `--lying` the weight presses arms on a wall, and with
`--bent` they are in tubes with a bend; the rod is that of `constrained_rod.py`. Cases are stored in
the folder and computed once. Where the two disagree, the rod is computed again with four times as
many steps from rest.

Metrics, each the largest over a case's objects or directions: the error of the tip, over the arm's
length; the error of the contact forces, over the largest force; the error of the tip's stiffness
along a random direction, or for every second arm on a wall along its normal, where the rod's
stiffness is extrapolated to no push from pairs of pushes of 1 and of 0.5 mN; contacts above 1 mN
that only one of the two has. If a push below 0.3 N loses a contact of more than 2 mN: whether the
independent rod still has the contact at 0.9 of that push and has lost it at 1.1.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import stiffopt
from independent.arms import ARMS, Arm
from report import table
from stiffopt.errors import EquilibriumError

_ELEMENTS = {"1 segment": 32, "2 segments": 16}
_BARS = {"tip": 0.5, "force": 5.0, "stiffness": 5.0, "contacts": 0.5}
_PUSH = 1e-3  # N; the rod's discrete springs blur smaller ones
_STEPS, _MORE_STEPS = 12, 48  # of the rod from rest, and where the two disagree
_KINDS = {
    "strong": "contacts that bend the arm far",
    "enclosed": "in tubes and through rings",
    "lying": "along a wall, under their weight",
    "bent": "in tubes with a bend",
}
_BY_CONSTRAINTS = ("lying", "bent")
_RIGID = 1e5  # N/m


def draw(seed: int, kind: str = "") -> dict[str, Any]:
    """A random case: arm, pressures, load and objects, clear of the arm at rest.

    If it is "enclosed", the arm is in a tube or passes through a ring instead. If it is "strong",
    objects are early on the arm's way, and pressures higher. See `_lying` and `_bent`.
    """
    if kind in _BY_CONSTRAINTS:
        return (_lying if kind == "lying" else _bent)(np.random.default_rng([21, seed]), seed)
    enclosed, strong = kind == "enclosed", kind == "strong"
    rng = np.random.default_rng([20, seed])
    name = ("2 segments", "1 segment", "2 segments")[seed % 3]
    hangs, count = bool(seed // 3 % 2), 1 + seed // 6 % 3
    arm = ARMS[name]
    if hangs:
        arm = arm.under((0, 0, 9.81), float(rng.uniform(0, 0.02)))
    robot = stiffopt.Manipulator(stiffopt.RobotDescription(**arm.mapping()))
    rest = robot.backbone(np.zeros(arm.n), 61)[:, :3, 3]
    while True:
        p = rng.uniform(0, 1.2e5, arm.n) * (rng.random(arm.n) < 0.8)
        force = rng.normal(size=3) * 0.04 * (rng.random() < 0.5)
        try:
            T = robot.with_load(force).backbone(p, 61)
        except EquilibriumError:
            continue
        if enclosed:
            around = _around(rng, arm.length, arm.tubes[0].outer_radius, in_tube=seed % 2 == 0)
            objects, clear = [around], True
            gap = robot.with_load(force).clearance(p, scene_of({"objects": objects}))
            if not (-0.05 if around[0] == 2 else -0.015) < gap < -0.001:
                continue
        else:
            early = None
            if strong:
                p, share = 1.25 * p, rng.uniform(0.1, 0.5)
                early = robot.with_load(share * force).backbone(share * p, 61)
                T = robot.with_load(force).backbone(p, 61)
            objects = [_object(rng, T, arm.tubes[0].outer_radius, early) for _ in range(count)]
            widest = arm.tubes[0].outer_radius + 0.001
            clear = all(_nearest(each, rest) > widest for each in objects)
        if clear and T[-1, 2, 2] > np.cos(2):
            break
    direction = rng.normal(size=3)
    return {
        "seed": seed, "arm": name, "gravity": list(arm.gravity), "tip_mass": arm.tip_mass,
        "pressures": p.tolist(), "force": force.tolist(), "objects": objects,
        "direction": (direction / np.linalg.norm(direction)).tolist(),
    }  # fmt: skip


def _object(
    rng: np.random.Generator, T: Any, radius: float, early: Any = None
) -> tuple[int, list[float]]:
    """One that presses the body at a random station from a random side, or stops it early."""
    row = round(rng.uniform(0.3, 1.0) * 60)
    angle, depth, own = (
        rng.uniform(0, 2 * np.pi),
        rng.uniform(0.001, 0.02),
        rng.uniform(0.003, 0.02),
    )
    pose = T[row]
    side = pose[:3, :3] @ [np.cos(angle), np.sin(angle), 0]
    if early is not None:
        side = 0.3 * side - (pose - early[row])[:3, 3] / np.linalg.norm((pose - early[row])[:3, 3])
        pose, depth = early[row], 0.0
        axis = pose[:3, 2]
        side = side - (axis @ side) * axis
        side /= np.linalg.norm(side)
    kind = rng.choice(["sphere", "capsule", "wall"], p=[0.25, 0.5, 0.25])
    if kind == "wall":
        return 1, [*(pose[:3, 3] - side * (radius - depth)), *side, 0.0]
    centre = pose[:3, 3] - side * (radius + own - depth)
    across = np.cross(side, rng.normal(size=3))
    across *= 0.0 if kind == "sphere" else 0.06 / np.linalg.norm(across)
    return 0, [*(centre - across), *(centre + across), own]


def _around(
    rng: np.random.Generator, length: float, radius: float, *, in_tube: bool
) -> tuple[int, list[float]]:
    """A bent tube about the straight arm, or a ring that it passes through."""
    own = radius + rng.uniform(0.0015, 0.006)
    if not in_tube:
        aside = rng.uniform(-0.3, 0.3, 2) * (own - radius)
        axis = [*rng.uniform(-0.1, 0.1, 2), 1.0]
        centre = [*aside, rng.uniform(0.4, 0.8) * length]
        return 3, [*centre, *(axis / np.linalg.norm(axis)), own]
    bend = rng.uniform(0.4, 0.8) * length
    beyond = (own - radius) * rng.uniform(-1, 1, 2)
    return 2, [0, 0, -0.03, 0, 0, bend, own, *(beyond * 1.2), 1.6 * length]


def _lying(rng: np.random.Generator, seed: int) -> dict[str, Any]:
    """An arm that its weight presses on a wall; half of the arms are under pressure."""
    angle, gap = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.01) * (rng.random() < 0.8)
    down = np.array([np.cos(angle), np.sin(angle), 0.0])
    gravity = rng.uniform(3, 9) * down + [0, 0, rng.uniform(-2, 4)]
    p = 10 ** rng.uniform(2, 4.9) * rng.random(6) * (rng.random(6) < 0.6) * (seed % 2)
    wall = [*((ARMS["2 segments"].tubes[0].outer_radius + gap) * down), *-down, 0.0]
    direction = -down if seed // 2 % 2 else rng.normal(size=3)
    return _case(seed, gravity, p, (1, wall), direction)


def _bent(rng: np.random.Generator, seed: int) -> dict[str, Any]:
    """An arm in a tube with a bend, clear of it at rest; every second one hangs."""
    arm, gravity = ARMS["2 segments"], np.array([0, 0, 9.81 * (seed % 2)])
    while True:
        p = rng.uniform(0, 1e5, 6) * (rng.random(6) < 0.7)
        wider = rng.uniform(0.002, 0.015)
        bend, side = np.radians(rng.uniform(3, 30)), rng.uniform(0, 2 * np.pi)
        first = max(0.05, arm.length - 0.95 * (wider - 5e-4) / np.tan(bend))
        if first > 0.95 * arm.length:
            continue
        height = rng.uniform(first, 0.95 * arm.length)
        way = [np.sin(bend) * np.cos(side), np.sin(bend) * np.sin(side), np.cos(bend)]
        end = np.array([0, 0, height]) + 0.2 * np.array(way)
        tube = [0, 0, -0.03, 0, 0, height, arm.tubes[0].outer_radius + wider, *end]
        case = _case(seed, gravity, p, (2, tube), rng.normal(size=3))
        robot = stiffopt.Manipulator(stiffopt.RobotDescription(**arm_of(case).mapping()))
        if robot.clearance(p, scene_of(case)) < -0.001:
            return case


def _case(
    seed: int, gravity: Any, p: Any, item: tuple[int, list[float]], direction: Any
) -> dict[str, Any]:
    return {
        "seed": seed, "arm": "2 segments", "gravity": list(gravity), "tip_mass": 0.0,
        "pressures": p.tolist(), "force": [0.0, 0.0, 0.0], "objects": [item],
        "direction": (direction / np.linalg.norm(direction)).tolist(),
    }  # fmt: skip


def _nearest(item: tuple[int, list[float]], points: Any) -> float:
    kind, numbers = item
    a, b, r = np.array(numbers[:3]), np.array(numbers[3:6]), numbers[6]
    if kind == 1:
        return float(((points - a) @ b).min())
    way = b - a
    share = np.clip((points - a) @ way / max(way @ way, 1e-12), 0, 1)
    return float(np.linalg.norm(points - a - share[:, None] * way, axis=1).min() - r)


def scene_of(case: dict[str, Any]) -> stiffopt.Scene:
    """The objects of a case as stiffopt takes them."""
    objects = []
    for index, (kind, numbers) in enumerate(case["objects"]):
        a, b, r = numbers[:3], numbers[3:6], numbers[6]
        shape: dict[str, Any] = {"capsule": {"from": a, "to": b, "radius": r}}
        if kind == 2:
            shape = {"inside_tube": {"points": [a, b, numbers[7:]], "radius": r}}
        elif kind == 3:
            shape = {"trocar": {"centre": a, "axis": b, "radius": r}}
        elif kind == 1:
            shape = {"half_space": {"point": a, "normal": b}}
        elif a == b:
            shape = {"sphere": {"centre": a, "radius": r}}
        objects.append({"name": f"{index}", "contact": {"allowed": True}, **shape})
    return stiffopt.Scene(objects=objects)


def arm_of(case: dict[str, Any]) -> Arm:
    """The arm of a case."""
    return ARMS[case["arm"]].under(case["gravity"], case["tip_mass"])


def found_by_stiffopt(case: dict[str, Any]) -> dict[str, Any]:
    """What the model says of a case."""
    robot = stiffopt.Manipulator(stiffopt.RobotDescription(**arm_of(case).mapping()))
    p, d = np.array(case["pressures"]), np.array(case["direction"])
    try:
        eq = robot.contact_equilibrium(p, scene_of(case), load=[*case["force"], 0, 0, 0])
    except EquilibriumError as error:
        return {"error": str(error)}
    forces = np.zeros(len(case["objects"]))
    for contact in eq.contacts:
        forces[int(contact.object)] += np.linalg.norm(contact.force)
    free = robot.with_load(case["force"]).tip_pose(p)[:3, :3]
    turn = np.arccos(np.clip((np.trace(free.T @ eq.tip_pose[:3, :3]) - 1) / 2, -1, 1))
    loss = eq.lift_off(d, limit=0.3)
    smallest = min((np.linalg.norm(each.force) for each in eq.contacts), default=0.0)
    known = loss.object is not None and len(eq.contacts) == np.count_nonzero(forces)
    if known:  # not where another contact on the same object is left
        after = np.array([*case["force"], 0, 0, 0]) + 1.05 * loss.force * np.r_[d, 0, 0, 0]
        try:
            left = robot.contact_equilibrium(p, scene_of(case), load=after, nearby=eq).contacts
            known = all(each.object != loss.object for each in left)
        except EquilibriumError:
            known = False
    return {
        "tip": eq.tip_pose[:3, 3].tolist(), "forces": forces.tolist(), "stable": bool(eq.stable),
        "stiffness": eq.stiffness(d), "turned_deg": float(np.degrees(turn)),
        "free_stiffness": robot.with_load(case["force"]).stiffness(p, d),
        "lost_at": loss.force if known and smallest > 2e-3 else None,
        "lost": int(loss.object) if known else None,
    }  # fmt: skip


def found_by_rod(
    case: dict[str, Any], lost_at: float | None, steps: int, kind: str
) -> dict[str, Any]:
    """What the independent rod says of it, after so many steps from rest."""
    if kind in _BY_CONSTRAINTS:
        from constrained_rod import pressed, pushed
    else:
        from pressed_rod import pressed, pushed  # type: ignore[assignment]

    n, objects, d = _ELEMENTS[case["arm"]], case["objects"], np.array(case["direction"])
    try:
        state = pressed(arm_of(case), case["pressures"], objects, case["force"], n, steps)
        secants = []
        for push in (_PUSH, _PUSH / 2):
            ends = [pushed(state, objects, sign * push * d).tip for sign in (1, -1)]
            secants.append(float(2 * push / ((ends[0] - ends[1]) @ d)))
        around = []
        if lost_at is not None and lost_at < 0.3:
            first = pushed(state, objects, 0.9 * lost_at * d, steps=4)
            second = pushed(first, objects, 0.2 * lost_at * d, steps=2)
            around = [each.forces.tolist() for each in (first, second)]
    except ArithmeticError as error:
        return {"error": str(error)}
    return {
        "tip": state.tip.tolist(), "forces": state.forces.tolist(), "at": state.at.tolist(),
        "stiffness": (4 * secants[1] - secants[0]) / 3, "around": around,
    }  # fmt: skip


def run(seeds: range, folder: Path, kind: str = "") -> Iterator[dict[str, Any]]:
    """All cases, from the folder where they are there; the model's part always anew."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        file = folder / f"{seed}.json"
        case = json.loads(file.read_text()) if file.exists() else draw(seed, kind)
        case["stiffopt"] = found_by_stiffopt(case)
        if "rod" not in case:
            case["rod"] = found_by_rod(case, case["stiffopt"].get("lost_at"), _STEPS, kind)
        if not is_within(case) and "first rod" not in case:
            case["first rod"] = case["rod"]
            case["rod"] = found_by_rod(case, case["stiffopt"].get("lost_at"), _MORE_STEPS, kind)
        file.write_text(json.dumps(case))
        yield case


def is_within(case: dict[str, Any]) -> bool:
    """Whether both find the case's equilibrium, and agree."""
    if "error" in case["stiffopt"] or "error" in case["rod"]:
        return "error" in case["stiffopt"] and "error" in case["rod"]
    return all(value <= _BARS[key] for key, value in measured(case).items())


def measured(case: dict[str, Any]) -> dict[str, float]:
    """Errors of a case, in percent but for contacts that one of the two lacks."""
    own, other = case["stiffopt"], case["rod"]
    forces, expected = np.array(own["forces"]), np.array(other["forces"])
    length = arm_of(case).length
    stiffness = 100 * abs(own["stiffness"] / other["stiffness"] - 1)
    if own["stiffness"] > _RIGID:  # a surface holds the tip
        stiffness = 0.0 if abs(other["stiffness"]) > _RIGID else 100.0
    return {
        "tip": 100 * float(np.linalg.norm(np.subtract(own["tip"], other["tip"]))) / length,
        "force": 100 * float(np.abs(forces - expected).max() / max(expected.max(), 1e-3)),
        "stiffness": stiffness,
        "contacts": float(((forces > 1e-3) & (expected < 1e-5)).sum()
                          + ((expected > 1e-3) & (forces < 1e-5)).sum()),
    }  # fmt: skip


def report(cases: list[dict[str, Any]]) -> str:
    """The tables of a run, as Markdown."""
    failed = [case for case in cases if "error" in case["stiffopt"] or "error" in case["rod"]]
    good = [case for case in cases if case not in failed]
    units = {"tip": "% of length", "force": "%", "stiffness": "%", "contacts": "false or missed"}
    errors = [measured(case) for case in good]
    rows = []
    for key, bar in _BARS.items():
        values = np.array([each[key] for each in errors])
        within = f"{(values <= bar).sum()} of {len(values)}"
        cells = (f"{np.median(values):.3g}", f"{np.quantile(values, 0.95):.3g}")
        rows.append([key, units[key], *cells, f"{values.max():.3g}", within])
    turned = np.array([case["stiffopt"]["turned_deg"] for case in good])
    gains = np.array(
        [case["stiffopt"]["stiffness"] / case["stiffopt"]["free_stiffness"] for case in good]
    )
    gains = gains[np.isfinite(gains)] if np.isfinite(gains).any() else np.ones(1)
    around = [
        case for case in good if case["rod"]["around"] and case["stiffopt"]["lost"] is not None
    ]
    held = sum(case["rod"]["around"][0][case["stiffopt"]["lost"]] > 1e-5 for case in around)
    gone = sum(case["rod"]["around"][1][case["stiffopt"]["lost"]] < 1e-4 for case in around)
    again = sum("first rod" in case for case in cases)
    lines = [
        f"{len(good)} cases, {again} of them with more steps; the tip turned by the contacts by "
        f"{np.median(turned):.0f} degrees in the median, by {turned.max():.0f} at most; stiffness "
        f"{np.median(gains):.2f} times that of the free arm in the median, {gains.max():.1f} at "
        "most.",
        "",
        *table(["what", "unit", "median", "95 %", "largest", "within the bar"], rows),
        "",
        f"Lift-off: of {len(around)} losses, {held} contacts are there at 0.9 of the push and "
        f"{gone} are gone at 1.1.",
        "",
    ]
    for case in failed:
        reason = case["stiffopt"].get("error") or case["rod"]["error"]
        lines.append(f"- case {case['seed']}: {reason}")
    worse = [
        (case["seed"], key, each[key])
        for case, each in zip(good, errors, strict=True)
        for key, bar in _BARS.items()
        if each[key] > bar
    ]
    lines += [f"- case {seed}: {key} {value:.3g} {units[key]}" for seed, key, value in worse]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run, and print the report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    kinds = parser.add_mutually_exclusive_group()
    for name, text in _KINDS.items():
        kinds.add_argument(
            f"--{name}", action="store_const", const=name, dest="kind", default="", help=text
        )
    parser.add_argument("--out", type=Path, default=Path("out/contact"))
    parser.add_argument("--keep", type=Path, help="write the report here too")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    cases = []
    seeds = range(arguments.first, arguments.first + arguments.cases)
    for case in run(seeds, arguments.out, arguments.kind):
        cases.append(case)
        error = case["stiffopt"].get("error") or case["rod"].get("error")
        print(case["seed"], error or measured(case), flush=True)
    text = report(cases)
    print(text)
    if arguments.keep:
        arguments.keep.write_text(text)


if __name__ == "__main__":
    main()
