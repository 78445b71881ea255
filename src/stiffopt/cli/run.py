"""Options and help of the command `stiffopt run`."""

import sys
from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import RigArgument, Units, option

RUN_EPILOG = """\
\b
Examples:
  stiffopt run rig/sim-two-segment.yaml
  stiffopt run rig/sim.yaml --task task.yaml --arm
  stiffopt run rig/sim.yaml --task task.yaml --arm --no-service --duration '20 s'
  stiffopt run rig/sim.yaml --play motion.csv --arm --duration '20 s'
  stiffopt run rig/palpation.yaml --task problems/two_segment_palpation.yaml --arm \\
    --no-service --duration '25 s' --plot palpation.png

\b
Exit codes:
  0    ended by a signal or after --duration; vented
  2    bad input, a device that does not answer, a port in use, a missing library, not fit to arm
  5    ended in the state fault; vented, unless it says otherwise
"""


@with_exit_code
def run(
    rig: RigArgument,
    task: Annotated[
        str | None, option("TASK", "A task file to pursue once armed; needs --arm.")
    ] = None,
    play: Annotated[
        str | None,
        option(
            "FILE",
            "What 'stiffopt path --out' or 'plan --out' wrote, to play once armed; needs --arm.",
        ),
    ] = None,
    arm: Annotated[
        bool, typer.Option("--arm", help="Arm as soon as the tracker sees the tip: the arm MOVES.")
    ] = False,
    duration: Annotated[str | None, option("TIME", "End after this time, such as '20 s'.")] = None,
    no_service: Annotated[
        bool,
        typer.Option("--no-service", help="Open no port: no control interface, no Foxglove."),
    ] = False,
    log_folder: Annotated[
        str | None, option("FOLDER", "Record here, not where the rig file says.")
    ] = None,
    plot: Annotated[
        str | None,
        option("FILE.png", "Draw the run into this file (.png, .pdf, .svg) when it has ended."),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Print lines for people, no live status.")
    ] = False,
    units: Units = None,
    json_lines: Annotated[
        bool, typer.Option("--json-lines", help="Print JSON lines on a terminal too.")
    ] = False,
) -> int:
    """Hold an arm at its task in closed loop: run the daemon of a rig in the foreground.

    It connects to the devices of RIG, vents, checks everything and waits, vented, for a client
    ('stiffopt.Client', or HTTP). With --arm it arms by itself and pursues TASK, or plays a motion:
    the arm goes to its first point, follows it and stays at its end. A separate process, the guard,
    owns the supply, and vents when the daemon is killed, stopped or hangs.

    On a terminal it shows a live status; otherwise it prints one JSON object per line. Ctrl-C,
    SIGTERM or closing the terminal lower the pressures and vent; a second Ctrl-C vents at once.
    """
    if plain and json_lines:
        raise typer.BadParameter("give --plain or --json-lines, not both")
    from stiffopt.cli.run_daemon import run  # here, so that --help waits for no numerics

    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    style = "plain" if plain else "live" if is_terminal and not json_lines else "json"
    return run(
        rig, task=task, play=play, arm=arm, duration=duration, service=not no_service,
        log_folder=log_folder, plot=plot, style=style,
    )  # fmt: skip
