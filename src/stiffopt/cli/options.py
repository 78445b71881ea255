"""Options that several commands share, and how commands are grouped."""

from typing import Annotated, Any

import typer


def command_group(**settings: Any) -> typer.Typer:
    """Return an application to which commands are added.

    Its help has no rich markup: a path may hold brackets, and help is read in pipes too.
    """
    always = {"pretty_exceptions_enable": False, "rich_markup_mode": None}
    return typer.Typer(**{"add_completion": False, **always, **settings})


def print_version(wanted: bool) -> None:
    """Print the version and exit, if that is wanted."""
    if wanted:
        from stiffopt import __version__

        typer.echo(f"stiffopt {__version__}")
        raise typer.Exit


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
BoundaryOption = Annotated[
    str, typer.Option(metavar="BOUNDARY", help="free, guided or clamped: how the tip is held.")
]
FrameOption = Annotated[
    str, typer.Option(metavar="FRAME", help="base or tip: the axes of the directions.")
]
ViewOption = Annotated[
    str | None,
    typer.Option(
        metavar="ANGLES",
        help="From where --plot looks: elevation and azimuth about z from x, '20 deg, -60 deg'.",
    ),
]
