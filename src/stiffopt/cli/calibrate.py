"""Options and help of the commands `stiffopt calibrate` and `stiffopt validate`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Json, Quiet, TimeoutOption, Units, option

_CODES = """
\b
Exit codes:
  0    done
  2    bad input, or a file cannot be written; nothing is written
"""
_UNFIT = """\
  4    the fit misses its own logs by more than 10 % of the arm's length: it is marked as unfit
"""

CALIBRATE_EPILOG = f"""\
\b
Examples:
  stiffopt calibrate --robot my-arm.yaml run/*.csv --out my-arm-calibrated.yaml
  stiffopt calibrate --robot my-arm.yaml monday.csv --stiffness run/stiffness.csv --out fitted.yaml
  stiffopt calibrate --robot asu-two-segment apr4_*.csv --sequence --out asu.yaml --report fit
  stiffopt calibrate --robot arm.yaml run/*.csv --out fitted.yaml --suggest next.yaml --rig rig.yaml
{_CODES}{_UNFIT}\
  130  interrupted (Ctrl-C, or --timeout is over): the best model so far is written, if there is
       one; Ctrl-C twice: nothing is
"""

VALIDATE_EPILOG = f"""\
\b
Examples:
  stiffopt validate --robot my-arm-calibrated.yaml tuesday.csv
  stiffopt validate --robot my-arm-calibrated.yaml tuesday_*.csv --sequence --report tuesday
{_CODES}\
  130  interrupted (Ctrl-C); nothing is written
"""

Robot = Annotated[str, option("ROBOT", "A built-in robot, or a robot file (.yaml).")]
Sequence = Annotated[
    bool,
    typer.Option(
        "--sequence",
        help="The logs follow each other: each begins in the state that the previous one led to, "
        "after the pause by their times, or a minute if these begin anew. Without it, each log's "
        "initial state is estimated.",
    ),
]
Rezero = Annotated[
    bool,
    typer.Option(
        "--rezero", help="The origin of positions differs from log to log: fit a shift for each."
    ),
]
Beginning = Annotated[
    str | None,
    option(
        "TIME",
        "How much of the beginning of a log that is only predicted tells its initial state and, "
        "with --rezero, its shift; by default 2 s.",
    ),
]
Pressures = Annotated[
    str, option("WHICH", "commanded or measured: the pressures that drive the model.")
]
Channels = Annotated[
    str | None,
    option(
        "LIST",
        "For each channel of the robot its pressure column in the logs, such as 4,5,6,1,2,3; "
        "by default as the robot file says, else in order.",
    ),
]
Frame = Annotated[
    str | None,
    option(
        "BODY",
        "The tracked body that carries the base; poses are taken in its frame. By default as "
        "the robot file says, else the tracker itself.",
    ),
]
Keep = Annotated[
    list[str] | None,
    option(
        "WHAT",
        "units, clock, drift, axes, channels or lines: leave these as recorded, even if they "
        "are clearly wrong; may be repeated.",
    ),
]
Report = Annotated[
    str | None, option("DIR", "Write a page (report.md) with figures into this new folder.")
]


@with_exit_code
def calibrate(
    robot: Robot,
    out: Annotated[str, option("FILE.yaml", "Write the calibrated robot file; a new one.")],
    logs: Annotated[
        list[str] | None, typer.Argument(metavar="[LOG]...", show_default=False)
    ] = None,
    stiffness: Annotated[
        list[str] | None,
        option(
            "TABLE.csv",
            "A table of measured stiffness, fitted too; may be repeated. LOGs may then be absent.",
        ),
    ] = None,
    model: Annotated[
        str,
        option(
            "NAME",
            "auto, or one of static, lag, hysteresis, creep, progressive, progressive-creep, "
            "channel-hysteresis, elongation-hysteresis.",
        ),
    ] = "auto",
    strain_law: Annotated[
        str,
        option(
            "WHICH",
            "auto: another strain law than the robot file's, if that predicts clearly better; "
            "or keep.",
        ),
    ] = "auto",
    fix: Annotated[
        list[str] | None,
        option(
            "KEY",
            "Do not fit this: a key of the robot file, such as segments[0].length, or its end "
            "alone, such as corrections.gain, for all segments and channels; may be repeated.",
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="A first answer, within about a minute: one model, with hysteresis unless --model "
            "says another, fitted to few rows; models and strain laws are not compared, and "
            "nothing is held back.",
        ),
    ] = False,
    timeout: TimeoutOption = None,
    sequence: Sequence = False,
    rezero: Rezero = False,
    beginning: Beginning = None,
    pressures: Pressures = "commanded",
    channels: Channels = None,
    frame: Frame = None,
    keep: Keep = None,
    rows: Annotated[
        int | None,
        option(
            "N", "Number of fitted rows of all logs together; by default 2000.", min=50, max=100_000
        ),
    ] = None,
    suggest: Annotated[
        str | None,
        option(
            "FILE.yaml",
            "Write the poses to record next, which would reduce the model's uncertainty most, "
            "as a file for `stiffopt experiment poses`; with --rig.",
        ),
    ] = None,
    rig: Annotated[
        str | None, option("RIG", "The rig file of the poses that --suggest writes.")
    ] = None,
    report: Report = None,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> int:
    """Fit a robot file to recordings of the arm, and report how well each number in it is known.

    The fit begins at the values of the robot file; its tolerances are their expected errors.
    Several models are fitted. The one that predicts held-back data best is taken; of equally good
    ones, the simplest. Each LOG is a recording, log v1 (.csv) or MCAP (.mcap); give them in the
    order in which they were made.
    """
    from stiffopt.cli import calibrate_run  # here, so that --help waits for no numerics

    recordings = calibrate_run.RecordingOptions(
        robot, tuple(logs or ()), sequence, rezero, beginning, pressures, channels, frame,
        tuple(keep or ()),
    )  # fmt: skip
    return calibrate_run.run_calibrate(
        recordings, out, tables=stiffness or (), model=model, strain_law=strain_law, fix=fix or (),
        rows=rows, quick=quick, timeout=timeout, suggest=suggest, rig=rig, report=report,
        as_json=as_json, quiet=quiet,
    )  # fmt: skip


@with_exit_code
def validate(
    robot: Robot,
    logs: Annotated[list[str], typer.Argument(metavar="LOG...", show_default=False)],
    sequence: Sequence = False,
    rezero: Rezero = False,
    beginning: Beginning = None,
    pressures: Pressures = "commanded",
    channels: Channels = None,
    frame: Frame = None,
    keep: Keep = None,
    report: Report = None,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> None:
    """Measure how well a robot file predicts recordings that it was not fitted to.

    The model is run along the commanded pressures of each LOG, a recording, log v1 (.csv) or MCAP
    (.mcap), and compared with the measured tip. Nothing of the robot is fitted.
    """
    from stiffopt.cli import calibrate_run

    recordings = calibrate_run.RecordingOptions(
        robot, tuple(logs), sequence, rezero, beginning, pressures, channels, frame,
        tuple(keep or ()),
    )  # fmt: skip
    calibrate_run.run_validate(recordings, report, as_json=as_json, quiet=quiet)
