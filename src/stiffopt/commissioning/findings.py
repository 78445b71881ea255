"""Describe a commissioning's findings: what is wrong, how certain it is, and what to change."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.expected import ExpectedSteps
from stiffopt.commissioning.explanation import (
    FORCE,
    MOVE,
    NUMBERS,
    SENSOR,
    SENSOR_TURN,
    TURN,
    Cause,
    Explainer,
    SetupExplanation,
    Wiring,
)
from stiffopt.commissioning.responses import Responses
from stiffopt.commissioning.settings import LIMITS
from stiffopt.rig.interface import Rig
from stiffopt.rig.settings import ControlSettings

_AXES = "xyz"
_BASE = "tracker.registration.tracker_in_base"
_SENSOR = "tracker.registration.tip_in_sensor"
_KEYS = {
    "frame turned": (_BASE,), "frame moved": (_BASE,), "frame": (_BASE,),
    "sensor moved": (_SENSOR,), "sensor turned": (_SENSOR,), "load": (), "length": ("robot",),
    "response": ("robot",), "gain": ("robot",),
}  # fmt: skip
_CHECKS = {
    "frame turned": "move the sensor by hand along the base's x, y and z, and see what is read",
    "frame moved": "hold the sensor at the base's origin, and see what is read",
    "frame": "hold the sensor at known places of the base, and see what is read",
    "sensor moved": "measure with a calliper where the sensor sits on the tip",
    "sensor turned": "look at how the sensor is fixed to the tip",
    "load": "weigh what hangs at the tip, hold a spirit level to the base, and see whether "
    "anything touches the arm",
    "length": "measure the arm from base to tip with a calliper",
    "response": "push the tip with a known force ('stiffopt experiment stiffness'), which "
    "distinguishes modulus from gain",
    "gain": "put another gauge on that channel's tube",
}
_WORST = 3.0  # standard deviations from the files' value from which a number does not fit


@dataclass(frozen=True)
class Finding:
    """A finding; see `stiffopt.commissioning.record.RecordedFinding` for the other fields.

    `cause`: name of the cause (`Cause`), or ``wiring``, ``gauge``, ``tracker``, ``timing`` ...
    """

    cause: str
    text: str
    fits: bool
    advice: str = ""
    keys: tuple[str, ...] = ()


def findings_of(
    rig: Rig,
    expected: ExpectedSteps,
    seen: Responses,
    explainer: Explainer,
    best: SetupExplanation,
    frequency: float | None = None,
) -> list[Finding]:
    """Return all findings; those that prevent arming come first.

    Parameters
    ----------
    rig : its settings are compared with the measurements.
    expected, seen, explainer, best : prediction, measurement and its explanation.
    frequency : of the swing according to the model, in Hz; None if the model predicts none.
    """
    control = ControlSettings() if rig.settings is None else rig.settings.control
    found = [
        *_wiring(expected, seen, explainer, best),
        *_causes(expected, explainer, best),
        *_unexplained(expected, best),
        *_gauges(rig, seen, best.wiring),
        *_tracker(rig, seen, control),
        *_delays(seen, control),
        *_swing(seen, control, frequency),
        *_drift(seen),
    ]
    return sorted(found, key=lambda finding: finding.fits)


# -- wiring ----------------------------------------------------------------------------------------


def _wiring(
    expected: ExpectedSteps, seen: Responses, explainer: Explainer, best: SetupExplanation
) -> Iterator[Finding]:
    if best.wiring == explainer.ordinary:
        return
    if not any(best.wiring):
        yield Finding(
            "wiring", "no channel moves the tip", False,
            "is the supply air on, is the sensor on the tip, is the dump valve shut?",
        )  # fmt: skip
        return
    rivals = [
        f"{wiring_words(each.wiring) or 'nothing wrong with the tubes'}"
        + ("".join(f", and {cause_words(c, expected, each)}" for c in each.causes))
        for each in explainer.wiring_rivals(best)
    ]
    text, advice = wiring_words(best.wiring), ["pull the tubes in question and see which one blows"]
    if rivals:
        text += f"; or {'; or '.join(rivals)}: the tip's motion does not distinguish these"
        advice.append(_CHECKS["frame turned"])
    for k, source in enumerate(best.wiring):
        if source == () and np.isfinite(seen.gauge[k, k]):
            reads = seen.gauge[k, k] > 0.5
            advice.append(
                f"the gauge of channel {k + 1} follows: look for a kinked, blocked or loose tube"
                if reads
                else f"the gauge of channel {k + 1} does not follow: check its regulator and air"
            )
    yield Finding("wiring", text, False, "; ".join(advice), ("supply.channels",))


def wiring_words(wiring: Wiring) -> str:
    """Describe what is wrong with the tubes; empty if nothing is."""
    dead = [k + 1 for k, source in enumerate(wiring) if source == ()]
    shared = sorted({source for source in wiring if len(source) > 1})
    moved = {k: s[0] for k, s in enumerate(wiring) if len(s) == 1 and s[0] != k}
    words = []
    if len(moved) == 2 and all(moved.get(other) == k for k, other in moved.items()):
        words.append(f"channels {_listed([k + 1 for k in moved])} seem swapped")
    elif moved:
        each = _listed([f"{k + 1} drives what {other + 1} should" for k, other in moved.items()])
        words.append(f"the channels seem to be in another order: {each}")
    for pair in shared:
        lines = [k + 1 for k, source in enumerate(wiring) if source == pair]
        words.append(
            f"channel{'s' * (len(lines) > 1)} {_listed(lines)} fill{'s' * (len(lines) == 1)} the "
            f"chambers of both {pair[0] + 1} and {pair[1] + 1}: they share a line"
        )
    if dead:
        words.append(f"channel{'s' * (len(dead) > 1)} {_listed(dead)} did not move the tip")
    return "; ".join(words)


def _listed(items: Sequence[object]) -> str:
    *first, last = map(str, items)
    return f"{', '.join(first)} and {last}" if first else last


# -- causes ----------------------------------------------------------------------------------------


def _causes(
    expected: ExpectedSteps, explainer: Explainer, best: SetupExplanation
) -> Iterator[Finding]:
    alike: set[str] = set()
    for cause in best.causes:
        if (words := cause_words(cause, expected, best)) in alike:
            continue
        alike.add(words)
        rivals = explainer.rivals(best, cause)
        others = [pair for pair in rivals if not (pair[0] is cause or _are_one(cause, pair[0]))]
        sizes = [cause_size(each, expected, e) for each, e in rivals]
        fits = all(size < 1 or size < _WORST * deviation for size, deviation in sizes)
        alternatives = dict.fromkeys(cause_words(other, expected, e) for other, e in others)
        if cause.name.startswith("frame"):
            orders = [e for e in explainer.wiring_rivals(best) if e.wiring != explainer.ordinary]
            alternatives |= dict.fromkeys(wiring_words(e.wiring) for e in orders)
        alternatives.pop(words, None)
        text = words
        if alternatives:
            text += f"; or {'; or '.join(alternatives)}: the observations do not distinguish these"
        names = dict.fromkeys(each.name for each, _ in [(cause, best), *others])
        checks = "; ".join(dict.fromkeys(_CHECKS[name] for name in names))
        keys = tuple(dict.fromkeys(key for name in names for key in _KEYS[name]))
        if keys and not alternatives:
            checks = f"correct {_listed(keys)}; to be sure, {checks}"
        yield Finding(cause.name, text, fits, checks if alternatives or not fits else "", keys)


def _are_one(cause: Cause, other: Cause) -> bool:
    """Whether both causes mean a different response of the whole arm."""
    names = {cause.name, other.name}
    return cause.about == other.about < 0 and names <= {"gain", "response"}


def cause_size(
    cause: Cause, expected: ExpectedSteps, explanation: SetupExplanation
) -> tuple[float, float]:
    """Return the size of a cause, relative to its limit of fitting, and its deviation."""
    v, deviation = explanation.values, np.sqrt(np.diag(explanation.covariance))

    def of(part: slice, limit: float) -> tuple[float, float]:
        return float(np.linalg.norm(v[part])) / limit, float(deviation[part].max()) / limit

    turn = max(of(slice(0, 2), LIMITS.tilt), of(slice(2, 3), LIMITS.turn))
    if cause.name in ("frame turned", "frame moved", "frame"):
        parts = {"frame turned": [turn], "frame moved": [of(MOVE, LIMITS.move)]}
        return max(parts.get(cause.name, [turn, of(MOVE, LIMITS.move)]))
    if cause.name == "sensor moved":
        return of(SENSOR, LIMITS.sensor)
    if cause.name == "sensor turned":
        return of(SENSOR_TURN, LIMITS.sensor_angle)
    if cause.name == "load":
        return of(slice(FORCE.start, FORCE.start + 2), LIMITS.bend / expected.compliance)
    value, spread = _number(cause, expected, explanation)
    if cause.name == "length":
        return abs(value) / LIMITS.length, spread / LIMITS.length
    limit = abs(float(np.log(LIMITS.weak if value < 0 else LIMITS.soft)))
    if cause.name == "gain" and cause.about >= 0:
        limit = float(np.log(1 + LIMITS.gain))
    return abs(value) / limit, spread / limit


def _channels(cause: Cause, expected: ExpectedSteps) -> list[int]:
    """Return the channels (from 0) that a cause about the arm concerns."""
    if cause.about < 0:
        return list(range(expected.n))
    if cause.name == "gain":
        return [cause.about]
    counts = [segment.n_channels for segment in expected.description.segments]
    first = sum(counts[: cause.about])
    return list(range(first, first + counts[cause.about]))


def _ratio(cause: Cause, expected: ExpectedSteps, e: SetupExplanation) -> float:
    """Return the ratio of displacement to the model's, over the channels that a cause concerns."""
    rows = [expected.row((k,)) for k in _channels(cause, expected)]
    expected_way = expected.shift[rows]
    way = expected_way + expected.shift_slope[rows] @ e.values[FORCE.start :]
    ratios = np.linalg.norm(way, axis=1) / np.linalg.norm(expected_way, axis=1)
    return float(ratios.mean())


