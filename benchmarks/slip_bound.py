"""How small a slide of a braced arm can be told at all, by a test that knows the simulated arm.

    python benchmarks/slip_bound.py --arms 1 2 --keep out/calibrated --out out/slip_bound.json

The poses are those of `brace_hold.py --slips`, held by the loop for 20 s. From there copies of the
plant are pushed at the tip as in `brace_hold.py`, once with its friction, and once so that nothing
slides. Let D(t) (6,) be the difference of the tip's position and turn. The tracker shows D with
noise (0.05 mm and 1 mrad in each of 40 samples a second). What nobody knows of an arm that sticks:

- the push, with three components, at every sample anew (deviation 0.1 N): it moves the tip by
  C(t) F, with the plant's own response C (6, 3);
- where the tip was before the push, but for the noise of 5 s;
- how much it creeps, and its hysteresis: the effect of each branch of the silicone has a deviation
  of 30 %, of course known but for this share;
- the length of the arm and so the tangential force at which the contact begins to slide: nothing of
  it is used.

With the covariance S of all that, the best test for a slide of this course has the statistic
``D' S^-1 y / sqrt(D' S^-1 D)`` on the samples y up to a time (Neyman and Pearson). It is normal
with variance 1; its mean is 0 for an arm that sticks and ``d = sqrt(D' S^-1 D)`` for one that
slides. A slide is told when d exceeds 5: at a threshold of 3.7, which is exceeded by chance once in
10,000 looks, nine in ten are told. `--model` adds what a loop does not know of an arm: each
component of the tip's response to the push by so many per cent; `--creep` sets the 30 %.

Metrics: the slide that is told within 0.3 s (that of 0.3 s before it is told, latency included), by
position and turn and by the position alone; the same delays as in `brace_hold.py`; how far the body
slides in 20 s in which nothing pushes; and, of drawn noise, pushes, shares and creep, the share of
courses that are told at that time (expected: 0.9), and of arms that stick for which a slide is
reported at any time. A push under which a copy of the plant cannot be simulated is left out, and
said: contacts that cannot slide, or silicone without a branch of its hysteresis, can be too stiff.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from brace_hold import LONGEST, SLIDES, WITHIN, Held, Slide, leant
from control_cases import believed_file, draw_case
from report import table
from stiffopt import lie
from stiffopt.plant.plant import SimulationError
from stiffopt.plant.settings import PlantLoad

Array = NDArray[np.float64]

SAMPLES, STEP = 100, 0.02  # of a course, and the longest step of the plant, in s
NOISE = np.repeat([5e-5, 1e-3], 3)  # of a sample of the tracker, in m and rad
RATE, LATENCY, BEFORE = 40.0, 0.025, 5.0  # 1/s, s, s
PUSH, NUDGE = 0.1, 2e-3  # N, deviation of pushes and step of the response
TOLD, THRESHOLD = 5.0, 3.7
ENDS = 7e-4  # m, slide at which a course ends
STUCK = 50.0  # coefficient of friction at which nothing slides
SETTLED = 4  # first samples that are left out, in which the arm swings
DRAWS = 1000


class Pushed:
    """Copies of a plant (n pressures) that are pushed along a unit vector (3,)."""

    def __init__(self, held: Held) -> None:
        plant = held.loop.rig.world.plant
        self.plant = copy.deepcopy(plant)
        self.plant.settings = plant.settings.model_copy(update={"dynamics": "quasi-static"})
        self.pressures = held.loop.rig.supply.read().pressures
        self.normal, self.way = held.found.contacts[0].normal, np.array(held.first.direction)

    def stuck(self) -> Any:
        """A copy whose contacts do not slide."""
        plant = copy.deepcopy(self.plant)
        around = plant._around
        plant._around = around._replace(friction=np.full_like(around.friction, STUCK))
        return plant

    def without(self, plant: Any) -> list[Any]:
        """Copies in which one branch of creep, or one element of hysteresis, does not go on."""
        found = []
        for name in ("creep_time", "slip_strain"):
            values = getattr(plant._material, name)
            for k in range(len(values)):
                found.append(copy.deepcopy(plant))
                halted = np.where(np.arange(len(values)) == k, 1e6 * values, values)
                found[-1]._material = plant._material._replace(**{name: halted})
        return found

    def course(
        self, plant: Any, push: Callable[[float], Array], duration: float
    ) -> tuple[Array, Array]:
        """Place and turn (T, 6) of the tip against the beginning, and slides (T,) in m."""
        plant = copy.deepcopy(plant)
        ticks = max(3, math.ceil(duration / SAMPLES / STEP))  # between samples
        step = duration / SAMPLES / ticks
        settings = plant.settings
        steps = settings.discretisation.model_copy(update={"step": step})
        plant.settings = settings.model_copy(update={"discretisation": steps})
        first, slide = plant.tip_pose(), Slide(plant, self.normal)
        slide.update(plant)
        tips, slides = [], []
        for k in range(1, SAMPLES * ticks + 1):
            plant._load = PlantLoad(force=tuple(push(k * step)))  # `set_load` would be slow
            plant.follow(self.pressures[None])
            if k % ticks == 0:
                slides.append(slide.update(plant))
                T = plant.tip_pose()
                turn = lie.quaternion_from_rotation(T[:3, :3] @ first[:3, :3].T)
                tips.append([*(T - first)[:3, 3], *lie.rotation_vector_from_quaternion(turn)])
        return np.array(tips), np.array(slides)


class Test:
    """The best test for a slide whose effect D (T, 6) is known, at samples dt s apart.

    `unknown` (m, T, 6) are effects with random factors of variance 1, and `response` (T, 6, 3) that
    of a push. Of each sample, `seen` (6,) says what is used.
    """

    def __init__(self, D: Array, response: Array, unknown: Array, dt: float, seen: Array) -> None:
        self._noise = NOISE / np.sqrt(RATE * dt)
        self._response, self._start = response, NOISE / np.sqrt(RATE * BEFORE)
        self._unknown = unknown
        S = np.diag(self._noise**2) + PUSH**2 * response @ np.swapaxes(response, 1, 2)
        hidden = ~seen.astype(bool)
        S[:, hidden] = S[:, :, hidden] = 0.0
        S[:, hidden, hidden] = 1.0
        inverse = np.linalg.inv(S) * np.outer(seen, seen)
        inverse[:SETTLED] = 0.0
        self.D, self._inverse = D, inverse
        start = np.broadcast_to(np.diag(self._start), (len(D), 6, 6))
        self._U = np.concatenate([start, np.moveaxis(unknown, 0, 2)], axis=2)  # (T, 6, 6 + m)
        weighted = np.swapaxes(self._U, 1, 2) @ inverse
        self._weighted = weighted
        size = self._U.shape[2]
        self._all = np.linalg.inv(np.eye(size) + np.cumsum(weighted @ self._U, axis=0))
        self._known = self._parts(D)

    def _parts(self, y: Array) -> Array:
        return np.cumsum(np.einsum("tpi,...ti->...tp", self._weighted, y), axis=-2)

    def statistic(self, y: Array) -> Array:
        """``D' S^-1 y`` of samples y (..., T, 6) up to each time (..., T)."""
        whole = np.cumsum(np.einsum("ti,tij,...tj->...t", self.D, self._inverse, y), axis=-1)
        left = np.einsum("tp,tpq,...tq->...t", self._known, self._all, self._parts(y))
        found: Array = whole - left
        return found

    @property
    def distance(self) -> Array:
        """The mean d (T,) for an arm that slides, from the samples up to each time."""
        return np.sqrt(np.maximum(self.statistic(self.D), 0.0))

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """What an arm that sticks may show (count, T, 6), drawn without the covariance."""
        T, m = len(self.D), len(self._unknown)
        y = self._noise * rng.standard_normal((count, T, 6))
        y += self._start * rng.standard_normal((count, 1, 6))
        y += np.einsum("tik,ntk->nti", self._response, PUSH * rng.standard_normal((count, T, 3)))
        y += np.einsum("nm,mti->nti", rng.standard_normal((count, m)), self._unknown)
        return y


