"""Options and help of the command `stiffopt path`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Quiet, SeedOption, Units, ViewOption, option

PATH_EPILOG = """\
\b
Examples:
  stiffopt path problems/paths/path_line_stiff_x.yaml
  stiffopt path --json path.yaml | jq .stiffness
  stiffopt path path.yaml --out answer.yaml --out answer.csv --plot answer.png

\b
Exit codes (of several files the most serious: 2, then 4, then 3):
  0    all solved
  2    bad input: a file or an option is wrong
  3    a path cannot be followed; the nearest one that can is reported
  4    the solver failed
  130  interrupted (Ctrl-C)

\b
A path file:
  format: stiffopt-path/1
  robot: stiff-flop-2
  path: {line: {from: [-30 mm, -20 mm, 190 mm], to: [-30 mm, 20 mm, 190 mm]}}
  points: 41
  timing: {speed: 10 mm/s}
  stiffness: {maximise: {direction: [1, 0, 0], frame: base, over: worst}}
"""


@with_exit_code
def path(
    paths: Annotated[list[str], typer.Argument(metavar="PATH", help="Path files.")],
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print one JSON object per path and line, in SI units, instead of a table. "
            "A path with bad input has no line.",
        ),
    ] = False,
    out: Annotated[
        list[str] | None,
        option(
            "FILE.yaml|FILE.csv",
            "Write the answers to a result file or as CSV; may be given several times. Of "
            "several paths, each has a FILE-<path>.csv. Only results are overwritten.",
        ),
    ] = None,
    plot: Annotated[
        str | None,
        option(
            "FILE.png",
            "Draw the arm along the path, its stiffness and its pressures; of several paths, "
            "each in FILE-<path>.png.",
        ),
    ] = None,
    view: ViewOption = None,
    seed: SeedOption = 0,
    units: Units = None,
    quiet: Quiet = False,
) -> int:
    """Find the pressures with which the tip follows a path, as stiff as possible along it.

    Each PATH is a path file. The pressures change no faster than their rates allow, and the whole
    body keeps clear of the scene. An invalid file is reported on stderr, and the others are still
    solved.
    """
    from stiffopt.cli.path_run import PathBatch  # here, so that --help waits for no numerics

    return PathBatch(as_json, tuple(out or ()), plot, seed, quiet, view).run(paths)
