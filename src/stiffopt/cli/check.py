"""Options and help of the command `stiffopt check`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Quiet

CHECK_EPILOG = """\
\b
Examples:
  stiffopt check my-arm.yaml my-task.yaml
  stiffopt check problems/*.yaml --quiet

\b
Exit codes:
  0    no mistake
  2    a mistake, or a file that cannot be read
"""


@with_exit_code
def check(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="Any files of stiffopt.")],
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON object per file: file, kind, mistakes."),
    ] = False,
    quiet: Quiet = False,
) -> int:
    """Check files without using them: all mistakes at once, one per line, with file, line and key.

    A file is checked together with the files that it names; recordings (.csv, .mcap) are read. A
    rig file with a tracker has a mistake if 'stiffopt run' could never arm the rig. If one rig file
    is given, tasks for its robot must also suit its scene. Nothing is solved and no device is
    touched.
    """
    from stiffopt.cli.check_run import check_files  # here, so that --help waits for no numerics

    return check_files(files, as_json=as_json, quiet=quiet)