def _number(cause: Cause, expected: ExpectedSteps, e: SetupExplanation) -> tuple[float, float]:
    """Return the relative change of a length or response, to first order, and its deviation."""
    segments, weights = expected.description.n_segments, np.zeros(len(e.values))
    channels = _channels(cause, expected)
    chosen = range(segments) if cause.about < 0 else [cause.about]
    if cause.name == "gain":
        weights[[NUMBERS + 2 * segments + k for k in channels]] = 1 / len(channels)
    elif cause.name == "length":
        weights[[NUMBERS + s for s in chosen]] = 1 / len(chosen)
    else:
        weights[[NUMBERS + segments + s for s in chosen]] = -1 / len(chosen)
        weights[[NUMBERS + 2 * segments + k for k in channels]] = 1 / len(channels)
    return float(weights @ e.values), float(np.sqrt(weights @ e.covariance @ weights))


def cause_words(cause: Cause, expected: ExpectedSteps, e: SetupExplanation) -> str:
    """Describe a cause, with its size."""
    v, deviation = e.values, np.sqrt(np.diag(e.covariance))

    def turned(part: slice, sign: float) -> str:
        angle = float(np.linalg.norm(v[part]))
        axis = _axis(sign * v[part] / max(angle, 1e-12))
        spread = float(np.degrees(deviation[part].max()))
        return f"{_signed(np.degrees(angle), axis)} +- {spread:.1f} deg about {axis.lstrip('-')}"

    def moved(part: slice, sign: float) -> str:
        place = ", ".join(f"{1e3 * x:.1f}" for x in sign * v[part] + 0.0)
        return f"({place}) +- {1e3 * float(deviation[part].max()):.1f} mm"

    if cause.name == "frame turned":
        return f"the tracker's frame is turned by {turned(TURN, -1.0)}"
    if cause.name == "frame moved":
        return f"the tracker's frame is {moved(MOVE, -1.0)} from where the rig file has it"
    if cause.name == "frame":
        return (
            f"the tracker's frame is turned by {turned(TURN, -1.0)} and reads the base "
            f"{moved(MOVE, 1.0)} from where it is"
        )
    if cause.name == "sensor moved":
        z = float(v[SENSOR][2])
        if abs(z) > 0.9 * np.linalg.norm(v[SENSOR]):
            where = "further along the arm" if z > 0 else "back along the arm"
            return (
                f"the sensor is {1e3 * abs(z):.1f} +- {1e3 * deviation[SENSOR][2]:.1f} mm {where} "
                "than the rig file has it"
            )
        return (
            f"the sensor is {moved(SENSOR, 1.0)} in the tip's axes from where the rig file has it"
        )
    if cause.name == "sensor turned":
        return f"the sensor is turned on the tip by {turned(SENSOR_TURN, 1.0)} of the tip"
    if cause.name == "load":
        return _load_words(expected, v[FORCE], float(deviation[FORCE][:2].max()))
    value, spread = _number(cause, expected, e)
    factor, about = _ratio(cause, expected, e), _about(cause, expected)
    if cause.name == "length":
        return f"{about} is {100 * value:+.1f} +- {100 * spread:.1f} % longer than its file says"
    moves = f"{about} moves the tip {factor:.2f} times as far as modelled"
    share = max(1 + value, 0.01)  # of the modelled response; the estimate is linear in it
    if cause.name == "gain" and cause.about >= 0:
        return f"{moves}: gain {share:.2f} +- {spread:.2f}"
    return (
        f"{moves}: a modulus {1 / share:.2f} +- {spread / share**2:.2f} times that of its file, or "
        "a gain of all its channels that does the same"
    )


