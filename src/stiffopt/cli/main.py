"""Entry points of the two programs: `stiffopt`, and `solve-pressure`, its command `solve`."""

import gc
import os
import sys
from collections.abc import Sequence

import typer

from stiffopt.cli.bench import bench_app
from stiffopt.cli.calibrate import (
    CALIBRATE_EPILOG,
    CALIBRATE_HELP,
    VALIDATE_EPILOG,
    VALIDATE_HELP,
    calibrate,
    validate,
)
from stiffopt.cli.check import CHECK_EPILOG, CHECK_HELP, check
from stiffopt.cli.commission import COMMISSION_EPILOG, COMMISSION_HELP, commission
from stiffopt.cli.console import Closed, report_error, warnings_as_notes
from stiffopt.cli.exits import BAD_INPUT, CLOSED_PIPE, INTERRUPTED
from stiffopt.cli.experiment import experiment_app
from stiffopt.cli.export import export_app
from stiffopt.cli.init import init_app
from stiffopt.cli.lab import LAB_EPILOG, LAB_HELP, lab
from stiffopt.cli.log import log_app
from stiffopt.cli.map import map_app
from stiffopt.cli.options import Version, command_group
from stiffopt.cli.path import PATH_EPILOG, PATH_HELP, path
from stiffopt.cli.plan import PLAN_EPILOG, PLAN_HELP, plan
from stiffopt.cli.robots import robots
from stiffopt.cli.ros import ROS_EPILOG, ROS_HELP, ros
from stiffopt.cli.run import RUN_EPILOG, RUN_HELP, run
from stiffopt.cli.solve import EXAMPLES, HELP, solve
from stiffopt.cli.studio import STUDIO_EPILOG, STUDIO_HELP, studio
from stiffopt.cli.vent import VENT_EPILOG, VENT_HELP, vent

_SETTINGS = {"help_option_names": ["-h", "--help"]}

app = command_group(context_settings=_SETTINGS, add_completion=True)
app.command(
    "solve",
    short_help="Find the stiffest chamber pressures for tasks.",
    help=HELP,
    epilog=EXAMPLES.format(command="stiffopt solve"),
)(solve)
app.command(
    "path",
    short_help="Find pressures with which the tip follows a path.",
    help=PATH_HELP,
    epilog=PATH_EPILOG,
)(path)
app.command(
    "plan",
    short_help="Find a motion that keeps the body clear of a scene.",
    help=PLAN_HELP,
    epilog=PLAN_EPILOG,
)(plan)
app.add_typer(init_app, name="init", short_help="Write a minimal file to begin with.")
app.command(
    "check",
    short_help="Check files: all their mistakes at once.",
    help=CHECK_HELP,
    epilog=CHECK_EPILOG,
)(check)
app.command(
    "studio",
    short_help="See a robot and a task in the browser, and drag them.",
    help=STUDIO_HELP,
    epilog=STUDIO_EPILOG,
)(studio)
app.command("robots", short_help="List the robots that come with stiffopt.")(robots)
app.command(
    "commission",
    short_help="Check whether a rig fits its files: the first hour.",
    help=COMMISSION_HELP,
    epilog=COMMISSION_EPILOG,
)(commission)
app.command(
    "run",
    short_help="Hold an arm at its task: run the daemon of a rig.",
    help=RUN_HELP,
    epilog=RUN_EPILOG,
)(run)
app.command(
    "ros", short_help="Put an arm on a ROS 2 graph, as a node.", help=ROS_HELP, epilog=ROS_EPILOG
)(ros)
app.command(
    "vent", short_help="Let all pressure out of an arm at once.", help=VENT_HELP, epilog=VENT_EPILOG
)(vent)
app.add_typer(map_app, name="map", short_help="Map an arm: workspace and stiffness.")
app.add_typer(experiment_app, name="experiment")
app.add_typer(export_app, name="export", short_help="Write an arm for MuJoCo, or as a mesh.")
app.add_typer(log_app, name="log")
app.command(
    "calibrate",
    short_help="Fit a robot file to recordings of the arm.",
    help=CALIBRATE_HELP,
    epilog=CALIBRATE_EPILOG,
)(calibrate)
app.command(
    "validate",
    short_help="Measure how well a robot file predicts recordings.",
    help=VALIDATE_HELP,
    epilog=VALIDATE_EPILOG,
)(validate)
app.add_typer(bench_app, name="bench")
app.command(
    "lab",
    short_help="Start a simulated arm behind real protocols.",
    help=LAB_HELP,
    epilog=LAB_EPILOG,
)(lab)

solve_pressure_app = command_group(context_settings=_SETTINGS)
solve_pressure_app.command(
    "solve-pressure", help=HELP, epilog=EXAMPLES.format(command="solve-pressure")
)(solve)


@app.callback()
def _stiffopt(version: Version = False) -> None:
    """Run a fluidic soft arm stiff where it matters."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `stiffopt` and return its exit code."""
    return _run(app, "stiffopt", arguments)


def solve_pressure_main(arguments: Sequence[str] | None = None) -> int:
    """Run `solve-pressure` and return its exit code."""
    return _run(solve_pressure_app, "solve-pressure", arguments)


def _run(application: typer.Typer, name: str, arguments: Sequence[str] | None) -> int:
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # escape characters that the terminal lacks
            stream.reconfigure(errors="backslashreplace")
    # Before NumPy is imported: matrices are small, and a second thread would only spin.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        with warnings_as_notes(quiet=False):
            application(given, prog_name=name)
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            report_error("interrupted", label="")
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except Closed:
        return CLOSED_PIPE
    except OSError as error:  # a full disk, a vanished terminal
        report_error(f"cannot write the answer: {error.strerror or error}")
        return BAD_INPUT
    finally:
        # The process ends here; this saves 40 ms of garbage collection. OMPL needs it: what is not
        # collected, it reports as leaked.
        if arguments is None and "ompl" not in sys.modules:
            gc.freeze()
    return 0
