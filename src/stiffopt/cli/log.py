"""The commands `stiffopt log export` and `stiffopt log plot`: a recorded run as CSV or figure."""

from pathlib import Path
from typing import Annotated

import typer

from stiffopt.cli.console import report_note, write_line
from stiffopt.cli.exits import interruptible, with_exit_code
from stiffopt.cli.options import Units, command_group, option
from stiffopt.cli.outputs import check_new_file, check_new_folder, check_picture, new_folder
from stiffopt.errors import FileError, require_package

log_app = command_group(help="Look at what 'stiffopt run' has recorded.")

_CODES = """
\b
Exit codes:
  0    done
  2    bad input: no recording, no complete data in it, or the file cannot be written
  130  interrupted (Ctrl-C)
"""

_EXPORT_EPILOG = f"""\
\b
Examples:
  stiffopt log export runs/my-rig-20270115T080000Z.mcap --csv
  stiffopt log export run.mcap --csv --out run.csv
  stiffopt log export run.mcap --bag --out run_bag
{_CODES}"""

_PLOT_EPILOG = f"""\
\b
Examples:
  stiffopt log plot runs/my-rig-20270115T080000Z.mcap
  stiffopt log plot run.mcap --out run.pdf
{_CODES}"""

Recorded = Annotated[str, typer.Argument(metavar="RUN", help="A recording (.mcap).")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]


@log_app.command(
    "export", short_help="Write a recording as CSV or as a bag of ROS 2.", epilog=_EXPORT_EPILOG
)
@with_exit_code
def export(
    run: Recorded,
    csv: Annotated[bool, typer.Option("--csv", help="As CSV, log v1: the default.")] = False,
    bag: Annotated[
        bool, typer.Option("--bag", help="As a bag of ROS 2: a folder with MCAP and metadata.")
    ] = False,
    out: Annotated[
        str | None,
        option("FILE.csv", "Write here, or into this folder; otherwise next to the recording."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write a recording as CSV (log v1), for 'stiffopt calibrate', or as a bag of ROS 2.

    In CSV each row is a frame of the tracker, at the time of its capture, with the commanded and
    measured pressures of that moment; nothing is estimated. Rows without a tip are from times in
    which the tracker gave no credible reading. A bag (--bag, rosbag2 with MCAP) has the topics that
    'stiffopt ros' publishes, and needs the extra 'ros'. RUN is a recording (.mcap), complete or
    truncated; for CSV it may also be that of an experiment.
    """
    if csv and bag:
        raise typer.BadParameter("give --csv or --bag, not both")
    if bag:
        _export_bag(run, out, quiet=quiet)
        return
    with interruptible() as check:
        import numpy as np  # here, so that --help waits for no numerics

        from stiffopt.daemon.run_log import read_log_of_recording
        from stiffopt.logs import write_log

        path = str(Path(run).with_suffix(".csv")) if out is None else out
        check_new_file(path, (".csv",))
        log, whole = read_log_of_recording(run)
        if not len(log):
            raise FileError(run, "has no row to export; it was truncated too early")
        write_log(path, log)
        check()
    if quiet:
        return
    if not whole:
        report_note(f"{run} was truncated or damaged; its complete part was exported")
    seen = int(np.isfinite(log.tip_position).all(axis=1).sum())
    write_line(f"{path}: {len(log)} rows, {seen} with a tip, {log.time[-1] - log.time[0]:.1f} s")


def _export_bag(run: str, out: str | None, *, quiet: bool) -> None:
    """Write a recorded run as a bag."""
    with interruptible() as check:
        from stiffopt.daemon.run_log import read_run

        require_package("cyclonedds", "ros")
        from stiffopt.ros.bag import write_bag

        path = str(Path(run).with_suffix("")) + "_bag" if out is None else out
        check_new_folder(path)
        recorded = read_run(run)
        with new_folder(path) as part:
            assert part is not None
            count = write_bag(recorded, part, Path(path).name, check)
    if quiet:
        return
    if not recorded.complete:
        report_note(f"{run} was truncated or damaged; its complete part was exported")
    write_line(f"{path}: {count} messages, {recorded.time[-1] - recorded.time[0]:.1f} s")


@log_app.command("plot", short_help="Draw a run on a page.", epilog=_PLOT_EPILOG)
@with_exit_code
def plot(
    run: Recorded,
    out: Annotated[
        str | None,
        option(
            "FILE.png", "Draw into this file (.png, .pdf, .svg); by default next to the recording."
        ),
    ] = None,
    units: Units = None,
    quiet: Quiet = False,
) -> None:
    """Draw a run on a page: target and tip, error, pressures, stiffness, states, alarms and events.

    Errors on the way to a target and errors at it are reported separately: the tip is at the target
    once it has come within 1 mm and 1 deg.

    RUN is a recording (.mcap) of 'stiffopt run', complete or truncated.
    """
    with interruptible() as check:
        from stiffopt.daemon.run_log import read_run
        from stiffopt.plots import save_figure
        from stiffopt.plots.run import error_lines, plot_run

        path = str(Path(run).with_suffix(".png")) if out is None else out
        recorded = read_run(run)
        check_picture(path)
        if not recorded.complete and not quiet:
            report_note(f"{run} was truncated or damaged; its complete part was drawn")
        save_figure(plot_run(recorded), path)
        check()
    if not quiet:
        for line in error_lines(recorded):
            write_line(line)
        write_line(path)