def bound(
    pushed: Pushed, rate: float, duration: float, model: float, share: float
) -> dict[str, Any]:
    """What can be told of a push that grows by so many N in a second."""
    way, stuck = pushed.way, pushed.stuck()

    def push(time: float) -> Array:
        grown: Array = rate * time * way
        return grown

    tips, slid = pushed.course(pushed.plant, push, duration)
    if slid.max() > ENDS:
        duration *= (int(np.argmax(slid > ENDS)) + 1) / SAMPLES
        tips, slid = pushed.course(pushed.plant, push, duration)
    times = duration * np.arange(1, SAMPLES + 1) / SAMPLES
    still, _ = pushed.course(stuck, push, duration)
    response = np.empty((SAMPLES, 6, 3))
    for k, axis in enumerate(np.eye(3)):
        more, _ = pushed.course(
            stuck, lambda time, axis=axis: push(time) + NUDGE * time / duration * axis, duration
        )  # fmt: skip
        response[:, :, k] = (more - still) / (NUDGE * times / duration)[:, None]
    halted = [pushed.course(each, push, duration)[0] for each in pushed.without(stuck)]
    unknown = share * (np.array(halted) - still)
    if model:
        wrong = model * still[None] * np.eye(6)[:, None]  # (6, T, 6)
        unknown = np.concatenate([unknown, wrong])
    row: dict[str, Any] = {"rate": rate, "slid": float(slid[-1])}
    began = [
        float(times[np.argmax(slid > each)]) if slid.max() > each else np.nan for each in SLIDES
    ]
    for name, seen in (("all", np.ones(6)), ("place", np.repeat([1.0, 0.0], 3))):
        test = Test(tips - still, response, unknown, duration / SAMPLES, seen)
        is_told = test.distance > TOLD
        if not is_told.any():
            row[name] = {"slide": np.nan, "late": [np.nan] * len(SLIDES)}
            continue
        at = int(np.argmax(is_told))
        seen_at = float(times[at]) + LATENCY
        row[name] = {
            "slide": float(np.interp(seen_at - WITHIN, [0.0, *times], [0.0, *slid])),
            "late": [seen_at - each for each in began],
        }
        if name == "all":
            rng, d = np.random.default_rng(at), test.distance
            y = test.drawn(rng, DRAWS)
            scaled = test.statistic(y)[:, SETTLED:] / np.maximum(d, 1e-9)[SETTLED:]
            sliding = test.statistic(y + test.D)[:, at] / d[at]
            row["drawn"] = float((sliding > THRESHOLD).mean())
            row["expected"] = float(norm.cdf(d[at] - THRESHOLD))
            row["false"] = float((scaled.max(axis=1) > THRESHOLD).mean())
    return row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--tasks", type=int, default=2)
    parser.add_argument("--keep", type=Path, default=Path("out/calibrated"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--true", action="store_true", help="believe the true values instead")
    parser.add_argument("--model", type=float, default=0.0, help="error of the response, in %%")
    parser.add_argument("--creep", type=float, default=30.0,
                        help="deviation of the shares of creep and hysteresis, in %%")  # fmt: skip
    parser.add_argument("--grows", type=float, nargs="+", default=[1.0, 0.2, 0.1],
                        help="shares of the foretold loss per second")  # fmt: skip
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for arm in given.arms:
        case = draw_case(arm, ranked=False)
        believed = believed_file(case, given.keep, true=given.true)
        count = number = 0
        while count < given.tasks and number < 8 * given.tasks:
            number += 1
            held = leant(case, believed, [arm, number, 25], slips=True)
            if not isinstance(held, Held) or held.row["false"]:
                continue
            count += 1
            rows += rows_of(held, arm, given.grows, given.model / 100, given.creep / 100)
            held.loop.controller.close()
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    report(rows)


def rows_of(
    held: Held, arm: int, grows: list[float], model: float, share: float
) -> list[dict[str, Any]]:
    """What can be told at one pose."""
    pushed, foretold = Pushed(held), held.first.loss.force
    force = pushed.plant.object_forces()[0].force
    pressed = float(force @ pushed.normal)
    used = float(np.linalg.norm(force - pressed * pushed.normal))
    _, creeps = pushed.course(pushed.plant, lambda _: np.zeros(3), 20.0)
    known = {
        "arm": arm, "foretold": foretold, "pressed": pressed, "used": used,
        "creeps": float(creeps[-1]),
    }  # fmt: skip
    rows = []
    for each in grows:
        try:
            found = bound(pushed, each * foretold, LONGEST / each, model, share)
        except SimulationError as reason:
            print(f"# arm {arm}, growing by {each}: left out, {reason}", flush=True)
            continue
        rows.append(known | found | {"grows": each})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def report(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    head = ["arm", "tangential and normal force, mN", "slides in 20 s, mm", "grows, 1/s",
            "told within 0.3 s, mm", "by the position alone",
            "after a slide of 0.1, 0.3, 0.5 mm, s", "told of those drawn, expected",
            "false"]  # fmt: skip
    lines = [
        [
            f"{row['arm']}", f"{1e3 * row['used']:.0f}, {1e3 * row['pressed']:.0f}",
            f"{1e3 * row['creeps']:.2f}", f"{row['grows']}",
            f"{1e3 * row['all']['slide']:.2f}", f"{1e3 * row['place']['slide']:.2f}",
            ", ".join(f"{each:.2f}" for each in row["all"]["late"]),
            f"{row.get('drawn', np.nan):.2f}, {row.get('expected', np.nan):.2f}",
            f"{row.get('false', np.nan):.3f}",
        ]
        for row in rows
    ]  # fmt: skip
    print("\n".join(table(head, lines)))


if __name__ == "__main__":
    main()
