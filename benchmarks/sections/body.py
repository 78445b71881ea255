"""Time poses of stations along the arm, single and in batches, free and hanging."""

from collections.abc import Callable
from time import process_time

import numpy as np

import settings as bars
import tasks
from report import Section, at_most
from settings import Settings
from stiffopt import Manipulator
from stiffopt.model.body import COMPILED_FREE_FROM
from stiffopt.model.compiled import compiling_at_once
from stiffopt.model.distances import scene_library
from stiffopt.model.scene import Scene

TEXT = """\
50 stations, equally spaced, of two segments at random pressures: whole calls from Python in
machine code, hot; CPU time of all cores, the least of many repetitions. Under gravity each
equilibrium is found from rest. A compliance is that between a station and the tip. The clearance
is the least distance of the whole body from three spheres, exact along the body."""

STATIONS = 50
CENTRES = ((-0.03, 0.0, 0.12), (0.035, 0.03, 0.13), (0.0, -0.035, 0.15))  # m, of spheres
ROWS = 1000
REPETITIONS = {False: 40, True: 8}  # by whether the arm is loaded


def section(sizes: Settings) -> Section:
    """The table of stations."""
    out = Section("Along the body", TEXT, ("arm", "work", "single, us", "batch, us per pose"))
    for name, robot in (("free", tasks.arm(2)), ("hanging", tasks.hanging_arm())):
        _table(out, name, robot, sizes)
    return out


def _table(out: Section, name: str, robot: Manipulator, sizes: Settings) -> None:
    rows = ROWS // 10 if sizes.quick else ROWS
    rng = np.random.default_rng(sizes.seed)
    P = robot.pressure_max * rng.random((rows, robot.n_pressures))
    at = np.linspace(0.0, robot.length, STATIONS)
    with compiling_at_once():
        robot.backbone(np.resize(P, (COMPILED_FREE_FROM, P.shape[1])), 2)
        scene_library()
    spheres = [{"centre": centre, "radius": 0.01} for centre in CENTRES]
    scene = Scene(objects=[{"name": f"{k}", "sphere": each} for k, each in enumerate(spheres)])
    works: dict[str, Callable[[np.ndarray], object]] = {
        "poses": lambda p: robot.backbone(p, STATIONS),
        "Jacobians": lambda p: robot.body_jacobian(p, at),
        "compliances": lambda p: robot.compliance_between(p, at, robot.length),
        "clearance": lambda p: robot.clearance(p, scene),
    }
    for work, call in works.items():
        repetitions = 2 if sizes.quick else REPETITIONS[robot.is_loaded]
        few = P[:20]
        single = _least(lambda c=call, q=few: [c(p) for p in q], repetitions) / len(few)
        batch = _least(lambda c=call, q=P[: rows // 5]: c(q), repetitions) / (rows // 5)
        if work in ("poses", "clearance"):
            batch = _least(lambda c=call: c(P), repetitions) / rows
        if work == "clearance" and not robot.is_loaded:
            what = "clearance of the free arm to three spheres in a batch"
            out.verdicts.append(at_most(what, bars.CLEARANCE_BATCH_US, batch * 1e6, "us"))
        if work == "poses":
            for where, value, limits in (
                ("in a single call", single, bars.BODY_SINGLE_US),
                ("in a batch", batch, bars.BODY_BATCH_US),
            ):
                what = f"{STATIONS} poses along the {name} arm {where}"
                out.verdicts.append(at_most(what, limits[name], value * 1e6, "us"))
        out.rows.append((name, work, f"{single * 1e6:.3g}", f"{batch * 1e6:.3g}"))
        out.data[f"{name} {work}"] = {"single": single, "batch": batch}


def _least(call: Callable[[], object], repetitions: int) -> float:
    """Least CPU time of a call in s."""
    call()
    taken = []
    for _ in range(repetitions):
        begin = process_time()
        call()
        taken.append(process_time() - begin)
    return min(taken)
