"""Whole figures: an answer, a trade-off."""

import os
import tempfile
from collections.abc import Sequence
from io import BytesIO
from math import degrees
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

from stiffopt.errors import FileError, InputError, printable, require_package
from stiffopt.model.manipulator import Manipulator
from stiffopt.optimise.solution import PressureSolution
from stiffopt.plots.arm import draw_arm
from stiffopt.plots.panels import draw_pareto, draw_pressures
from stiffopt.plots.wording import direction_text, figures, gain_text, unit_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 130
_LONGEST_NOTE = 120  # characters of the message that fit


def require_matplotlib() -> None:
    """Say how to get matplotlib if it is missing.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    require_package("matplotlib", "plot")


def plot_solution(
    robot: Manipulator,
    solution: PressureSolution,
    *,
    front: Sequence[PressureSolution] | None = None,
    plain: float | None = None,
    title: str | None = None,
) -> "Figure":
    """Draw an answer: the arm in space, and its pressures against their limits.

    Parameters
    ----------
    robot : Manipulator
        The arm; the load of the solution's task is put on it.
    solution : PressureSolution
    front : sequence of PressureSolution, optional
        A trade-off to draw beside it, as `stiffopt.pareto_front` returns it.
    plain : float, optional
        First stiffness of a stiffness-blind solution, to compare with.
    title : str, optional
        By default the name of the task's file.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        If the solution has no pressures, as the solver failed.
    MissingExtraError
        If matplotlib is not installed.
    """
    require_matplotlib()
    if solution.pressures is None:
        raise InputError("there is nothing to draw: the solution has no pressures")
    from matplotlib.figure import Figure

    load = solution.task.load
    arm = robot.with_load(load.force, load.moment, load.frame) if load else robot
    figure = Figure(figsize=(13, 6.6 if front is None else 7.8))
    grid = figure.add_gridspec(
        1 if front is None else 2, 3, width_ratios=(0.42, 1.15, 1), left=0.03, right=0.975,
        top=0.825, bottom=0.09, wspace=0.2, hspace=0.42,
    )  # fmt: skip
    draw_arm(figure, grid[:, 1], arm, solution)
    draw_pressures(figure.add_subplot(grid[0, 2]), arm, solution)
    if front is not None:
        draw_pareto(figure.add_subplot(grid[1, 2]), front, plain)
    _head(figure, solution, title or _name(solution), plain)
    return figure


def plot_pareto(
    front: Sequence[PressureSolution], *, plain: float | None = None, title: str | None = None
) -> "Figure":
    """Draw a trade-off: stiffness against tip error.

    Parameters
    ----------
    front : sequence of PressureSolution
        As `stiffopt.pareto_front` returns it.
    plain : float, optional
        First stiffness of a stiffness-blind solution, to compare with.
    title : str, optional

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.add_subplot()
    draw_pareto(axes, front, plain)
    if title:
        axes.set_title(_literal(title))
    return figure


def save_figure(figure: "Figure", path: str | os.PathLike[str]) -> None:
    """Write a figure in the format that the path's ending names; whole or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    target = Path(path)
    buffer = BytesIO()
    try:
        figure.savefig(buffer, format=target.suffix[1:].lower() or "png", dpi=_DPI)
        with tempfile.TemporaryDirectory(
            prefix=f".{target.name}.", dir=target.resolve().parent
        ) as folder:
            part = Path(folder) / "part"
            part.write_bytes(buffer.getvalue())
            part.replace(target.resolve())
    except OSError as error:
        raise FileError(path, f"cannot be written: {(error.strerror or '').lower()}") from None
    except ValueError as error:  # a format that matplotlib does not know
        raise FileError(path, f"cannot be drawn: {error}") from None


def _name(solution: PressureSolution) -> str:
    source = solution.task.source
    return solution.task.robot if source is None else source.stem


def _head(figure: "Figure", solution: PressureSolution, title: str, plain: float | None) -> None:
    """Title, and below it the numbers that matter."""
    colours = {"solved": "#2a7f3f", "unreachable": "#b35c00", "failed": "#b00020"}
    figure.text(0.03, 0.945, _literal(title), fontsize=15, weight="bold", va="center")
    figure.text(
        0.975, 0.945, solution.status, fontsize=13, weight="bold", va="center", ha="right",
        color=colours[solution.status],
    )  # fmt: skip
    figure.text(0.03, 0.895, _key_numbers(solution, plain), fontsize=10.5, va="center")
    if solution.message:
        message = shorten(printable(solution.message), _LONGEST_NOTE, placeholder=" ...")
        figure.text(0.03, 0.858, _literal(message), fontsize=9.5, va="center", style="italic")


def _key_numbers(solution: PressureSolution, plain: float | None) -> str:
    tolerance = solution.task.target.tolerance
    parts = []
    if solution.position_error is not None:
        parts.append(
            f"tip error {solution.position_error * 1e3:.3g} mm "
            f"(tolerance {tolerance.position * 1e3:g} mm)"
        )
    if solution.angle_error is not None:
        parts.append(
            f"{degrees(solution.angle_error):.3g} deg (tolerance {degrees(tolerance.angle):g} deg)"
        )
    if solution.stiffness is not None:
        measure = solution.task.measures[0]
        compared = (
            ""
            if plain is None
            else f" (plain: {figures(plain)}, {gain_text(solution.stiffness, plain)})"
        )
        parts.append(
            f"stiffness {figures(solution.stiffness)} {unit_text(measure.unit)}{compared} "
            f"{direction_text(measure)}"
        )
    if solution.matrix_distance is not None:
        parts.append(f"{solution.matrix_distance:.3g} from the matrix to match")
    return "      ".join(parts)


def _literal(text: str) -> str:
    """Return text that matplotlib does not take for mathematics."""
    return printable(text).replace("$", r"\$")
