"""Report experiments: on the terminal, as a Markdown page, and as JSON."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from stiffopt.cli.tables import MarkdownPage, TextTable, labelled, title
from stiffopt.directions import direction_name
from stiffopt.display import FIGURES, display_units
from stiffopt.errors import printable
from stiffopt.experiments import (
    CoverageResult,
    KinematicsResult,
    KinematicsSettings,
    StiffnessResult,
)
from stiffopt.experiments.slope import SlopeEstimate
from stiffopt.logs import StiffnessTable
from stiffopt.model.manipulator import Manipulator
from stiffopt.rig.settings import Published


@dataclass(frozen=True)
class ExperimentReport:
    """The content of a report; the table `published` compares with published results."""

    title: str
    lines: tuple[tuple[str, str], ...]
    table: TextTable
    published: TextTable | None = None

    def renderable(self, folder: str) -> RenderableType:
        """Return the report for the terminal."""
        lines = [(label, printable(text)) for label, text in (*self.lines, ("folder", folder))]
        blocks = [title(self.title), labelled(lines), Text(""), self.table.renderable()]
        if self.published is not None:
            blocks += [Text(""), self.published.renderable()]
        return Group(*blocks)

    def write(self, folder: Path) -> None:
        """Write the report as a Markdown page into a folder."""
        page = MarkdownPage(folder, self.title)
        page.bullets([f"{label}: {text}" for label, text in self.lines])
        page.table(self.table)
        if self.published is not None:
            page.table(self.published)
        page.write()


def kinematics_report(
    result: KinematicsResult,
    coverage: CoverageResult | None,
    settings: KinematicsSettings,
    model: Manipulator,
    published: Published | None = None,
) -> ExperimentReport:
    """Return the report of a kinematics experiment, with its combined poses if it has any."""
    found: list[KinematicsResult | CoverageResult] = [result]
    length, pressure = display_units().length, display_units().pressure
    peaks = ", ".join(pressure.number(p, "g") for p in settings.pressures)
    lines = [
        ("model", f"{model.description.name}, {length.text(model.length, 'g')} long"),
        (
            "sequence",
            f"each of {settings.channels} channels to {peaks} {pressure}, {result.time[-1]:.0f} s",
        ),
        ("recordings", f"{result.repetitions}, {len(result.errors):,} samples compared"),
    ]
    doubts = list(result.doubts)
    heading: tuple[str, ...] = ("tip error", length.name, "% of length")
    remark = "distance of the model's tip from the measured one, at the measured pressures"
    if coverage is not None:
        found.append(coverage)
        low, high = (
            f"{round(pressure.of(p), 2 + pressure.more_decimals) + 0.0:g}"
            for p in (coverage.pressures.min(), coverage.pressures.max())
        )
        text = (
            f"{len(coverage.errors)} of {settings.poses}, all channels, {low} to {high} {pressure}"
            f"; the tip moved by {length.text(coverage.speed.mean(), '.2f')} in the last second"
        )
        lines.append(("combined poses", text))
        doubts += [f"combined poses: {doubt}" for doubt in coverage.doubts]
        heading += (f"combined: {length}", "% of length")
        remark += "; combined: at the end of each pose"
    elif settings.poses:
        doubts.append("no combined pose was held with the tip in sight")
    if result.repetitions > 1:
        text = f"differ by {length.text(result.repeatability, '.2f')} in the mean"
        lines.append(("repetitions", text))

    def row(label: str, errors: list[float]) -> tuple[str, ...]:
        cells = [(length.number(e, ".2f"), f"{e / result.length * 100:.1f}") for e in errors]
        return label, *(text for cell in cells for text in cell)

    return ExperimentReport(
        title=f"{settings.rig}: kinematics",
        lines=(*lines, *(("DOUBT", doubt) for doubt in doubts)),
        table=TextTable(
            "",
            heading,
            (
                row("mean", [each.mean for each in found]),
                row("95th percentile", [each.p95 for each in found]),
                row("largest", [each.worst for each in found]),
            ),
            remark,
        ),
        published=_errors_beside(result, published) if published is not None else None,
    )


def _errors_beside(result: KinematicsResult, published: Published) -> TextTable | None:
    """Return the errors along each axis beside the published ones."""
    if published.tip_error is None:
        return None
    length = display_units().length
    within = published.tip_error
    most = "-"
    if published.largest_tip_error is not None:
        most = length.number(published.largest_tip_error, "g")
    rows = []
    for axis, name in enumerate("xyz"):
        errors = np.abs(result.component_error[:, axis])
        errors = errors[np.isfinite(errors)]
        rows.append(
            (
                name,
                length.number(float(np.quantile(errors, 0.95)), ".2f"),
                length.number(float(errors.max()), ".2f"),
                f"{np.mean(errors <= within) * 100:.0f} %",
                length.number(within, "g"),
                most,
            )
        )
    return TextTable(
        f"Error of the model's tip along each axis in {length}, beside what was published",
        ("axis", "95 % below", "largest", "within", "published: mostly", "at most"),
        tuple(rows),
        "within: share of the time in which the error is not above what was mostly published",
    )


def kinematics_record(
    result: KinematicsResult,
    coverage: CoverageResult | None,
    settings: KinematicsSettings,
    model: Manipulator,
) -> dict[str, Any]:
    """Return the results of a kinematics experiment for JSON, in SI units."""

    def errors(found: KinematicsResult | CoverageResult) -> dict[str, float]:
        return {
            "mean_error_m": found.mean,
            "p95_error_m": found.p95,
            "max_error_m": found.worst,
        }

    combined: dict[str, Any] | None = None
    if coverage is not None:
        combined = {
            "poses": len(coverage.errors), **errors(coverage),
            "pressures_pa": coverage.pressures, "errors_m": coverage.errors,
            "speeds_m_per_s": coverage.speed, "doubts": coverage.doubts,
        }  # fmt: skip
    return {
        "rig": settings.rig,
        "model": model.description.name,
        "length_m": model.length,
        "repetitions": result.repetitions,
        "samples": len(result.errors),
        **errors(result),
        "repeatability_m": result.repeatability if result.repetitions > 1 else None,
        "doubts": result.doubts,
        "combined": combined,
    }


def stiffness_report(
    result: StiffnessResult, model: Manipulator, published: StiffnessTable | None = None
) -> ExperimentReport:
    """Return the report of a stiffness experiment, compared with a published table if given."""
    settings = result.settings
    names = [direction_name(direction) for direction in settings.directions]
    unit, pressure_unit = display_units().stiffness, display_units().pressure
    heading = [pressure_unit.name]
    for name in names:
        heading += [f"{name} ({unit})", "model"]
    rows = []
    for pressure in settings.pressures:
        row = [pressure_unit.number(pressure, "g")]
        for direction in settings.directions:
            cell = next(c for c in result.along(direction) if c.pressure == pressure)
            row += [_estimate(cell.estimate), unit.number(cell.model, FIGURES)]
        rows.append(tuple(row))
    return ExperimentReport(
        title=f"{settings.rig}: stiffness",
        lines=(
            ("model", f"{model.description.name}, boundary free"),
            ("channel", f"{settings.channel} of {settings.channels}"),
            ("repetitions", f"{settings.repetitions}"),
        ),
        table=TextTable(
            "",
            tuple(heading),
            tuple(rows),
            "+-: 95 % confidence interval of the mean over the repetitions",
        ),
        published=_stiffness_beside(result, published) if published is not None else None,
    )


def _stiffness_beside(result: StiffnessResult, published: StiffnessTable) -> TextTable | None:
    """Return measured and modelled stiffness beside the published one."""
    rows = []
    units = display_units()
    spread = published.others.get("repeatability_n_per_m", published.sigma)
    for row, cell in result.beside(published):
        known = float(published.stiffness[row])

        def off(value: float, known: float = known) -> str:
            return f"{(value / known - 1) * 100:+.0f} %"

        here = ("no contact", "-")
        if cell.estimate is not None:
            here = (_estimate(cell.estimate), off(cell.estimate.value))
        rows.append(
            (
                units.pressure.number(cell.pressure, "g"),
                direction_name(tuple(published.directions[row])),
                f"{units.stiffness.number(known)} +- {units.stiffness.number(float(spread[row]))}",
                *here,
                units.stiffness.number(cell.model, FIGURES),
                off(cell.model),
            )
        )
    if not rows:
        return None
    return TextTable(
        f"Stiffness in {units.stiffness}, beside what was published",
        (f"{units.pressure}", "along", "published", "measured here", "off by", "model", "off by"),
        tuple(rows),
        "off by: relative to the published value",
        words=("along",),
    )


def _estimate(estimate: SlopeEstimate | None) -> str:
    if estimate is None:
        return "no contact"
    unit = display_units().stiffness
    half = unit.number(estimate.half_width, ".2g")
    value = unit.number(estimate.value, FIGURES)
    if 0 < float(half) < math.inf:  # no more decimals than its half width has
        digits = max(1 - math.floor(math.log10(float(half))), 0)
        value = f"{unit.of(estimate.value):.{digits}f}"
    return f"{value} +- {half}"
