"""What `stiffopt map arm` does: map the stiffness along an arm, print, write and draw it."""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from stiffopt.cli import quantities
from stiffopt.cli.console import ProgressBar, show, warnings_as_notes, write_json
from stiffopt.cli.exits import Interruptible, exit_code
from stiffopt.cli.outputs import check_ending, check_picture, check_writable
from stiffopt.cli.tables import number_table, title
from stiffopt.directions import direction_name
from stiffopt.documents import write_whole
from stiffopt.errors import InputError
from stiffopt.experiments.arm_map import ArmMap, TipMap, map_arm, map_tip
from stiffopt.model.compliance import Boundary, Frame
from stiffopt.model.manipulator import load_robot
from stiffopt.plots.wording import BAR, MM, figures


@dataclass(frozen=True)
class ArmOptions:
    """The arguments of the command, as they were given."""

    robot: str
    channels: list[str] | None
    pressures: str | None
    points: int | None
    over: str | None
    levels: int | None
    boundary: str
    frame: str
    plot: str | None
    csv: str | None
    as_json: bool
    quiet: bool


def run(options: ArmOptions) -> int:
    """Make a map; print, write and draw it; return the exit code."""

    def work() -> None:
        _check(options)
        progress = ProgressBar(quiet=options.quiet)
        quietly = warnings_as_notes(quiet=options.quiet)
        with Interruptible() as interruptible, progress.shown(), quietly:
            found = _mapped(options, progress, interruptible)
        if options.csv is not None:
            _write_csv(options.csv, found)
        if options.plot is not None:
            _draw(found, options.plot)
        if options.as_json:
            write_json(_record(found))
        elif not options.quiet:
            show(_arm_summary(found) if isinstance(found, ArmMap) else _tip_summary(found))

    return exit_code(work)


def _check(options: ArmOptions) -> None:
    check_picture(options.plot)
    if options.csv is not None:
        check_ending(options.csv, (".csv",))
        check_writable(options.csv)
    alone = {
        "--channels": options.channels, "--pressures": options.pressures,
        "--points": options.points,
    }  # fmt: skip
    for name, value in alone.items():
        if options.over is not None and value is not None:
            raise InputError(f"{name} has no meaning for a map over two pressures (--over)")
    if options.over is None and options.levels is not None:
        raise InputError("--levels is for a map over two pressures; give --over too")


def _mapped(options: ArmOptions, bar: ProgressBar, interruptible: Interruptible) -> ArmMap | TipMap:
    robot = load_robot(options.robot)
    boundary, frame = cast(Boundary, options.boundary), cast(Frame, options.frame)

    def progress(done: float, total: float) -> None:
        interruptible.check()
        bar.report(done, total, "stiffness")

    if options.over is not None:
        return map_tip(
            robot, quantities.channels("--over", options.over), levels=options.levels or 31,
            boundary=boundary, frame=frame, progress=progress,
        )  # fmt: skip
    groups = None
    if options.channels is not None:
        groups = [quantities.channels("--channels", text) for text in options.channels]
    pressures = None
    if options.pressures is not None:
        pressures = quantities.pressures("--pressures", options.pressures)
    return map_arm(
        robot, groups, pressures, points=options.points or 25, boundary=boundary, frame=frame,
        progress=progress,
    )  # fmt: skip


def _draw(found: ArmMap | TipMap, path: str) -> None:
    from stiffopt.plots import save_figure
    from stiffopt.plots.arm_map import plot_arm_map, plot_tip_map

    drawn = plot_arm_map(found) if isinstance(found, ArmMap) else plot_tip_map(found)
    save_figure(drawn, path)


# -- for people -----------------------------------------------------------------------------------


def _arm_summary(found: ArmMap) -> RenderableType:
    names = [direction_name(tuple(direction)) for direction in found.directions]
    headings = [f"{name}: {what}" for name in names for what in ("tip", "middle")]
    table = number_table("channels", "bar", *headings)
    middle = found.middle
    for group, stiffness in zip(found.groups, found.stiffness, strict=True):
        for level, values in zip(found.pressures, stiffness, strict=True):
            cells = [figures(values[at, k]) for k in range(len(names)) for at in (-1, middle)]
            table.add_row(",".join(map(str, group)), f"{level * BAR:.3g}", *cells)
    note = (
        f"N/m, {found.boundary}, axes of the {found.frame}; middle: at {found.at[middle] * MM:g} mm"
    )
    heading = title(f"{found.robot}: stiffness along the arm")
    return Group(heading, table, Text(f"  {note}", "dim"))


def _tip_summary(found: TipMap) -> RenderableType:
    a, b = found.channels
    table = number_table(
        "direction", "least", f"at p{a}, p{b} (bar)", "greatest", f"at p{a}, p{b} (bar)"
    )
    for k, direction in enumerate(found.directions):
        values = found.stiffness[:, :, k]
        cells = []
        for place in (np.argmin(values), np.argmax(values)):
            i, j = np.unravel_index(place, values.shape)
            at = f"{found.first[i] * BAR:.3g}, {found.second[j] * BAR:.3g}"
            cells += [figures(values[i, j]), at]
        table.add_row(direction_name(tuple(direction)), *cells)
    note = f"N/m, {found.boundary}, axes of the {found.frame}"
    heading = title(f"{found.robot}: stiffness of the tip over channels {a} and {b}")
    return Group(heading, table, Text(f"  {note}", "dim"))


# -- for programs ---------------------------------------------------------------------------------


def _record(found: ArmMap | TipMap) -> dict[str, Any]:
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


def _write_csv(path: str, found: ArmMap | TipMap) -> None:
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
