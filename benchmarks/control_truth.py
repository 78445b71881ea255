"""What is true of a simulated arm, in words of the model: how stiff it could be where it is."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration import with_true_values

if TYPE_CHECKING:
    from stiffopt.model.description import RobotDescription
    from stiffopt.plant.settings import Mismatch

Array = NDArray[np.float64]

BAR = 1e5
STARTS = 8  # of each search
NUDGE = 1e-4  # bar, for derivatives of the stiffness
REACHED = 2e-5  # m
STIFF, SOFT = -1.0, 1.0  # signs of the value that is made small


@dataclass(frozen=True)
class Choice:
    """What can be chosen at a place of the tip.

    Attributes
    ----------
    least, most : stiffness, in N/m.
    softest, stiffest : pressures (n,) for them, in Pa.
    """

    least: float
    most: float
    softest: Array
    stiffest: Array


class Truth:
    """The model with the arm's true values, in the nominal base frame.

    Attributes
    ----------
    model : Manipulator
        In the arm's own, true base frame.
    base : that frame (4, 4) in the nominal one.
    """

    def __init__(self, robot: RobotDescription, mismatch: Mismatch, payload: float = 0.0) -> None:
        from stiffopt import load_robot
        from stiffopt.optimise.tip import TipModel

        self.base: Array = mismatch.base.transform()
        known: Any = SimpleNamespace(mismatch=mismatch)
        gravity = self.base[:3, :3].T @ np.array(robot.gravity)
        update = {"gravity": tuple(gravity.tolist()), "tip_mass": robot.tip_mass + payload}
        self.model = load_robot(with_true_values(robot, known).model_copy(update=update))
        with _passing_cache():  # nobody needs the code of this very arm again
            self._tip = TipModel(self.model)

    def position(self, pressures: Array) -> Array:
        """Tip (3,)."""
        return self._place(pressures)[0]

    def _place(self, pressures: Array) -> tuple[Array, Array]:
        """Tip (3,) and its derivative (3, n) by the pressures."""
        pose, jacobian, _ = self._tip.at(pressures)
        pose = self.base @ pose
        return pose[:3, 3], pose[:3, :3] @ jacobian[:3]

    def stiffness(self, pressures: Array, direction: tuple[float, ...]) -> float:
        """Of the free tip along a unit vector in the nominal base frame, in N/m."""
        pose, _, compliance = self._tip.at(pressures)
        d = (self.base[:3, :3] @ pose[:3, :3]).T @ np.array(direction)
        return float(1 / (d @ compliance[:3, :3] @ d))

    def reach(self, position: Array, start: Array, low: Array, high: Array) -> Array | None:
        """Pressures (n,) that bring the tip there, near to others; None where none were found."""
        from scipy.optimize import least_squares

        x0 = np.clip(start, low + 1e-3 * (high - low), high - 1e-3 * (high - low)) / BAR
        found = least_squares(
            lambda x: 1e3 * (self._place(BAR * x)[0] - position),
            x0,
            lambda x: 1e3 * BAR * self._place(BAR * x)[1],
            bounds=(low / BAR, high / BAR),
            xtol=1e-6,
        )
        return BAR * found.x if np.linalg.norm(found.fun) < 1e3 * REACHED else None

    def choice(
        self,
        pressures: Array,
        direction: tuple[float, ...],
        rng: np.random.Generator,
        at: Array | None = None,
    ) -> Choice:
        """The softest and the stiffest way to hold the tip where these pressures hold it, or `at`.

        Raises
        ------
        RuntimeError
            The place cannot be reached.
        """
        low, high = (np.array(v) for v in (self.model.pressure_min, self.model.pressure_max))
        place = self.position(pressures) if at is None else at
        starts = [pressures]
        for _ in range(STARTS - 1):
            start = self.reach(place, rng.uniform(low, high), low, high)
            if start is not None:
                starts.append(start)
        found = [
            (self.stiffness(p, direction), p)
            for start in starts
            for sign in (STIFF, SOFT)
            if (p := self.extreme(place, direction, start, sign)) is not None
        ]
        if at is None:
            found.append((self.stiffness(pressures, direction), pressures))
        if not found:
            raise RuntimeError("the true model does not reach the place")
        (least, softest), (most, stiffest) = (
            f(found, key=lambda each: each[0]) for f in (min, max)
        )
        return Choice(least, most, softest, stiffest)

    def extreme(
        self, place: Array, direction: tuple[float, ...], start: Array, sign: float
    ) -> Array | None:
        """A local optimum (n,) of the stiffness at a place, for `STIFF` or `SOFT`."""
        from scipy.optimize import minimize

        low, high = (np.array(v) / BAR for v in (self.model.pressure_min, self.model.pressure_max))

        def value(x: Array) -> float:
            return sign * float(np.log(self.stiffness(BAR * x, direction)))

        def gradient(x: Array) -> Array:
            here, steps = value(x), np.where(x + NUDGE <= high, NUDGE, -NUDGE)
            return np.array([
                (value(x + step * unit) - here) / step
                for step, unit in zip(steps, np.eye(len(x)), strict=True)
            ])  # fmt: skip

        found = minimize(
            value, np.clip(start / BAR, low, high), jac=gradient, method="SLSQP",
            bounds=list(zip(low, high, strict=True)),
            constraints={
                "type": "eq",
                "fun": lambda x: 1e3 * (self._place(BAR * x)[0] - place),
                "jac": lambda x: 1e3 * BAR * self._place(BAR * x)[1],
            },
            options={"maxiter": 80, "ftol": 1e-7},
        )  # fmt: skip
        p = BAR * np.clip(found.x, low, high)
        return p if np.linalg.norm(self.position(p) - place) < REACHED else None


@contextmanager
def _passing_cache() -> Iterator[None]:
    """Context whose compiled code is kept on disk no longer than that."""
    name = "STIFFOPT_CACHE_DIR"
    before = os.environ.get(name)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[name] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ[name]
            else:
                os.environ[name] = before
