"""Options and help of the command `solve-pressure`, also `stiffopt solve`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Quiet, SeedOption, Units, Version, ViewOption, option

EXAMPLES = """\
\b
Examples:
  {command} problems/two_segment_stiff_x.yaml
  {command} problems/
  {command} --json problems/*.yaml | jq .stiffness
  {command} task.yaml --out answer.yaml --plot answer.png
  {command} task.yaml --pareto 12 --plot trade-off.png
  {command} task.yaml --suggest-post post.png --post-force '0.2 N'

\b
Exit codes (of several files the most serious: 2, then 4, then 3):
  0    all solved
  2    bad input: a file or an option is wrong
  3    a target is unreachable; the closest configuration is reported
  4    the solver failed
  130  interrupted (Ctrl-C)

\b
A task file:
  format: stiffopt-task/1
  robot: stiff-flop-2
  target: {{position: [-30 mm, 10 mm, 190 mm]}}
  stiffness: {{maximise: {{direction: [1, 0, 0]}}}}
"""


@with_exit_code
def solve(
    tasks: Annotated[
        list[str], typer.Argument(metavar="TASK", help="Task files, or folders of them.")
    ],
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print one JSON object per task and line, in SI units, instead of a table. "
            "A task with bad input has no line.",
        ),
    ] = False,
    out: Annotated[
        str | None,
        option(
            "FILE.yaml",
            "Write the answers to a result file. Only another result file is overwritten.",
        ),
    ] = None,
    plot: Annotated[
        str | None,
        option(
            "FILE.png", "Draw the arm and its pressures; of several tasks, each in FILE-<task>.png."
        ),
    ] = None,
    view: ViewOption = None,
    pareto: Annotated[
        int | None,
        option(
            "N",
            "Trade tip error against stiffness, at N tolerances from the task's own upwards.",
            min=2,
            max=1000,
        ),
    ] = None,
    suggest_post: Annotated[
        str | None,
        option(
            "FILE.png",
            "Find where a post or a wall would make the arm stiffest, and draw a map of it; of "
            "several tasks, each in FILE-<task>.png.",
        ),
    ] = None,
    post_force: Annotated[
        str | None,
        option("FORCE", "Largest contact force on such a post or wall; 0.3 N unless given."),
    ] = None,
    seed: SeedOption = 0,
    units: Units = None,
    quiet: Quiet = False,
    version: Version = False,
) -> int:
    """Find the chamber pressures that reach a tip pose and meet its stiffness goal best.

    Each TASK is a task file, or a folder whose task files (*.yaml) are solved in the order of their
    names. Subfolders are ignored; files in a folder whose format is another, such as robot files,
    are skipped with a note. An invalid file is reported on stderr, and the others are still solved.
    """
    from stiffopt.cli.solve_run import TaskBatch  # here, so that --help waits for no numerics

    return TaskBatch(as_json, out, plot, pareto, seed, quiet, view, suggest_post, post_force).run(
        tasks
    )