def _load_words(expected: ExpectedSteps, force: Array, spread: float) -> str:
    lateral = float(np.linalg.norm(force[:2]))
    x, y = (f"{1e3 * f:.0f}" for f in force[:2] + 0.0)
    text = (
        f"a load of {x} and {y} +- {1e3 * spread:.0f} mN along x and y on the tip, which bends it "
        f"by {1e3 * expected.compliance * lateral:.1f} mm"
    )
    if expected.tilt_force > 0:
        text += f", or a base tilted by {np.degrees(lateral / expected.tilt_force):.1f} deg"
    return text


def _about(cause: Cause, expected: ExpectedSteps) -> str:
    if cause.name == "gain" and cause.about >= 0:
        return f"channel {cause.about + 1}"
    several = expected.description.n_segments > 1
    return f"segment {cause.about + 1}" if cause.about >= 0 and several else "the arm"


def _axis(axis: Array) -> str:
    """Name an axis with its sign, or write it as a vector."""
    main = int(np.argmax(np.abs(axis)))
    if abs(axis[main]) > 0.96:
        return f"{'-' if axis[main] < 0 else ''}{_AXES[main]}"
    return f"({', '.join(f'{x:.2f}' for x in axis + 0.0)})"


def _signed(degrees: float, axis: str) -> str:
    return f"{'-' if axis.startswith('-') else ''}{degrees:.1f}"


