"""What an experiment has found, for people: on the terminal and as Markdown."""

from dataclasses import dataclass
from math import isfinite
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.errors import printable
from stiffopt.experiments import (
    CoverageResult,
    KinematicsResult,
    KinematicsSettings,
    StiffnessResult,
)
from stiffopt.experiments.slope import Estimate
from stiffopt.experiments.stiffness import direction_name
from stiffopt.model.manipulator import Manipulator
from stiffopt.plots.wording import figures

_BAR = 1e-5  # per Pa
_MM = 1e3  # per m


@dataclass(frozen=True)
class Facts:
    """A title, lines of label and text, and a table with its heading and a remark."""

    title: str
    lines: tuple[tuple[str, str], ...]
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    remark: str


def kinematics_facts(
    result: KinematicsResult,
    coverage: CoverageResult | None,
    settings: KinematicsSettings,
    model: Manipulator,
) -> Facts:
    """Return what a kinematics experiment has found, in the combined poses too if there are any."""
    found: list[KinematicsResult | CoverageResult] = [result]

    def row(label: str, errors: list[float]) -> tuple[str, ...]:
        cells = [(f"{e * _MM:.2f}", f"{e / result.length * 100:.1f}") for e in errors]
        return label, *(text for cell in cells for text in cell)

    peaks = ", ".join(f"{p * _BAR:g}" for p in settings.pressures)
    heading: tuple[str, ...] = ("tip error", "mm", "% of length")
    remark = "distance of the model's tip from the measured one, at the measured pressures"
    if coverage is not None:
        found.append(coverage)
        heading += ("combined: mm", "% of length")
        remark += "; combined: at the end of each pose"
    return Facts(
        title=f"{settings.rig}: kinematics",
        lines=(
            ("model", f"{model.description.name}, {model.length * _MM:g} mm long"),
            (
                "sequence",
                f"each of {settings.channels} channels to {peaks} bar, {result.time[-1]:.0f} s",
            ),
            ("recordings", f"{result.repetitions}, {len(result.errors):,} samples compared"),
            *_combined(coverage, settings),
            *_spread(result),
            *(("DOUBT", doubt) for doubt in result.doubts),
            *_combined_doubts(coverage, settings),
        ),
        heading=heading,
        rows=(
            row("mean", [each.mean for each in found]),
            row("95th percentile", [each.p95 for each in found]),
            row("largest", [each.worst for each in found]),
        ),
        remark=remark,
    )


def kinematics_record(
    result: KinematicsResult,
    coverage: CoverageResult | None,
    settings: KinematicsSettings,
    model: Manipulator,
) -> dict[str, Any]:
    """Return what a kinematics experiment has found, for JSON, in SI units."""

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
            "pressures_pa": coverage.pressures.tolist(), "errors_m": coverage.errors.tolist(),
            "speeds_m_per_s": coverage.speed.tolist(), "doubts": list(coverage.doubts),
        }  # fmt: skip
    spread = result.repeatability
    return {
        "rig": settings.rig,
        "model": model.description.name,
        "length_m": model.length,
        "repetitions": result.repetitions,
        "samples": len(result.errors),
        **errors(result),
        "repeatability_m": spread if result.repetitions > 1 and isfinite(spread) else None,
        "doubts": list(result.doubts),
        "combined": combined,
    }


def _combined(
    coverage: CoverageResult | None, settings: KinematicsSettings
) -> tuple[tuple[str, str], ...]:
    if coverage is None:
        return ()
    low, high = coverage.pressures.min() * _BAR, coverage.pressures.max() * _BAR
    return (
        (
            "combined poses",
            f"{len(coverage.errors)} of {settings.poses}, all channels, {_bar(low)} to "
            f"{_bar(high)} bar; the tip moved by {coverage.speed.mean() * _MM:.2f} mm in the last "
            "second",
        ),
    )


def _bar(value: float) -> str:
    return f"{round(value, 2) + 0.0:g}"


def _combined_doubts(
    coverage: CoverageResult | None, settings: KinematicsSettings
) -> tuple[tuple[str, str], ...]:
    if coverage is not None:
        return tuple(("DOUBT", f"combined poses: {doubt}") for doubt in coverage.doubts)
    if settings.poses:
        return (("DOUBT", "no combined pose was held with the tip in sight"),)
    return ()


def _spread(result: KinematicsResult) -> tuple[tuple[str, str], ...]:
    if result.repetitions < 2:
        return ()
    return (("repetitions", f"differ by {result.repeatability * _MM:.2f} mm in the mean"),)


def stiffness_facts(result: StiffnessResult, model: Manipulator) -> Facts:
    """Return what a stiffness experiment has found."""
    settings = result.settings
    names = [direction_name(direction) for direction in settings.directions]
    heading = ["bar"]
    for name in names:
        heading += [f"{name} (N/m)", "model"]
    rows = []
    for pressure in settings.pressures:
        row = [f"{pressure * _BAR:g}"]
        for direction in settings.directions:
            cell = next(c for c in result.along(direction) if c.pressure == pressure)
            row += [_estimate(cell.estimate), figures(cell.model)]
        rows.append(tuple(row))
    return Facts(
        title=f"{settings.rig}: stiffness",
        lines=(
            ("model", f"{model.description.name}, boundary free"),
            ("channel", f"{settings.channel} of {settings.channels}"),
            ("repetitions", f"{settings.repetitions}"),
        ),
        heading=tuple(heading),
        rows=tuple(rows),
        remark="+-: 95 % confidence of the mean over the repetitions",
    )


def _estimate(estimate: Estimate | None) -> str:
    if estimate is None:
        return "no contact"
    return f"{figures(estimate.value)} +- {estimate.half_width:.2g}"


def markdown(facts: Facts) -> str:
    """Return facts as a Markdown page."""
    lines = [f"# {facts.title}", ""]
    lines += [f"- {label}: {text}" for label, text in facts.lines]
    lines += ["", f"| {' | '.join(facts.heading)} |", f"|{' --- |' * len(facts.heading)}"]
    lines += [f"| {' | '.join(row)} |" for row in facts.rows]
    lines += ["", f"{facts.remark[:1].upper()}{facts.remark[1:]}.", ""]
    return "\n".join(lines)


def renderable(facts: Facts, folder: str) -> RenderableType:
    """Return facts for the terminal."""
    grid = Table.grid(padding=(0, 2), pad_edge=False)
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    for label, text in (*facts.lines, ("folder", folder)):
        grid.add_row(f"  {label}", printable(text))
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="bold")
    for number, heading in enumerate(facts.heading):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in facts.rows:
        table.add_row(*row)
    title = Text(printable(facts.title), "bold")
    return Group(title, grid, Text(""), table, Text(f"  {facts.remark}", "dim"))
