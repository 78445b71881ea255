"""The commands `stiffopt map workspace` and `stiffopt map arm`: their options and their help."""

from typing import Annotated

import typer

from stiffopt.cli.options import (
    BoundaryOption,
    FrameOption,
    Json,
    Quiet,
    RobotArgument,
    command_group,
)

map_app = command_group(
    help="Map an arm: where its tip can be, how stiff it is there, and how stiff along its length."
)

_CODES = """
\b
Exit codes:
  0    the map is complete
  2    bad input, or the map cannot be made or written
  130  interrupted (Ctrl-C)
"""

HELP = """\
Sample the pressures of an arm and map its workspace.

Space is divided into cells. For each cell that the tip reaches the map holds how many samples did,
and for each direction the greatest and the least stiffness that they have, with the pressures.
ROBOT is the name of a built-in robot or a robot file. With --out, the map is kept as a Zarr group;
the same command continues a run that was interrupted.
"""

_EPILOG = f"""\
\b
Examples:
  stiffopt map workspace stiff-flop-2 --out map.zarr --samples 10000000 --plot map.png
  stiffopt map workspace my-arm.yaml --levels 6 --cell '5 mm' --direction x --direction 0,1,1
  stiffopt map workspace stiff-flop-3 --out map.zarr --scheduler tcp://10.0.0.5:8786
{_CODES}"""


@map_app.command("workspace", help=HELP, epilog=_EPILOG)
def workspace(
    robot: RobotArgument,
    out: Annotated[
        str | None,
        typer.Option(metavar="FILE.zarr", help="Keep the map in this folder, a Zarr group."),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Number of quasi-random samples; by default a million, with gravity 1000.",
        ),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option(
            metavar="K", min=2, help="Instead: all combinations of K levels of each channel."
        ),
    ] = None,
    cell: Annotated[str, typer.Option(metavar="LENGTH", help="Size of a cell.")] = "10 mm",
    direction: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DIR",
            help="x, y, z or a,b,c: direction of a stiffness; may be repeated. By default x, y, z.",
        ),
    ] = None,
    kind: Annotated[
        str, typer.Option(metavar="KIND", help="translation or rotation.")
    ] = "translation",
    boundary: BoundaryOption = "free",
    frame: FrameOption = "base",
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of the quasi-random samples.")] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Have the workers of this Dask scheduler do it."),
    ] = None,
    plot: Annotated[
        str | None,
        typer.Option(metavar="FILE.png", help="Draw sections through the workspace."),
    ] = None,
    as_json: Json = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a map that is in the folder of --out.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Map a workspace."""
    from stiffopt.cli.map_workspace import (  # here, so that --help waits for no numerics
        WorkspaceOptions,
        run,
    )

    options = WorkspaceOptions(
        robot, out, samples, levels, cell, direction, kind, boundary, frame, seed, scheduler,
        plot, as_json, overwrite, quiet,
    )  # fmt: skip
    raise typer.Exit(run(options))


ARM_HELP = """\
Map the stiffness along an arm, from near its base to its tip, as in figure 6 of the paper.

Groups of channels are pressurised to several pressures: by default the first pair of each segment,
then the first two. With --over 1,2 instead the stiffness of the tip over the pressures of these two
channels. ROBOT is the name of a built-in robot or a robot file.
"""

_ARM_EPILOG = f"""\
\b
Examples:
  stiffopt map arm stiff-flop-1 --plot arm.png
  stiffopt map arm stiff-flop-2 --channels 1 --channels 4 --pressures '0:1.5:0.5 bar'
  stiffopt map arm stiff-flop-1 --over 1,2 --plot tip.png --csv tip.csv
{_CODES}"""


@map_app.command("arm", help=ARM_HELP, epilog=_ARM_EPILOG)
def arm(
    robot: RobotArgument,
    channels: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LIST",
            help="Channels (counted from 1) that are pressurised together, such as 1 or 1,2; may "
            "be repeated.",
        ),
    ] = None,
    pressures: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="To which: '0,0.5,1 bar' or '0:1.5:0.5 bar'; by default seven up to the limit.",
        ),
    ] = None,
    points: Annotated[
        int | None, typer.Option(metavar="N", min=2, help="Along the arm; by default 25.")
    ] = None,
    over: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="Instead: the tip over the pressures of two channels."),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option(metavar="K", min=2, help="With --over: of each channel; by default 31."),
    ] = None,
    boundary: BoundaryOption = "free",
    frame: FrameOption = "base",
    plot: Annotated[str | None, typer.Option(metavar="FILE.png", help="Draw the map.")] = None,
    csv: Annotated[
        str | None, typer.Option(metavar="FILE.csv", help="Write the map as a table, in SI units.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Map the stiffness along an arm."""
    from stiffopt.cli.map_arm import ArmOptions, run

    options = ArmOptions(
        robot, channels, pressures, points, over, levels, boundary, frame, plot, csv, as_json,
        quiet,
    )  # fmt: skip
    raise typer.Exit(run(options))
