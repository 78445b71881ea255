"""Static shape under a tip load: PyElastica."""

import numpy as np

import tasks
from peers.base import PeerMissingError
from peers.elastica_rod import Elastica
from report import Comparison, Section, milliseconds, times
from settings import Settings
from timing import looped, median

TEXT = """\
The arm at rest with a dead sideways force at its tip that bends it by about a quarter of its
length. stiffopt solves the equilibrium (`loaded_tip_pose`); PyElastica relaxes a damped rod
from straight. *Time*: for PyElastica until the tip stays within 0.1 mm of where it ends, known
afterwards only, which favours it. *Disagreement*: distance of the tips, of which PyElastica's
part is mostly its grid; *extrapolated*: from its two finest grids, its error being of first
order. *Ratio* is taken on the coarsest grid that disagrees by less than 2 % of the deflection."""

FORCES = {1: 0.3, 2: 0.1}  # N
GRIDS = (10, 20, 40, 80)
NEAR = 0.02


def section(sizes: Settings) -> Section:
    """The table of statics."""
    out = Section(
        "Static shape under load",
        TEXT,
        ("segments", "solver", "time, ms", "ratio", "disagreement, mm", "of the deflection"),
    )
    for segments, force in FORCES.items():
        try:
            _table(out, segments, force, sizes)
        except PeerMissingError as error:
            out.skipped[Elastica.name] = str(error)
            break
    return out


def _table(out: Section, segments: int, force: float, sizes: Settings) -> None:
    robot = tasks.arm(segments)
    rest, wrench = np.zeros(robot.n_pressures), np.array([force, 0, 0, 0, 0, 0])
    peer = Elastica.of(segments)
    tip = robot.loaded_tip_pose(rest, wrench)[:3, 3]
    deflection = float(np.linalg.norm(tip - [0, 0, robot.length]))
    grids = GRIDS[:2] if sizes.quick else GRIDS
    rods = {grid: Elastica(segments, grid) for grid in grids}
    found = {grid: rods[grid].settle(wrench[:3], 1e-4) for grid in grids}

    def own() -> object:
        return robot.loaded_tip_pose(rest, wrench)

    seconds = median(looped({"stiffopt": own}, sizes.repetitions)["stiffopt"])
    out.rows.append((str(segments), "stiffopt", milliseconds(seconds), "1x", "-", "-"))
    chosen = None
    for grid in grids:
        miss = float(np.linalg.norm(found[grid].tip - tip))
        near = miss <= NEAR * deflection
        value = ""
        if near and chosen is None:
            chosen = grid
            pairs = []
            for _ in range(sizes.repetitions):
                relaxed = rods[grid].settle(wrench[:3], 1e-4).seconds
                pairs.append(relaxed / median(looped({"stiffopt": own}, 1)["stiffopt"]))
            relative = float(np.median(pairs))
            value = times(relative)
            arm = f"{segments} segment" + "s" * (segments > 1)
            remark = f"{grid} elements per segment, {1e2 * miss / deflection:.1f} % apart"
            out.comparisons.append(
                Comparison(f"static shape, {arm}", peer.name, relative, remark=remark)
            )
        out.rows.append(
            (
                str(segments), f"{peer.name}, {grid} elements per segment",
                milliseconds(found[grid].seconds), value, f"{1e3 * miss:.3f}",
                f"{1e2 * miss / deflection:.2f} %",
            )
        )  # fmt: skip
    best = 2 * found[grids[-1]].tip - found[grids[-2]].tip
    apart = float(np.linalg.norm(best - tip))
    out.rows.append(
        (
            str(segments), f"{peer.name}, extrapolated", "-", "",
            f"{1e3 * apart:.3f}", f"{1e2 * apart / deflection:.2f} %",
        )
    )  # fmt: skip
    out.data[str(segments)] = {
        "stiffopt_s": seconds,
        "deflection_m": deflection,
        "extrapolated_apart_m": apart,
        "grids": {
            str(grid): {
                "seconds": found[grid].seconds,
                "apart_m": float(np.linalg.norm(found[grid].tip - tip)),
                "drift_m": found[grid].drift,
            }
            for grid in grids
        },
    }
