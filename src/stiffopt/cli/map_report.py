"""Report maps: on the terminal, as JSON and as CSV."""

import csv
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from stiffopt.cli.tables import TextTable, labelled, title
from stiffopt.directions import direction_name
from stiffopt.display import FIGURES, display_units
from stiffopt.documents import write_whole
from stiffopt.errors import printable
from stiffopt.experiments.arm_map import ArmMap, TipMap
from stiffopt.plots.wording import vector_text
from stiffopt.workspace import Extreme, WorkspaceMap

# -- workspaces -----------------------------------------------------------------------------------


def workspace_summary(found: WorkspaceMap, out: str | None, seconds: float) -> RenderableType:
    """Return the report of a workspace, about 80 columns wide."""
    parts: list[RenderableType] = [title(out or "workspace"), labelled(_facts(found, seconds))]
    if len(found.table):
        parts += [Text(""), _stiffnesses(found)]
    return Group(*parts)


def _facts(found: WorkspaceMap, seconds: float) -> list[tuple[str, RenderableType]]:
    plan, robot = found.plan, found.plan.robot
    loaded = ", in equilibrium under gravity" if robot.is_loaded else ""
    record = plan.sampling.record()
    how = (
        f"grid of {record['levels']} levels of each channel"
        if "levels" in record
        else f"quasi-random, seed {record['seed']}"
    )
    facts: list[tuple[str, RenderableType]] = [
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
    unit = display_units().length
    extent = ", ".join(
        f"{axis} {unit.number(low, '.0f')} to {unit.text(high, '.0f')}"
        for axis, low, high in zip("xyz", found.low, found.high, strict=True)
    )
    facts += [
        ("reach", f"{found.volume * 1e6:,.0f} cm^3: {len(found.table):,} cells of "
         f"{unit.text(plan.cell, 'g')}, {np.median(found.count):g} samples in the median cell"),
        ("tip", extent),
    ]  # fmt: skip
    return facts


def _stiffnesses(found: WorkspaceMap) -> RenderableType:
    first = found.plan.measures[0]
    unit, length = display_units().of_si(found.plan.unit), display_units().length
    at = f"at ({length})"
    rows = []
    for number, name in enumerate(found.direction_names):
        best, worst = found.best_in(number), found.worst_in(number)
        if best is None or worst is None:
            continue
        cells = []
        for extreme in (best, worst):
            place = vector_text(extreme.cell_centre, length)
            cells += [unit.number(extreme.stiffness, FIGURES), place]
        rows.append((name, *cells, f"{np.median(found.ratio[number]):.2f}"))
    way = "along" if first.kind == "translation" else "about"
    return TextTable(
        "",
        (unit.name, "stiffest", at, "softest", at, "ratio"),
        tuple(rows),
        f"{first.kind} {way} {first.frame} axes, {first.boundary}; ratio: in the median cell",
    ).renderable()


def workspace_record(found: WorkspaceMap, out: str | None, seconds: float) -> dict[str, Any]:
    """Return the summary of a workspace for JSON, in SI units."""
    plan = found.plan
    return {
        "file": out,
        "robot": plan.robot.description.name,
        **plan.sampling.record(),
        "samples_evaluated": found.evaluated,
        "samples_without_equilibrium": found.lost,
        "cell_m": plan.cell,
        "cells": len(found.table),
        "reach_volume_m3": found.volume,
        "tip_low_m": found.low,
        "tip_high_m": found.high,
        "kind": plan.measures[0].kind,
        "boundary": plan.measures[0].boundary,
        "frame": plan.measures[0].frame,
        "stiffness_unit": plan.unit,
        "stiffnesses": [
            {
                "direction": measure.direction,
                "best": _extreme(found.best_in(number)),
                "worst": _extreme(found.worst_in(number)),
                "median_ratio": float(np.median(found.ratio[number])) if len(found.table) else None,
            }
            for number, measure in enumerate(plan.measures)
        ],
        "time_s": seconds,
    }


def _extreme(extreme: Extreme | None) -> dict[str, Any] | None:
    if extreme is None:
        return None
    return {
        "stiffness": extreme.stiffness,
        "cell_centre_m": extreme.cell_centre,
        "sample": extreme.sample,
        "pressures_pa": extreme.pressures,
    }


# -- stiffness along an arm, and of its tip over two pressures -------------------------------------


def summary(found: ArmMap | TipMap) -> RenderableType:
    """Return the report of a map for the terminal."""
    return _arm_summary(found) if isinstance(found, ArmMap) else _tip_summary(found)


def _arm_summary(found: ArmMap) -> RenderableType:
    names = [direction_name(tuple(direction)) for direction in found.directions]
    headings = [f"{name}: {what}" for name in names for what in ("tip", "middle")]
    middle, units = found.middle, display_units()
    rows = []
    for group, stiffness in zip(found.groups, found.stiffness, strict=True):
        for level, values in zip(found.pressures, stiffness, strict=True):
            cells = [
                units.stiffness.number(values[place, k], FIGURES)
                for k in range(len(names))
                for place in (-1, middle)
            ]
            pressure = units.pressure.number(level, ".3g")
            rows.append((",".join(map(str, group)), pressure, *cells))
    note = (
        f"{units.stiffness}, {found.boundary}, axes of the {found.frame}; middle: at "
        f"{units.length.text(found.at[middle], 'g')}"
    )
    table = TextTable("", ("channels", units.pressure.name, *headings), tuple(rows), note)
    return Group(title(f"{found.robot}: stiffness along the arm"), table.renderable())


def _tip_summary(found: TipMap) -> RenderableType:
    a, b = found.channels
    unit, pressure = display_units().stiffness, display_units().pressure
    at = f"at p{a}, p{b} ({pressure})"
    rows = []
    for k, direction in enumerate(found.directions):
        values = found.stiffness[:, :, k]
        cells = []
        for place in (np.argmin(values), np.argmax(values)):
            i, j = np.unravel_index(place, values.shape)
            pair = (pressure.number(p, ".3g") for p in (found.first[i], found.second[j]))
            cells += [unit.number(values[i, j], FIGURES), ", ".join(pair)]
        rows.append((direction_name(tuple(direction)), *cells))
    note = f"{unit}, {found.boundary}, axes of the {found.frame}"
    table = TextTable("", ("direction", "least", at, "greatest", at), tuple(rows), note)
    heading = title(f"{found.robot}: stiffness of the tip over channels {a} and {b}")
    return Group(heading, table.renderable())


def record(found: ArmMap | TipMap) -> dict[str, Any]:
    """Return a map for JSON, in SI units."""
    common = {
        "robot": found.robot,
        "directions": found.directions,
        "boundary": found.boundary,
        "frame": found.frame,
        "stiffness_n_per_m": found.stiffness,
    }
    if isinstance(found, ArmMap):
        return {
            "map": "arm",
            "channels": found.groups,
            "pressures_pa": found.pressures,
            "at_m": found.at,
            "positions_m": found.positions,
            **common,
        }
    return {
        "map": "tip",
        "channels": found.channels,
        "first_pa": found.first,
        "second_pa": found.second,
        "others_pa": found.others,
        **common,
    }


def write_csv(path: str, found: ArmMap | TipMap) -> None:
    """Write a map as a table, in SI units."""
    rows = _arm_rows(found) if isinstance(found, ArmMap) else _tip_rows(found)
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_whole(path, text.getvalue().encode())


def _arm_rows(found: ArmMap) -> Iterator[list[str]]:
    yield ["channels", "pressure_pa", "at_m", "x_m", "y_m", "z_m", *_stiffness_columns(found)]
    for g, group in enumerate(found.groups):
        for i, level in enumerate(found.pressures):
            for j, at in enumerate(found.at):
                numbers = [level, at, *found.positions[g, i, j], *found.stiffness[g, i, j]]
                yield [" ".join(map(str, group)), *(f"{number:.9g}" for number in numbers)]


def _tip_rows(found: TipMap) -> Iterator[list[str]]:
    a, b = found.channels
    yield [f"p{a}_pa", f"p{b}_pa", *_stiffness_columns(found)]
    for i, first in enumerate(found.first):
        for j, second in enumerate(found.second):
            yield [f"{number:.9g}" for number in (first, second, *found.stiffness[i, j])]


def _stiffness_columns(found: ArmMap | TipMap) -> list[str]:
    return [f"stiffness_{direction_name(tuple(d))}_n_per_m" for d in found.directions]
