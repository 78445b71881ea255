"""The commands `stiffopt log export` and `stiffopt log plot`: their options and help."""

from typing import Annotated

import typer

log_app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Look at what 'stiffopt run' has recorded.",
)

_CODES = """
\b
Exit codes:
  0    done
  2    bad input: no recording, nothing whole in it, or the answer cannot be written
  130  interrupted (Ctrl-C)
"""

EXPORT_HELP = """\
Write a recording as CSV (log v1), from which 'stiffopt calibrate' can calibrate.

Each row is a frame of the tracker, at the time at which it was captured, with the pressures that
were commanded and measured then; nothing that was estimated. Rows without a tip are from times in
which the tracker saw nothing that can be believed. RUN is a recording (.mcap), whole or cut short,
also one of an experiment.
"""

_EXPORT_EPILOG = f"""\
\b
Examples:
  stiffopt log export runs/my-rig-20270115T080000Z.mcap --csv
  stiffopt log export run.mcap --csv --out run.csv
{_CODES}"""

PLOT_HELP = """\
Draw a run on a page: target and tip, error, pressures, stiffness, states, alarms and events.

RUN is a recording (.mcap) of 'stiffopt run', whole or cut short.
"""

_PLOT_EPILOG = f"""\
\b
Examples:
  stiffopt log plot runs/my-rig-20270115T080000Z.mcap
  stiffopt log plot run.mcap --out run.pdf
{_CODES}"""

Recorded = Annotated[str, typer.Argument(metavar="RUN", help="A recording (.mcap).")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]


@log_app.callback()
def _log() -> None:
    pass


@log_app.command("export", help=EXPORT_HELP, epilog=_EXPORT_EPILOG)
def export(
    run: Recorded,
    csv: Annotated[bool, typer.Option("--csv", help="As CSV, log v1: the only format yet.")] = True,
    out: Annotated[
        str | None,
        typer.Option(metavar="FILE.csv", help="Write here; by default beside the recording."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Export a recording."""
    from stiffopt.cli import log_run  # here, so that --help waits for no numerics

    raise typer.Exit(log_run.export(run, out, quiet=quiet))


@log_app.command("plot", help=PLOT_HELP, epilog=_PLOT_EPILOG)
def plot(
    run: Recorded,
    out: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.png",
            help="Draw into this file (.png, .pdf, .svg); by default beside the recording.",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Draw a recording."""
    from stiffopt.cli import log_run

    raise typer.Exit(log_run.plot(run, out, quiet=quiet))
