"""What was learnt of each number, and what was not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.identify.fit import Fit
from stiffopt.identify.unknowns import BASE, SENSOR
from stiffopt.model.parameters import Parameter

__all__ = ["TIED", "Estimate", "doubts", "estimates"]

TIED = "hardly told apart"
"""How the remark on two numbers begins that these data do not tell apart."""
_LEARNT = 0.5  # share of the prior's variance that must be gone
_TIED = 0.95  # correlation from which two numbers cannot be told apart
_FAR = 3.0  # deviations from the robot file
_TILT = np.radians(8.0)  # of base or sensor, that is doubted whatever the tolerance
_NORMAL = 1.959963984540054

_PLACED = {
    BASE: "the base tracked too, or touched with a pointer",
    SENSOR: "the tip's orientation recorded while it bends in all directions",
}
"""What recordings would tell where these are."""


@dataclass(frozen=True)
class Estimate:
    """A number that was fitted.

    Attributes
    ----------
    name : for people.
    key : in the robot file, or empty.
    unit : SI unit; empty for a plain number.
    before, value : in SI; of a frame's move, zero before.
    low, high : 95 % interval.
    learnt : share of the prior's variance that the data removed, from 0 to 1.
    far : how many prior deviations from the robot file it ended.
    """

    name: str
    key: str
    unit: str
    before: float
    value: float
    low: float
    high: float
    learnt: float
    far: float


def estimates(found: Fit) -> tuple[Estimate, ...]:
    """Every number of a fit with its interval."""
    variance = np.diag(found.covariance)
    listed = []
    for unknown, x, v in zip(found.problem.unknowns.all, found.x, variance, strict=True):
        middle, half = x * unknown.deviation, _NORMAL * math.sqrt(v) * unknown.deviation
        ends = [max(middle - half, unknown.low), middle, min(middle + half, unknown.high)]
        before, unit, key = 0.0, unknown.unit, ""
        if unknown.parameter is not None:
            key, unit = unknown.parameter.key, unknown.parameter.unit
            before = unknown.parameter.value(found.problem.description)
            ends = [float(unknown.parameter.at(before, end)) for end in ends]
        listed.append(
            Estimate(
                unknown.name,
                key,
                unit,
                before,
                ends[1],
                ends[0],
                ends[2],
                learnt=float(np.clip(1 - v, 0, 1)),
                far=float(x),
            )
        )
    return tuple(listed)


def doubts(found: Fit, listed: Sequence[Estimate]) -> list[str]:
    """What to make of the numbers: not learnt, not told apart, or far from the robot file."""
    remarks = []
    unlearnt: dict[str, list[str]] = {}
    for estimate in listed:
        if estimate.learnt < _LEARNT:
            unlearnt.setdefault(_experiment(estimate), []).append(estimate.name)
    for experiment, names in unlearnt.items():
        tell = f"; what would tell: {experiment}" if experiment else ""
        remarks.append(f"not learnt from these data: {'; '.join(names)}{tell}")
    deviation = np.sqrt(np.diag(found.covariance))
    correlation = found.covariance / np.outer(deviation, deviation)
    for i, one in enumerate(listed):
        for j in range(i):
            if abs(correlation[i, j]) > _TIED:
                remarks.append(
                    f"{TIED}: {listed[j].name} and {one.name} (correlation {correlation[i, j]:.2f})"
                )
    for estimate in listed:
        turned = estimate.unit == "rad" and not estimate.key and not estimate.name.endswith("z")
        if abs(estimate.far) > _FAR or (turned and abs(estimate.value) > _TILT):
            remarks.append(
                f"far from the robot file: {estimate.name}, by {abs(estimate.far):.1f} of its "
                "tolerances; look for a reason before you trust it"
            )
    return remarks


def _experiment(estimate: Estimate) -> str:
    if estimate.key:
        return Parameter(estimate.key).number.experiment
    return next((text for name, text in _PLACED.items() if estimate.name.startswith(name)), "")
