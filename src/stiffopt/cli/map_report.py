"""A map of a workspace for people, and as a line of JSON in SI units."""

import json
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.errors import printable
from stiffopt.plots.wording import figures, unit_text, vector_text
from stiffopt.workspace import Extreme, WorkspaceMap

_BAR = 1e-5  # per Pa
_MM = 1e3  # per m


def summary(found: WorkspaceMap, out: str | None, seconds: float) -> RenderableType:
    """Return all there is to say about a map, about 80 columns wide."""
    grid = Table.grid(padding=(0, 2), pad_edge=False)
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    heading = printable(out) if out is not None else "workspace"
    for label, text in _facts(found, seconds):
        grid.add_row(f"  {label}", text)
    if not len(found.table):
        return Group(Text(heading, "bold"), grid)
    return Group(Text(heading, "bold"), grid, Text(""), _stiffnesses(found))


def _facts(found: WorkspaceMap, seconds: float) -> list[tuple[str, str]]:
    plan, robot = found.plan, found.plan.robot
    loaded = ", in equilibrium under gravity" if robot.is_loaded else ""
    record = plan.sampling.record()
    how = (
        f"grid of {record['levels']} levels of each channel"
        if "levels" in record
        else f"quasi-random, seed {record['seed']}"
    )
    facts = [
        ("robot", f"{printable(robot.description.name)}, {robot.n_pressures} channels{loaded}"),
        ("samples", f"{found.samples:,}, {how}"),
    ]
    if found.evaluated:
        rate = found.evaluated / seconds
        facts.append(("time", f"{seconds:.1f} s, {rate:,.0f} samples a second"))
    if found.lost:
        facts.append(("lost", f"{found.lost:,} samples: the arm has no stable equilibrium there"))
    if not len(found.table):
        return facts
    extent = ", ".join(
        f"{axis} {low * _MM:.0f} to {high * _MM:.0f} mm"
        for axis, low, high in zip("xyz", found.low, found.high, strict=True)
    )
    facts += [
        ("reach", f"{found.volume * 1e6:,.0f} cm^3: {len(found.table):,} cells of "
         f"{plan.cell * _MM:g} mm, {np.median(found.count):g} samples in the median cell"),
        ("tip", extent),
    ]  # fmt: skip
    return facts


def _stiffnesses(found: WorkspaceMap) -> RenderableType:
    plan = found.plan
    first = plan.measures[0]
    unit = unit_text(plan.unit)
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="bold")
    table.add_column(unit, no_wrap=True)
    for heading in ("stiffest", "at (mm)", "softest", "at (mm)", "ratio"):
        table.add_column(heading, justify="right", no_wrap=True)
    for number, name in enumerate(found.direction_names):
        best, worst = found.best_in(number), found.worst_in(number)
        if best is None or worst is None:
            continue
        table.add_row(
            name,
            figures(best.stiffness),
            vector_text(best.cell_centre * _MM),
            figures(worst.stiffness),
            vector_text(worst.cell_centre * _MM),
            f"{np.median(found.ratio[number]):.2f}",
        )
    way = "along" if first.kind == "translation" else "about"
    note = f"{first.kind} {way} {first.frame} axes, {first.boundary}; ratio: in the median cell"
    return Group(table, Text(f"  {note}", "dim"))


def json_line(found: WorkspaceMap, out: str | None, seconds: float) -> str:
    """Return a map's summary as one line of strict JSON."""
    plan = found.plan
    record: dict[str, Any] = {
        "file": out,
        "robot": plan.robot.description.name,
        **plan.sampling.record(),
        "samples_evaluated": found.evaluated,
        "samples_without_equilibrium": found.lost,
        "cell_m": plan.cell,
        "cells": len(found.table),
        "reach_volume_m3": found.volume,
        "tip_low_m": _numbers(found.low),
        "tip_high_m": _numbers(found.high),
        "kind": plan.measures[0].kind,
        "boundary": plan.measures[0].boundary,
        "frame": plan.measures[0].frame,
        "stiffness_unit": plan.unit,
        "stiffnesses": [
            {
                "direction": list(measure.direction),
                "best": _extreme(found.best_in(number)),
                "worst": _extreme(found.worst_in(number)),
                "median_ratio": float(np.median(found.ratio[number])) if len(found.table) else None,
            }
            for number, measure in enumerate(plan.measures)
        ],
        "time_s": seconds,
    }
    return json.dumps(record, allow_nan=False)


def _extreme(extreme: Extreme | None) -> dict[str, Any] | None:
    if extreme is None:
        return None
    return {
        "stiffness": extreme.stiffness,
        "cell_centre_m": extreme.cell_centre.tolist(),
        "sample": extreme.sample,
        "pressures_pa": extreme.pressures.tolist(),
    }


def _numbers(values: Any) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]