def _unexplained(expected: ExpectedSteps, best: SetupExplanation) -> Iterator[Finding]:
    for k, missed in enumerate(np.linalg.norm(best.missed, axis=1)):
        alone = float(np.linalg.norm(expected.shift[expected.row((k,))]))
        if missed > max(LIMITS.unexplained * alone, 5e-4):
            yield Finding(
                "unexplained",
                f"channel {k + 1} moves the tip {1e3 * missed:.1f} mm away from every explanation "
                "that was tried",
                False,
                "is the arm free of contact, and is the robot file that of this arm?",
                ("robot",),
            )


# -- devices ---------------------------------------------------------------------------------------


def _gauges(rig: Rig, seen: Responses, wiring: Wiring) -> Iterator[Finding]:
    n = len(wiring)
    measured = measured_channels(rig)
    silent = [k for k in range(n) if measured[k] and np.isnan(seen.gauge_offset[k])]
    if silent:
        yield Finding(
            "gauge", f"the gauges of channels {_listed([k + 1 for k in silent])} read nothing",
            False, "look at cable, power and input of each; a supply without gauges says so in its "
            "driver's settings", ("supply",),
        )  # fmt: skip
    for k in range(n):
        if np.isnan(seen.gauge_offset[k]):
            continue
        own, others = float(seen.gauge[k, k]), np.delete(np.arange(n), k)
        crossed = [int(j) for j in others if seen.gauge[k, j] > 0.5]
        if own < LIMITS.dead and crossed:
            yield Finding(
                "gauge", f"the gauge of channel {crossed[0] + 1} follows the command of channel "
                f"{k + 1}", False, "exchange the inputs, or the outputs if the tip shows that they "
                "are swapped", ("supply.channels",),
            )  # fmt: skip
        elif own < LIMITS.dead and wiring[k]:
            yield Finding(
                "gauge", f"the gauge of channel {k + 1} does not follow its command, though the "
                "tip does: it is dead", False, "change the gauge, or its cable", ("supply",),
            )  # fmt: skip
        elif own >= LIMITS.dead:
            off = abs(1 - own)
            clear = off > max(LIMITS.gauge, _WORST * seen.gauge_deviation)
            if clear and off * seen.size > LIMITS.gauge_least:
                what = (
                    "a leak that its regulator feeds, a weak supply, or a wrong scale"
                    if own < 1
                    else "a wrong scale of the gauge or of the output"
                )
                yield Finding(
                    "gauge", f"the gauge of channel {k + 1} rises by {100 * own:.0f} % of what is "
                    f"commanded: {what}", False, "close the line behind the gauge: what it then "
                    "still loses is no leak of the arm", ("supply",),
                )  # fmt: skip
    limit = np.max(rig.settings.safety.max_pressure_error) if rig.settings else 1.5e4
    for channel in np.flatnonzero(np.abs(seen.gauge_offset) > 0.5 * limit):
        yield Finding(
            "gauge", f"the gauge of channel {channel + 1} reads "
            f"{seen.gauge_offset[channel] * 1e-5:.3f} bar "
            "though the arm is vented", False, "set its zero, or its scale in the rig file",
            ("supply",),
        )  # fmt: skip


