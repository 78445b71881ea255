"""Options and help of the command `stiffopt commission`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Json, Quiet, RigArgument, Units

COMMISSION_HELP = """\
Find out by small steps from rest whether a rig is as its files say: the first hour with a rig.

One channel after the other moves the tip by a few mm. That tells which channel moves what, how the
tracker's frame and its sensor are placed, how much, how fast and how tight the channels are, what
the gauges read and how the tip swings. It says what is wrong and what to change, keeps a record
that 'stiffopt run' checks before it arms, and draws a page. RIG is a rig file.
"""

COMMISSION_EPILOG = """\
\b
Examples:
  stiffopt commission my-rig.yaml
  stiffopt commission my-rig.yaml --quick
  stiffopt commission my-rig.yaml --out my-corrected-rig.yaml

\b
Exit codes:
  0    the rig fits its files
  2    bad input: a file, an option, or a rig that cannot do it; nothing has moved
  5    stopped by danger or a fault of the rig; the arm is vented
  6    the rig does not fit its files; the report says what to change
  130  interrupted (Ctrl-C); the arm is vented
"""


@with_exit_code
def commission(
    rig: RigArgument,
    fast: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="For every other day: less than a minute for six channels. Slow leaks, and "
            "creep, are not seen.",
        ),
    ] = False,
    out: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.yaml", help="Write the corrected rig file there, if there is one."
        ),
    ] = None,
    folder: Annotated[
        str | None,
        typer.Option(
            metavar="DIR",
            help="For recording, page and figure, made here; by default a new one in the rig's "
            "log folder.",
        ),
    ] = None,
    no_plot: Annotated[bool, typer.Option("--no-plot", help="Draw no figure.")] = False,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> int:
    """Commission a rig."""
    from stiffopt.cli import commission_run  # here, so that --help waits for no numerics

    return commission_run.run(
        rig, fast=fast, out=out, folder=folder, plot=not no_plot, as_json=as_json, quiet=quiet
    )
