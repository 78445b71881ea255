"""Commission a rig: move it, compare its responses with the model, and write the record."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from stiffopt.commissioning.expected import ExpectedSteps
from stiffopt.commissioning.explanation import (
    FORCE,
    MOVE,
    SENSOR,
    SENSOR_TURN,
    TURN,
    Explainer,
    SetupExplanation,
)
from stiffopt.commissioning.findings import Finding, findings_of
from stiffopt.commissioning.procedure import StepReadings
from stiffopt.commissioning.record import (
    CommissioningRecord,
    RecordedChannel,
    RecordedFinding,
    RecordedNumber,
    RecordedSwing,
    RecordedTracker,
    fingerprints,
)
from stiffopt.commissioning.responses import Responses, responses_of
from stiffopt.rig.interface import Rig

_DIGITS = 6  # significant digits in the record


@dataclass(frozen=True, eq=False)
class Commissioning:
    """The result of a commissioning.

    Attributes
    ----------
    expected : the model's predictions.
    readings : all measurements.
    responses : their evaluation, step by step.
    explanation : the wiring and the causes that explain the responses best.
    findings : those that prevent arming first.
    quick : whether the steps were held only briefly.
    """

    expected: ExpectedSteps
    readings: StepReadings
    responses: Responses
    explanation: SetupExplanation
    findings: tuple[Finding, ...]
    quick: bool

    @property
    def fits(self) -> bool:
        """Whether the rig may be armed."""
        return all(finding.fits for finding in self.findings)


def evaluate(
    rig: Rig,
    expected: ExpectedSteps,
    readings: StepReadings,
    *,
    quick: bool = False,
    frequency: float | None = None,
) -> Commissioning:
    """Find in the readings of a commissioning where the rig deviates from its files.

    `quick`: see `run_steps`. `frequency`: of the tip's swing according to the model, in Hz; None if
    the model predicts none.
    """
    responses = responses_of(readings)
    explainer = Explainer(expected, responses)
    best = explainer.best()
    findings = findings_of(rig, expected, responses, explainer, best, frequency)
    return Commissioning(expected, readings, responses, best, tuple(findings), quick)


# -- record ----------------------------------------------------------------------------------------


def record_of(rig: Rig, found: Commissioning, log: str | None = None) -> CommissioningRecord:
    """Return the record of a commissioning; `log` is the path of its recording."""
    seen = found.responses
    orientation = found.readings.quaternion
    if orientation is not None:
        begin, end = found.readings.rest
        rows = (found.readings.time >= begin) & (found.readings.time <= end)
        orientation = np.nanmean(orientation[rows], axis=0)
    swing = seen.swing
    return CommissioningRecord(
        **_heading(rig, found.quick),
        fits=found.fits,
        findings=tuple(
            RecordedFinding(text=f.text, fits=f.fits, advice=f.advice, keys=f.keys)
            for f in found.findings
        ),
        step=_rounded(seen.size),
        tracker=RecordedTracker(
            position=_vector(seen.rest_position),
            orientation=None if orientation is None else tuple(orientation.tolist()),
            noise=_rounded(seen.noise),
            angular_noise=None if seen.turn is None else _rounded(seen.angular_noise),
            rate=_rounded(seen.rate),
            latency=_rounded(seen.latency),
            tip_delay=_rounded(seen.tip_delay) if np.isfinite(seen.tip_delay) else None,
            missing=_rounded(seen.missing),
        ),
        channels=tuple(_channel(found, k) for k in range(found.expected.n)),
        swing=None if swing is None else RecordedSwing(
            **{name: _rounded(value) for name, value in vars(swing).items()}
        ),
        numbers=_numbers(found),
        unexplained=_rounded(float(np.sqrt(np.mean(found.explanation.missed**2) * 3))),
        log=log,
    )  # fmt: skip


def stopped_record(rig: Rig, reason: str, *, quick: bool) -> CommissioningRecord:
    """Return the record of a commissioning that a danger or a fault ended."""
    finding = RecordedFinding(text=f"commissioning was stopped: {reason}", fits=False)
    return CommissioningRecord(**_heading(rig, quick), fits=False, findings=(finding,))


def _heading(rig: Rig, quick: bool) -> dict[str, Any]:
    rig_hash, robot_hash = fingerprints(rig.robot, rig.settings)
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "rig": "rig" if rig.settings is None else rig.settings.name,
        "robot": rig.robot.name,
        "rig_hash": rig_hash,
        "robot_hash": robot_hash,
        "quick": quick,
    }


def _channel(found: Commissioning, k: int) -> RecordedChannel:
    seen, source = found.responses, found.explanation.wiring[k]
    optional = {
        "gauge": seen.gauge[k, k],
        "gauge_offset": seen.gauge_offset[k],
        "gauge_noise": seen.gauge_noise[k],
        "drift": seen.drift[k],
        **{name: values[k] for name, values in vars(seen.delays).items()},
    }
    return RecordedChannel(
        drives=tuple(j + 1 for j in source),
        displacement=_vector(seen.shift[k]),
        expected=_vector(found.expected.shift[found.expected.row((k,))]),
        deviation=_rounded(float(seen.shift_noise[k])),
        **{name: _rounded(float(v)) for name, v in optional.items() if np.isfinite(v)},
    )


def _numbers(found: Commissioning) -> tuple[RecordedNumber, ...]:
    """Return all estimated numbers of the set-up, with their standard deviations."""
    robot, e = found.expected.description, found.explanation
    names: list[tuple[str, str]] = [("", "")] * len(e.values)
    for part, name, unit in (
        (TURN, "turn of the tracker's readings about", "rad"),
        (MOVE, "shift of the tracker's readings along", "m"),
        (SENSOR, "shift of the sensor on the tip along", "m"),
        (SENSOR_TURN, "turn of the sensor on the tip about", "rad"),
        (FORCE, "force on the tip along", "N"),
    ):
        for axis, letter in enumerate("xyz"):
            names[part.start + axis] = (f"{name} {letter}", unit)
    segments = range(1, robot.n_segments + 1)
    numbers = [f"{what} of segment {s}, log" for what in ("length", "modulus") for s in segments]
    numbers += [f"gain of {robot.channel_name(k)}, log" for k in range(found.expected.n)]
    names[FORCE.stop :] = [(name, "") for name in numbers]
    deviations = np.sqrt(np.diag(e.covariance))
    return tuple(
        RecordedNumber(name=name, unit=unit, value=_rounded(value), deviation=_rounded(deviation))
        for (name, unit), value, deviation in zip(names, e.values, deviations, strict=True)
    )


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = (_rounded(float(f"{v:.7f}")) for v in values)
    return x, y, z