def measured_channels(rig: Rig) -> list[bool]:
    """Return whether each channel has a gauge, according to the rig file."""
    n = rig.supply.n
    if rig.settings is None:
        return [False] * n
    return [rig.settings.supply.measures(k) for k in range(n)]


def _tracker(rig: Rig, seen: Responses, control: ControlSettings) -> Iterator[Finding]:
    if seen.noise > LIMITS.noise * control.tracker_noise:
        yield Finding(
            "tracker", f"the tracker's noise is {1e3 * seen.noise:.3f} mm in each axis, and the "
            f"rig file has {1e3 * control.tracker_noise:.3f} mm", False,
            f"set control.tracker_noise to {1e3 * seen.noise:.2g} mm, or move metal and drives "
            "away from the tracker", ("control.tracker_noise",),
        )  # fmt: skip
    tracker = None if rig.settings is None else rig.settings.tracker
    usual = float(getattr(tracker, "latency", 0.025))
    if seen.latency > usual + LIMITS.latency:
        yield Finding(
            "tracker", f"the tracker's samples are {1e3 * seen.latency:.0f} ms old when they "
            f"come, and the rig file has {1e3 * usual:.0f} ms", False,
            "look for a filter or a busy network between tracker and computer",
            ("tracker.latency",),
        )  # fmt: skip
    if seen.tip_delay > LIMITS.tip_delay:
        yield Finding(
            "tracker", f"the tip follows the gauges {1e3 * seen.tip_delay:.0f} ms late, by the "
            "tracker's own times: its poses are older than it says", False,
            f"raise tracker.latency by {1e3 * seen.tip_delay:.0f} ms, or switch off its filter",
            ("tracker.latency",),
        )  # fmt: skip
    if seen.missing > 0.1:
        yield Finding(
            "tracker", f"{100 * seen.missing:.0f} % of the tracker's samples do not see the tip",
            False, "clear its view, or bring it nearer", ("tracker",),
        )  # fmt: skip


def _delays(seen: Responses, control: ControlSettings) -> Iterator[Finding]:
    total = seen.delays.dead_time + np.fmax(seen.delays.lag_up, seen.delays.lag_down)
    if np.isnan(total).all():
        return
    slowest = int(np.nanargmax(total))
    usual = control.regulator_dead_time + control.regulator_lag
    if total[slowest] > usual + LIMITS.slower:
        yield Finding(
            "timing", f"the regulator of channel {slowest + 1} follows after "
            f"{total[slowest]:.2f} s, and the rig file has {usual:.2f} s", False,
            f"set control.regulator_lag to {np.nanmax(seen.delays.lag_up):.2g} s and "
            f"regulator_dead_time to {np.nanmedian(seen.delays.dead_time):.2g} s",
            ("control.regulator_lag", "control.regulator_dead_time"),
        )  # fmt: skip


def _swing(seen: Responses, control: ControlSettings, frequency: float | None) -> Iterator[Finding]:
    swing = seen.swing
    if swing is None:
        return
    text = (
        f"the tip swings at {swing.frequency:.2f} +- {swing.frequency_deviation:.2f} Hz, with "
        f"{100 * swing.damping:.1f} +- {100 * swing.damping_deviation:.1f} % of critical damping"
    )
    off = 1.0 if not frequency else max(swing.frequency / frequency, frequency / swing.frequency)
    if off > LIMITS.frequency:
        yield Finding(
            "swing", f"{text}; the model has {frequency:.2f} Hz", False,
            "weigh what the tip carries (tip_mass), and calibrate the modulus", ("robot",),
        )  # fmt: skip
    elif control.vibration == "none" and swing.amplitude > 5e-4:
        yield Finding(
            "swing", f"{text}, and the rig file says that it does not", False,
            "set control.vibration to modelled", ("control.vibration",),
        )  # fmt: skip
    elif abs(swing.damping - control.damping) > max(0.03, 0.6 * control.damping):
        yield Finding(
            "swing", f"{text}; the rig file has {100 * control.damping:.0f} %", True,
            f"set control.damping to {swing.damping:.2g}", ("control.damping",),
        )  # fmt: skip


def _drift(seen: Responses) -> Iterator[Finding]:
    for k, back in enumerate(seen.drift):
        if back > LIMITS.drift:
            yield Finding(
                "leak", f"while channel {k + 1} was held, the tip came back by {100 * back:.0f} % "
                "of its way: pressure is lost behind the gauge", False,
                "look for a leak between gauge and chamber", ("supply",),
            )  # fmt: skip
