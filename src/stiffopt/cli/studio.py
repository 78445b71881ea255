"""The command `stiffopt studio`: open the page, and wait until a signal ends it."""

import os
import threading
import webbrowser
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import typer

from stiffopt.cli.console import report_note, warnings_as_notes, write_line
from stiffopt.cli.exits import ENDING_SIGNALS, handled, with_exit_code
from stiffopt.cli.options import Units, option
from stiffopt.errors import require_package

_TOKEN = "STIFFOPT_TOKEN"  # `stiffopt.Client` reads it too

STUDIO_EPILOG = """\
\b
Examples:
  stiffopt studio
  stiffopt studio my-arm.yaml
  stiffopt studio problems/two_segment_stiff_x.yaml

\b
Exit codes:
  0    ended by Ctrl-C or a signal
  2    bad input: a file or an option is wrong, a port in use, a missing library
"""


@with_exit_code
def studio(
    file: Annotated[str, typer.Argument(metavar="[FILE]", help="What is shown.")] = "stiff-flop-2",
    robot: Annotated[
        str | None, option("ROBOT", "For a FILE that names none; else stiff-flop-2.")
    ] = None,
    map_file: Annotated[
        str | None, option("MAP.zarr", "Show a workspace map, coloured by stiffness.", "--map")
    ] = None,
    token_file: Annotated[
        str | None, option("FILE", "With a RIG: the daemon's token, to command; or STIFFOPT_TOKEN.")
    ] = None,
    units: Units = None,
    host: Annotated[
        str, option("HOST", "Address to listen on; the default admits only this machine.")
    ] = "127.0.0.1",
    port: Annotated[int, option("PORT", "Port; 0 takes any free one.", min=0, max=65535)] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print the address.")
    ] = False,
) -> None:
    """Open a page in the browser that shows a robot and a task, to be changed by hand.

    FILE is a built-in robot, or a robot, task or scene file: drag the target and the arm follows,
    with its pressures and its stiffness. A path file, a motion (.csv of 'stiffopt plan') and a
    recording (.csv, .mcap) are played. A rig file shows the arm of its running daemon; with the
    daemon's token the page can also command it. The page is for this machine, and only the printed
    address opens it. Needs the extra 'studio'.
    """
    require_package("viser", "studio")
    from stiffopt.daemon.address import is_loopback  # here, so that --help waits for no numerics
    from stiffopt.studio.opening import open_studio

    token = Path(token_file) if token_file else os.environ.get(_TOKEN) or None
    over = threading.Event()
    end = dict.fromkeys(ENDING_SIGNALS, lambda number, frame: over.set())
    with warnings_as_notes(quiet=False), ExitStack() as stack:
        shown = open_studio(file, robot=robot, map_file=map_file, token=token, host=host, port=port)
        stack.enter_context(closing(shown))
        stack.enter_context(handled(end))  # only now: what takes long before is ended by Ctrl-C
        write_line(f"the studio is open at {shown.url}")
        write_line("Ctrl-C ends it")
        if not is_loopback(host):
            report_note(
                f"other machines can reach {host}, unencrypted: who can listen in on the network "
                "can open the page too"
            )
        if not no_browser:
            webbrowser.open(shown.url)
        over.wait()
