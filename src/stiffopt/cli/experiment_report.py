"""What an experiment has found, for people: on the terminal and as Markdown."""

from dataclasses import dataclass

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.errors import printable
from stiffopt.experiments import KinematicsResult, KinematicsSettings, StiffnessResult
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
    result: KinematicsResult, settings: KinematicsSettings, model: Manipulator
) -> Facts:
    """Return what a kinematics experiment has found."""

    def row(label: str, error: float) -> tuple[str, ...]:
        return label, f"{error * _MM:.2f}", f"{error / result.length * 100:.1f}"

    peaks = ", ".join(f"{p * _BAR:g}" for p in settings.pressures)
    return Facts(
        title=f"{settings.rig}: kinematics",
        lines=(
            ("model", f"{model.description.name}, {model.length * _MM:g} mm long"),
            (
                "sequence",
                f"each of {settings.channels} channels to {peaks} bar, {result.time[-1]:.0f} s",
            ),
            ("recordings", f"{result.repetitions}, {len(result.errors):,} samples compared"),
            *_spread(result),
            *(("DOUBT", doubt) for doubt in result.doubts),
        ),
        heading=("tip error", "mm", "% of length"),
        rows=(
            row("mean", result.mean),
            row("95th percentile", result.p95),
            row("largest", result.worst),
        ),
        remark="distance of the model's tip from the measured one, at the measured pressures",
    )


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
