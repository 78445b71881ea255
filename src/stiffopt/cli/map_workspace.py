"""What `stiffopt map workspace` does: make or continue a map, print it, draw it."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Any, cast

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from stiffopt.cli import quantities
from stiffopt.cli.console import ProgressBar, report_note, show, warnings_as_notes, write_json
from stiffopt.cli.exits import InterruptBetweenSteps, exit_code
from stiffopt.cli.outputs import check_picture
from stiffopt.cli.tables import labelled, number_table, title
from stiffopt.errors import printable
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.manipulator import load_robot
from stiffopt.plots.wording import MM, figures, unit_text, vector_text
from stiffopt.workspace import Extreme, WorkspaceMap, map_workspace


@dataclass(frozen=True)
class WorkspaceOptions:
    """The arguments of the command, as they were given."""

    robot: str
    out: str | None
    samples: int | None
    levels: int | None
    cell: str
    directions: list[str] | None
    kind: str
    boundary: str
    frame: str
    seed: int
    scheduler: str | None
    plot: str | None
    as_json: bool
    overwrite: bool
    quiet: bool


def run(options: WorkspaceOptions) -> int:
    """Make a map, or continue one; print and draw it; return the exit code."""

    def work() -> None:
        check_picture(options.plot)
        begin = perf_counter()
        found = _mapped(options)
        seconds = perf_counter() - begin
        if options.out is not None and not found.evaluated and not options.quiet:
            report_note(f"{options.out} is complete; there was nothing left to sample")
        if options.as_json:
            write_json(_record(found, options.out, seconds))
        elif not options.quiet:
            show(_summary(found, options.out, seconds))
        if options.plot is not None:
            from stiffopt.plots import save_figure
            from stiffopt.plots.workspace import plot_workspace

            save_figure(plot_workspace(found), options.plot)

    return exit_code(work)


def _mapped(options: WorkspaceOptions) -> WorkspaceMap:
    directions = None
    if options.directions is not None:
        directions = [quantities.direction("--direction", text) for text in options.directions]
    cell = quantities.quantity("--cell", options.cell, "m", "length")
    robot = load_robot(options.robot)
    progress = _Progress(quiet=options.quiet, out=options.out)
    with progress.shown(), warnings_as_notes(quiet=options.quiet):
        return map_workspace(
            robot, options.out, directions=directions, kind=cast(Kind, options.kind),
            boundary=cast(Boundary, options.boundary), frame=cast(Frame, options.frame),
            samples=options.samples, levels=options.levels, cell=cell, seed=options.seed,
            scheduler=options.scheduler, overwrite=options.overwrite, progress=progress.report,
        )  # fmt: skip


class _Progress:
    """Progress of a map, and Ctrl-C, which ends it where it can be continued."""

    def __init__(self, *, quiet: bool, out: str | None) -> None:
        self._quiet, self._out = quiet, out
        self._bar = ProgressBar(quiet=quiet)
        self._interrupt = InterruptBetweenSteps([signal.SIGINT])
        self._samples: tuple[int, int] | None = None

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Context in which progress is shown, and Ctrl-C ends the work between two steps."""
        try:
            with self._interrupt.handled(), self._bar.shown():
                yield
        except KeyboardInterrupt:
            self._say_how_to_resume()
            raise

    def report(self, done: int, total: int) -> None:
        """Show how many of the samples are done; raise KeyboardInterrupt if Ctrl-C was pressed."""
        is_first, self._samples = self._samples is None, (done, total)
        self._interrupt.check()
        if is_first and done and not self._quiet:
            report_note(f"{self._out} goes on after {done:,} of {total:,} samples")
        self._bar.report(done, total, f"{done:,} of {total:,} samples")

    def _say_how_to_resume(self) -> None:
        if self._quiet or self._samples is None:
            return
        done, total = self._samples
        report_note(
            f"stopped after {done:,} of {total:,} samples; "
            + (
                f"the same command goes on with {self._out}"
                if self._out
                else "nothing was kept: with --out a run can be resumed"
            )
        )


# -- for people -----------------------------------------------------------------------------------


def _summary(found: WorkspaceMap, out: str | None, seconds: float) -> RenderableType:
    """The report of a map, about 80 columns wide."""
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
    extent = ", ".join(
        f"{axis} {low * MM:.0f} to {high * MM:.0f} mm"
        for axis, low, high in zip("xyz", found.low, found.high, strict=True)
    )
    facts += [
        ("reach", f"{found.volume * 1e6:,.0f} cm^3: {len(found.table):,} cells of "
         f"{plan.cell * MM:g} mm, {np.median(found.count):g} samples in the median cell"),
        ("tip", extent),
    ]  # fmt: skip
    return facts


def _stiffnesses(found: WorkspaceMap) -> RenderableType:
    plan = found.plan
    first = plan.measures[0]
    unit = unit_text(plan.unit)
    table = number_table(unit, "stiffest", "at (mm)", "softest", "at (mm)", "ratio")
    for number, name in enumerate(found.direction_names):
        best, worst = found.best_in(number), found.worst_in(number)
        if best is None or worst is None:
            continue
        table.add_row(
            name,
            figures(best.stiffness),
            vector_text(best.cell_centre * MM),
            figures(worst.stiffness),
            vector_text(worst.cell_centre * MM),
            f"{np.median(found.ratio[number]):.2f}",
        )
    way = "along" if first.kind == "translation" else "about"
    note = f"{first.kind} {way} {first.frame} axes, {first.boundary}; ratio: in the median cell"
    return Group(table, Text(f"  {note}", "dim"))


# -- for programs ---------------------------------------------------------------------------------


def _record(found: WorkspaceMap, out: str | None, seconds: float) -> dict[str, Any]:
    """A map's summary for JSON, in SI units."""
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
