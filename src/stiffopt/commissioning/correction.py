"""Correct a rig file by a commissioning's findings."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stiffopt import lie
from stiffopt.commissioning.explanation import MOVE, SENSOR, SENSOR_TURN, TURN, SetupExplanation
from stiffopt.commissioning.findings import Finding
from stiffopt.commissioning.responses import Responses
from stiffopt.documents import read_document, write_file
from stiffopt.errors import FileError
from stiffopt.registration import Placement, Registration
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.interface import Rig
from stiffopt.units import format_quantity

_INPUTS = ("reading", "input")
"""Keys of a channel in a rig file that name its gauge's input."""


def corrections(
    rig: Rig, path: str, best: SetupExplanation, seen: Responses, findings: Sequence[Finding]
) -> tuple[dict[str, Any], list[str]]:
    """Return the data of a corrected rig file, and the changed keys.

    Only keys of findings that do not fit are changed.
    """
    data = copy.deepcopy(read_document(path).data)
    wrong = {finding.cause for finding in findings if not finding.fits}
    changed = []
    if "wiring" in wrong and (channels := _rewired(data, best, seen)) is not None:
        data["supply"]["channels"] = channels
        changed.append("supply.channels")
    keys = {key for finding in findings if not finding.fits for key in finding.keys}
    registration = _registered(rig, best, wrong)
    if registration is not None:
        block = data["tracker"].setdefault("registration", {})
        for key in ("tracker_in_base", "tip_in_sensor"):
            if f"tracker.registration.{key}" in keys:
                block[key] = _written(getattr(registration, key))
                changed.append(f"tracker.registration.{key}")
    control = {
        "tracker_noise": (seen.noise, "m", "mm"),
        "regulator_lag": (float(np.nanmax(np.append(seen.delays.lag_up, 0.0))), "s", "ms"),
        "regulator_dead_time": (float(np.nanmedian(seen.delays.dead_time)), "s", "ms"),
    }
    for key, (value, unit, written) in control.items():
        if f"control.{key}" in keys and np.isfinite(value):
            text = format_quantity(float(f"{value:.2g}"), unit, written)
            data.setdefault("control", {})[key] = text
            changed.append(f"control.{key}")
    if "control.vibration" in keys:
        data.setdefault("control", {})["vibration"] = "modelled"
        changed.append("control.vibration")
    return data, changed


def check_place(out: str | os.PathLike[str], path: str) -> None:
    """Raise `FileError` unless `out` is in the folder of `path`, as its relative paths need."""
    if Path(out).resolve().parent != Path(path).resolve().parent:
        raise FileError(out, f"expected a place beside {path}: it names files relative to itself")


def write_corrected(
    out: str | os.PathLike[str], path: str, data: dict[str, Any], changed: Sequence[str]
) -> None:
    """Write the corrected rig file into the folder of the old one, and check it.

    Raises `FileError`: it is in another folder, where its relative paths would be wrong, or it is
    invalid.
    """
    check_place(out, path)
    comment = [
        f"{path}, corrected by 'stiffopt commission' in: {', '.join(changed)}.",
        "Comments of that file are not in here.",
    ]
    write_file(out, data, comment)
    load_rig_description(out)


def _rewired(data: dict[str, Any], best: SetupExplanation, seen: Responses) -> list[Any] | None:
    """Return the supply's channels in the order in which they drive the arm's channels.

    If a gauge follows its own channel's command, the channel's output and input move together;
    else only the outputs are crossed. None if the rig file cannot express the wiring.
    """
    channels = data.get("supply", {}).get("channels")
    sources = [source[0] if len(source) == 1 else None for source in best.wiring]
    if not isinstance(channels, list) or sorted(map(str, sources)) != sorted(
        map(str, range(len(channels)))
    ):
        return None
    rewired = copy.deepcopy(channels)
    own = [not seen.gauge[k, k] < 0.5 for k in range(len(sources))]  # true for NaN
    for k, target in enumerate(sources):
        assert target is not None
        rewired[target] = copy.deepcopy(channels[k])
        for key in _INPUTS:
            if not own[k] and key in channels[target]:
                rewired[target][key] = copy.deepcopy(channels[target][key])
    return rewired


def _registered(rig: Rig, best: SetupExplanation, wrong: set[str]) -> Registration | None:
    """Return the rig file's registration, corrected by the errors of frame and sensor."""
    if rig.tracker is None or rig.settings is None:
        return None
    frame, sensor = np.eye(4), np.eye(4)
    if wrong & {"frame", "frame turned"}:
        frame = np.asarray(lie.exp(np.concatenate([np.zeros(3), best.values[TURN]])))
    if wrong & {"frame", "frame moved"}:
        frame[:3, 3] = best.values[MOVE]
    if "sensor turned" in wrong:
        sensor = np.asarray(lie.exp(np.concatenate([np.zeros(3), best.values[SENSOR_TURN]])))
    if "sensor moved" in wrong:
        sensor[:3, 3] = best.values[SENSOR]
    given, total = rig.settings.tracker.registration, rig.tracker.registration
    before = total.tracker_in_base.transform() @ given.tracker_in_base.inverse()
    after = given.tip_in_sensor.inverse() @ total.tip_in_sensor.transform()
    inverse = np.linalg.inv
    return Registration(
        tracker_in_base=Placement.of(
            inverse(before) @ inverse(frame) @ total.tracker_in_base.transform()
        ),
        tip_in_sensor=Placement.of(
            total.tip_in_sensor.transform() @ inverse(sensor) @ inverse(after)
        ),
    )


def _written(placement: Placement) -> dict[str, Any]:
    """Return a placement in the form of a rig file, rounded."""
    position = [format_quantity(round(x, 6) + 0.0, "m", "mm") for x in placement.position]
    q = np.round(placement.orientation, 6)
    return {"position": position, "orientation": (q / np.linalg.norm(q)).tolist()}
