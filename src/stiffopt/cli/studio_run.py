"""Run `stiffopt studio`: open the page, and wait until a signal ends it."""

from __future__ import annotations

import os
import threading
import webbrowser
from contextlib import ExitStack, closing
from pathlib import Path

from stiffopt.cli.console import report_note, warnings_as_notes, write_line
from stiffopt.cli.exits import ENDING_SIGNALS, handled
from stiffopt.daemon.address import is_loopback
from stiffopt.errors import require_package

_TOKEN = "STIFFOPT_TOKEN"  # `stiffopt.Client` reads it too


def run(
    file: str,
    *,
    robot: str | None,
    map_file: str | None,
    token_file: str | None,
    host: str,
    port: int,
    browser: bool,
) -> None:
    """Show a file in the studio until a signal ends it."""
    require_package("viser", "studio")
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
        if browser:
            webbrowser.open(shown.url)
        over.wait()
