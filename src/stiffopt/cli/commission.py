"""Options and help of the command `stiffopt commission`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Json, NoPlot, Quiet, RigArgument, Units, option

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
            help="For every other day: hold the steps only briefly, less than a minute for six "
            "channels. Slow leaks and creep go unnoticed.",
        ),
    ] = False,
    out: Annotated[
        str | None,
        option("FILE.yaml", "Write a corrected rig file, if there is something to correct."),
    ] = None,
    folder: Annotated[
        str | None,
        option(
            "DIR",
            "New folder for recording, page and figure; by default a new one in the rig's "
            "log folder.",
        ),
    ] = None,
    no_plot: NoPlot = False,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> int:
    """Check by small steps from rest whether a rig matches its files: the first hour with a rig.

    One channel after another moves the tip by a few mm. This shows which chambers each channel
    fills, where the tracker's frame and its sensor are, the gain, delay and leaks of the channels,
    errors of the gauges, and the swing of the tip. The report says what is wrong and what to
    change. The command also writes a record that 'stiffopt run' checks before it arms, and draws a
    page. RIG is a rig file.
    """
    from stiffopt.cli import commission_run  # here, so that --help waits for no numerics

    return commission_run.run(
        rig, fast=fast, out=out, folder=folder, plot=not no_plot, as_json=as_json, quiet=quiet
    )
