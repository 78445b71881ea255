"""Entry points of the two programs: `stiffopt`, and `solve-pressure`, its command `solve`."""

import gc
import os
import sys
from collections.abc import Sequence

import typer

from stiffopt.cli.bench import bench_app
from stiffopt.cli.calibrate import CALIBRATE_EPILOG, VALIDATE_EPILOG, calibrate, validate
from stiffopt.cli.check import CHECK_EPILOG, check
from stiffopt.cli.commission import COMMISSION_EPILOG, commission
from stiffopt.cli.console import Closed, report_error, warnings_as_notes
from stiffopt.cli.exits import BAD_INPUT, CLOSED_PIPE, INTERRUPTED
from stiffopt.cli.experiment import experiment_app
from stiffopt.cli.export import export_app
from stiffopt.cli.init import init_app
from stiffopt.cli.lab import LAB_EPILOG, lab
from stiffopt.cli.log import log_app
from stiffopt.cli.map import map_app
from stiffopt.cli.options import Version, command_group
from stiffopt.cli.path import PATH_EPILOG, path
from stiffopt.cli.plan import PLAN_EPILOG, plan
from stiffopt.cli.robots import robots
from stiffopt.cli.ros import ROS_EPILOG, ros
from stiffopt.cli.run import RUN_EPILOG, run
from stiffopt.cli.solve import EXAMPLES, solve
from stiffopt.cli.studio import STUDIO_EPILOG, studio
from stiffopt.cli.vent import VENT_EPILOG, vent

_SETTINGS = {"help_option_names": ["-h", "--help"]}

app = command_group(context_settings=_SETTINGS, add_completion=True)
for command, epilog, short_help in (
    (
        solve,
        EXAMPLES.format(command="stiffopt solve"),
        "Find the stiffest chamber pressures for tasks.",
    ),
    (path, PATH_EPILOG, "Find pressures with which the tip follows a path."),
    (plan, PLAN_EPILOG, "Find a motion that keeps the body clear of a scene."),
    (check, CHECK_EPILOG, "Check files: all their mistakes at once."),
    (studio, STUDIO_EPILOG, "See a robot and a task in the browser, and drag them."),
    (robots, None, "List the robots that come with stiffopt."),
    (commission, COMMISSION_EPILOG, "Check whether a rig fits its files: the first hour."),
    (run, RUN_EPILOG, "Hold an arm at its task: run the daemon of a rig."),
    (ros, ROS_EPILOG, "Put an arm on a ROS 2 graph, as a node."),
    (vent, VENT_EPILOG, "Let all pressure out of an arm at once."),
    (calibrate, CALIBRATE_EPILOG, "Fit a robot file to recordings of the arm."),
    (validate, VALIDATE_EPILOG, "Measure how well a robot file predicts recordings."),
    (lab, LAB_EPILOG, "Start a simulated arm behind real protocols."),
):
    app.command(short_help=short_help, epilog=epilog)(command)
app.add_typer(init_app, name="init", short_help="Write a minimal file to begin with.")
app.add_typer(map_app, name="map", short_help="Map an arm: workspace and stiffness.")
app.add_typer(experiment_app, name="experiment")
app.add_typer(export_app, name="export", short_help="Write an arm for MuJoCo, or as a mesh.")
app.add_typer(log_app, name="log")
app.add_typer(bench_app, name="bench")

solve_pressure_app = command_group(context_settings=_SETTINGS)
solve_pressure_app.command("solve-pressure", epilog=EXAMPLES.format(command="solve-pressure"))(
    solve
)


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
