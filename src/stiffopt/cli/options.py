"""Options that several commands share, and the application to which commands are added."""

from typing import Annotated, Any

import typer

from stiffopt.cli.console import report_error
from stiffopt.cli.exits import BAD_INPUT
from stiffopt.errors import InputError


def command_group(**settings: Any) -> typer.Typer:
    """Return an application to which commands are added.

    Its help has no rich markup: paths may contain brackets, and help may be piped.
    """
    always = {"pretty_exceptions_enable": False, "rich_markup_mode": None}
    return typer.Typer(**{"add_completion": False, **always, **settings})


def print_version(wanted: bool) -> None:
    """Print the version and exit, if wanted."""
    if wanted:
        from stiffopt import __version__

        typer.echo(f"stiffopt {__version__}")
        raise typer.Exit


def show_in_units(text: str | None) -> str | None:
    """Choose the units of tables, figures and messages by an option or the environment."""
    from stiffopt.display import choose_units, display_units  # here: --help waits for no numbers

    try:
        choose_units(text)
        display_units()
    except InputError as error:
        report_error(str(error) if text is None else f"--units: {error}")
        raise typer.Exit(BAD_INPUT) from None
    return text


def option(metavar: str, about: str, *names: str, **limits: Any) -> Any:
    """Return an option with a value; by default its name is that of the parameter."""
    return typer.Option(*names, metavar=metavar, help=about, **limits)


Version = Annotated[
    bool,
    typer.Option(
        "--version", callback=print_version, is_eager=True, help="Print the version and exit."
    ),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print no tables, notes and progress; errors only.")
]
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object in SI units instead of a table.")
]
RobotArgument = Annotated[
    str, typer.Argument(metavar="ROBOT", help="A built-in robot, or a robot file (.yaml).")
]
RigArgument = Annotated[str, typer.Argument(metavar="RIG", help="A rig file (.yaml).")]
Units = Annotated[
    str | None,
    option(
        "UNITS",
        "Units of tables, figures and messages, such as 'mm, kPa, N/mm'; also by the variable "
        "STIFFOPT_UNITS. JSON stays SI.",
        "--units",
        callback=show_in_units,
    ),
]
PressuresOption = Annotated[
    str, option("LIST", "Pressures of all channels, proximal segment first: '0.2, 0, 0.3 bar'.")
]
SeedOption = Annotated[
    int, option("N", "Seed of the global search; the same gives the same answer.", min=0)
]
TimeoutOption = Annotated[str | None, option("TIME", "Stop after this time, as by Ctrl-C.")]
NoPlot = Annotated[bool, typer.Option("--no-plot", help="Draw no figure.")]
BoundaryOption = Annotated[str, option("BOUNDARY", "free, guided or clamped: how the tip is held.")]
FrameOption = Annotated[str, option("FRAME", "base or tip: the axes of the directions.")]
ViewOption = Annotated[
    str | None,
    option(
        "ANGLES",
        "Viewpoint of --plot: elevation, and azimuth about z from x; by default '14 deg, -66 deg', "
        "of an arm that hangs '14 deg, 66 deg'.",
    ),
]
