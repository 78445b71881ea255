"""Options and help of the command `stiffopt plan`."""

from typing import Annotated

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Json, Quiet, Units, ViewOption, option

PLAN_EPILOG = """\
\b
Examples:
  stiffopt plan --robot stiff-flop-2 --from '1, 0, 0, 1, 0, 0 bar' --to task.yaml --scene scene.yaml
  stiffopt plan --from here.yaml --to there.yaml --to elsewhere.yaml --slew '2 bar/s' --json

\b
Exit codes:
  0    a motion was found
  2    bad input: a file or an option is wrong
  3    no clear way was found, or an end of it is unreachable or not clear
  4    the planner failed
  130  interrupted (Ctrl-C)
"""


@with_exit_code
def plan(
    start: Annotated[str, option("A", "Pressures such as '0.2, 0, 0.3 bar', or a task.", "--from")],
    goals: Annotated[list[str], option("B", "The same; may be given several times.", "--to")],
    robot: Annotated[
        str | None,
        option("ROBOT", "A built-in robot or a robot file; by default that of the tasks."),
    ] = None,
    scene: Annotated[
        str | None, option("FILE.yaml", "A scene file, instead of the scene of the tasks.")
    ] = None,
    clearance: Annotated[
        str | None, option("LENGTH", "Required clearance, replaces the scene's: '2 mm'.")
    ] = None,
    slew: Annotated[
        str | None,
        option(
            "RATES",
            "Largest rates, one or one per channel, such as '2 bar/s'; in addition to the robot's.",
        ),
    ] = None,
    as_json: Json = False,
    out: Annotated[
        list[str] | None,
        option(
            "FILE.yaml|FILE.csv",
            "Write the motion to a result file or as CSV; may be given several times.",
        ),
    ] = None,
    plot: Annotated[
        str | None, option("FILE.png", "Draw the arm on its way, and its pressures.")
    ] = None,
    view: ViewOption = None,
    seed: Annotated[
        int, option("N", "Seed of the search; the same gives the same motion.", min=0)
    ] = 0,
    timeout: Annotated[str, option("TIME", "Give up after this time.")] = "10 s",
    units: Units = None,
    quiet: Quiet = False,
) -> int:
    """Find a motion from one configuration to another with the whole body clear of a scene all
    the way.

    The ends are pressures, proximal segment first, or task files; a task as a goal stands for any
    configuration that solves it. The motion reaches one of several goals. The pressures change no
    faster than the rates allow. A way that is not straight needs the extra 'plan'. If the goal is a
    task with 'brace', the arm comes to lean on its objects; if the start is one, it lets go first.
    """  # noqa: D205
    from stiffopt.cli.plan_run import PlanCommand  # here, so that --help waits for no numerics

    command = PlanCommand(robot, start, tuple(goals), scene, clearance, slew, seed, timeout)
    return command.run(as_json=as_json, out=tuple(out or ()), plot=plot, view=view, quiet=quiet)
