"""Compare the pushes at which contacts slip with an independent rod (`slipping_rod.py`).

    python benchmarks/slips.py --first 7000 --cases 30 --out out/slips

Scenes are those of `contact.py`, with a random coefficient of friction between 0.1 and 0.5. In
each, both ways along the random direction, the push at the tip at which the first contact slips or
lifts off, if it is between 1 mN and 0.3 N. At first contacts carry no tangential force. The rod's
pushes grow in steps, during which the body rolls on the surfaces. Scenes in which two contacts are
on one object do not count. Pairs are stored in the folder, the rod's part is computed once.
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import stiffopt
from contact import _ELEMENTS, arm_of, draw, scene_of
from report import table
from stiffopt.errors import EquilibriumError

_LEAST, _MOST = 1e-3, 0.3  # N
_ELSEWHERE = 5e-4  # m between the tips of both; then the rod is in another equilibrium
_BAR = 10.0  # %


def draw_rough(seed: int, *, strong: bool) -> dict[str, Any]:
    """A case of `contact.py` with a coefficient of friction."""
    friction = float(np.random.default_rng([21, seed]).uniform(0.1, 0.5))
    return draw(seed, "strong" if strong else "") | {"friction": friction}


def found_by_stiffopt(case: dict[str, Any]) -> dict[str, Any] | None:
    """The losses that the model foretells along and against the direction; None if none counts."""
    robot = stiffopt.Manipulator(stiffopt.RobotDescription(**arm_of(case).mapping()))
    objects = [
        item.model_copy(
            update={"contact": item.contact.model_copy(update={"friction": case["friction"]})}
        )
        for item in scene_of(case).objects
        if item.contact is not None
    ]
    scene = stiffopt.Scene(objects=objects)
    try:
        eq = robot.contact_equilibrium(case["pressures"], scene, load=[*case["force"], 0, 0, 0])
    except EquilibriumError:
        return None
    if len({each.object for each in eq.contacts}) < len(eq.contacts):
        return None
    losses = {}
    for sign in (1, -1):
        loss = eq.lift_off(sign * np.array(case["direction"]), limit=_MOST, contacts="sticking")
        if loss.object is not None and loss.force > _LEAST:
            losses[f"{sign}"] = {"push": loss.force, "object": int(loss.object), "how": loss.how}
    return {"tip": eq.tip_pose[:3, 3].tolist(), "losses": losses} if losses else None


def found_by_rod(case: dict[str, Any]) -> dict[str, Any]:
    """The same by the rod, in the ways that the model foretells a loss; and its tip."""
    from pressed_rod import pressed
    from slipping_rod import slip

    n, objects, d = _ELEMENTS[case["arm"]], case["objects"], np.array(case["direction"])
    try:
        state = pressed(arm_of(case), case["pressures"], objects, case["force"], n)
        slips = {
            sign: slip(state, objects, int(sign) * d, case["friction"], 1.5 * _MOST)._asdict()
            for sign in case["stiffopt"]["losses"]
        }
    except ArithmeticError as error:
        return {"error": str(error)}
    return {"tip": state.tip.tolist(), "slips": slips}


def pairs_of(case: dict[str, Any]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Losses of the model, each with that of the rod; none if the rod is elsewhere."""
    rod = case["rod"]
    if "error" in rod:
        return []
    if np.linalg.norm(np.subtract(rod["tip"], case["stiffopt"]["tip"])) > _ELSEWHERE:
        return []
    losses = case["stiffopt"]["losses"]
    return [(losses[sign], rod["slips"][sign]) for sign in losses if sign in rod["slips"]]


def main() -> None:
    """Run, and print the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--strong", action="store_true", help="contacts that bend the arm far")
    parser.add_argument("--out", type=Path, default=Path("out/slips"))
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    given.out.mkdir(parents=True, exist_ok=True)
    errors, scenes, worse = [], 0, []
    for seed in range(given.first, given.first + given.cases):
        file = given.out / f"{seed}.json"
        case = (
            json.loads(file.read_text()) if file.exists() else draw_rough(seed, strong=given.strong)
        )
        case["stiffopt"] = found_by_stiffopt(case)
        if case["stiffopt"] is None:
            continue
        if "rod" not in case:
            case["rod"] = found_by_rod(case)
        file.write_text(json.dumps(case))
        pairs = pairs_of(case)
        scenes += bool(pairs)
        for own, other in pairs:
            errors.append(100 * abs(own["push"] / other["push"] - 1))
            print(seed, own, other, f"{errors[-1]:.1f} %", flush=True)
            if errors[-1] > _BAR or own["object"] != other["object"]:
                worse.append(f"- case {seed}: {own}, the rod {other}")
    cells = [f"{np.quantile(errors, q):.3g}" for q in (0.5, 0.95, 1)]
    within = f"{sum(each <= _BAR for each in errors)} of {len(errors)}"
    print(f"{scenes} scenes, {len(errors)} pushes.\n")
    print("\n".join(table(["median, %", "95 %", "largest", "within 10 %"], [[*cells, within]])))
    print("\n".join(["", *worse]))


if __name__ == "__main__":
    main()
