"""Options and help of the commands `stiffopt experiment ...`."""

from typing import Annotated

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Json, NoPlot, Quiet, RigArgument, Units, command_group, option

experiment_app = command_group(help="Do the paper's experiments on a rig, real or simulated.")

_CODES = """
\b
Exit codes:
  0    done
  2    bad input: a file, an option, or a rig that cannot do it; nothing has moved
  5    stopped by a fault of the rig; what was recorded is kept
  130  interrupted (Ctrl-C); the arm is vented, what was recorded is kept
"""

_KINEMATICS_EPILOG = f"""\
\b
Examples:
  stiffopt experiment kinematics rig/sim.yaml
  stiffopt experiment kinematics rig/sim.yaml --pressures '0.5,1 bar' --repetitions 2 --out first
  stiffopt experiment kinematics rig/sim.yaml --poses 48 --max '1.2 bar'
  stiffopt experiment kinematics rig/sim.yaml --resume first
{_CODES}"""

_STIFFNESS_EPILOG = f"""\
\b
Examples:
  stiffopt experiment stiffness rig/sim.yaml
  stiffopt experiment stiffness rig/sim.yaml --pressures '0:1.5:0.5 bar' --repetitions 2 --out k
  stiffopt experiment stiffness rig/sim.yaml --resume k
{_CODES}"""

Out = Annotated[
    str | None,
    option(
        "DIR",
        "New folder of the experiment; by default a new one in the rig's log folder.",
    ),
]
Resume = Annotated[
    str | None, option("DIR", "Continue the experiment in this folder with what is missing.")
]
Model = Annotated[
    str | None, option("ROBOT", "Compare with this robot instead of that of the rig file.")
]
Repetitions = Annotated[
    int | None, option("N", "Repetitions of all; by default 5.", min=1, max=1000)
]


@experiment_app.command(
    "kinematics",
    short_help="Press each channel in turn, and record the tip.",
    epilog=_KINEMATICS_EPILOG,
)
@with_exit_code
def kinematics(
    rig: RigArgument,
    out: Out = None,
    pressures: Annotated[
        str | None,
        option("LIST", "Peaks of the teeth: '0.4,0.8,1.0 bar' (the default) or '0.2:1:0.2 bar'."),
    ] = None,
    period: Annotated[
        str | None, option("TIME", "Period of a tooth, up and down; by default 40 s / 9.")
    ] = None,
    repetitions: Repetitions = None,
    poses: Annotated[
        int | None,
        option(
            "N",
            "Poses of all channels together after that; by default 24, 0 for none.",
            min=0,
            max=1000,
        ),
    ] = None,
    settle: Annotated[
        str | None,
        option("TIME", "Longest time to come to rest in each of these poses; by default 7 s."),
    ] = None,
    most: Annotated[
        str | None,
        option(
            "PRESSURE",
            "Highest pressure of a channel in these poses; by default the rig's limits.",
            "--max",
        ),
    ] = None,
    resume: Resume = None,
    model: Model = None,
    no_plot: NoPlot = False,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> None:
    """Ramp each channel in turn up and down and record the tip, as in Experiment 1 of the paper.

    Each channel has a tooth for each pressure; the whole sequence is repeated. Then come poses in
    which all channels are pressurised together, for a calibration. Recordings (log v1 as CSV, and
    MCAP), a report and figures against the model go into a folder. RIG is a rig file.
    """
    from stiffopt.cli import experiment_run  # here, so that --help waits for no numerics

    given = {
        "pressures": pressures, "period": period, "repetitions": repetitions, "poses": poses,
        "settle": settle, "max": most,
    }  # fmt: skip
    experiment_run.run(
        "kinematics", rig, given, out=out, resume=resume, model=model, plot=not no_plot,
        as_json=as_json, quiet=quiet,
    )  # fmt: skip


@experiment_app.command(
    "stiffness",
    short_help="Push the tip with a probe at several pressures.",
    epilog=_STIFFNESS_EPILOG,
)
@with_exit_code
def stiffness(
    rig: RigArgument,
    out: Out = None,
    pressures: Annotated[
        str | None,
        option(
            "LIST", "Pressures of the channel: '0:1.5:0.25 bar' (the default) or '0,0.5,1 bar'."
        ),
    ] = None,
    channel: Annotated[
        int | None, option("N", "The channel to pressurise; by default 1.", min=1)
    ] = None,
    directions: Annotated[
        str | None,
        option("LIST", "Directions of the probe, of x, y, z, -x, -y, -z; by default x,y,-z."),
    ] = None,
    displacement: Annotated[
        str | None, option("LENGTH", "Displacement of the tip; by default 3 mm.")
    ] = None,
    force: Annotated[
        str | None,
        option(
            "FORCE",
            "Reduce the displacement if the model predicts more force; by default 0.2 N.",
        ),
    ] = None,
    steps: Annotated[
        int | None, option("N", "Steps each way; by default 5.", min=2, max=1000)
    ] = None,
    repetitions: Repetitions = None,
    settle: Annotated[
        str | None, option("TIME", "Longest time to come to rest; by default 60 s.")
    ] = None,
    resume: Resume = None,
    model: Model = None,
    no_plot: NoPlot = False,
    units: Units = None,
    quiet: Quiet = False,
) -> None:
    """Push the tip with a probe at several pressures, as in Experiment 2 of the paper.

    At each pressure of one channel the probe displaces the tip along each direction in steps, there
    and back; the slope of the force is the stiffness. Recordings, all points, a table of stiffness
    with its uncertainty, a report and a figure against the model go into a folder. RIG is a rig
    file.
    """
    from stiffopt.cli import experiment_run

    given = {
        "pressures": pressures, "channel": channel, "directions": directions,
        "displacement": displacement, "force": force, "steps": steps, "repetitions": repetitions,
        "settle": settle,
    }  # fmt: skip
    experiment_run.run(
        "stiffness", rig, given, out=out, resume=resume, model=model, plot=not no_plot, quiet=quiet
    )


_POSES_EPILOG = f"""\
\b
Examples:
  stiffopt experiment poses next.yaml
  stiffopt experiment poses next.yaml --out more
{_CODES}"""


@experiment_app.command(
    "poses", short_help="Hold the pressures of a file, and record the tip.", epilog=_POSES_EPILOG
)
@with_exit_code
def poses(
    file: Annotated[str, typer.Argument(metavar="FILE", show_default=False)],
    out: Out = None,
    quiet: Quiet = False,
) -> None:
    """Go through the pressures of a file on a rig, hold each, and record the tip.

    FILE (format: stiffopt-experiment/1) has the keys rig, a rig file relative to it; hold, a time;
    and pressures, one value per channel for each pose. The arm moves gently, through the safety
    gate, and begins and ends at zero pressure. The recording (log v1 as CSV, and MCAP) serves for a
    calibration.
    """
    from stiffopt.cli import experiment_run

    experiment_run.run_poses_file(file, out=out, quiet=quiet)
