"""Options and help of the commands `stiffopt init ...`."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import command_group, option

init_app = command_group(
    help="Write a minimal file with comments, after a few questions.",
    no_args_is_help=True,
)

_EPILOG = """\
\b
On a terminal the command asks for each option that is not given; elsewhere, and with --yes, it uses
the default. An existing file is overwritten only with --force.

\b
Exit codes:
  0    the file was written
  2    an answer is wrong, or the file exists
  130  interrupted (Ctrl-C)
"""

Yes = Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing; take the defaults.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")]
Robot = Annotated[str | None, option("ROBOT", "A built-in robot, or a robot file (.yaml).")]


def _file(kind: str) -> Any:
    return typer.Argument(metavar="FILE", help=f"The {kind} file to write.")


def _write(kind: str, path: str, answers: dict[str, Any], yes: bool, force: bool) -> int:
    """Ask for answers that were not given, and write the file."""
    from stiffopt.cli.init_files import (
        write_first_file,
    )  # here, so that --help waits for no numerics

    asks = not yes and sys.stdin is not None and sys.stdin.isatty()

    def ask(question: str, default: str) -> str:
        return str(typer.prompt(question, default=default, err=True))

    write_first_file(kind, path, answers, ask if asks else None, force=force)
    return 0


@init_app.command("robot", epilog=_EPILOG)
@with_exit_code
def init_robot(
    file: Annotated[str, _file("robot")] = "my-arm.yaml",
    segments: Annotated[
        int | None, option("N", "Segments in series, all alike.", min=1, max=6)
    ] = None,
    length: Annotated[str | None, option("LENGTH", "Length of a segment at rest.")] = None,
    outer_radius: Annotated[
        str | None, option("LENGTH", "Radius of the silicone cylinder.")
    ] = None,
    inner_radius: Annotated[
        str | None, option("LENGTH", "Radius of its central channel; 0 mm for none.")
    ] = None,
    chambers: Annotated[int | None, option("N", "Chambers around a segment.", min=3)] = None,
    channels: Annotated[int | None, option("N", "Regulators that feed a segment.", min=3)] = None,
    chamber_radius: Annotated[str | None, option("LENGTH", "Radius of a chamber.")] = None,
    chamber_offset: Annotated[
        str | None, option("LENGTH", "Distance of a chamber's axis from the arm's.")
    ] = None,
    modulus: Annotated[str | None, option("PRESSURE", "Young's modulus of the silicone.")] = None,
    max_pressure: Annotated[
        str | None, option("PRESSURE", "Highest gauge pressure that the arm bears.")
    ] = None,
    mounting: Annotated[
        str | None, option("HOW", "hanging, standing, horizontal, or weightless as in the paper.")
    ] = None,
    yes: Yes = False,
    force: Force = False,
) -> int:
    """Write a robot file: what your arm is made of."""
    answers = {
        "segments": segments,
        "length": length,
        "outer_radius": outer_radius,
        "inner_radius": inner_radius,
        "chambers": chambers,
        "channels": channels,
        "chamber_radius": chamber_radius,
        "chamber_offset": chamber_offset,
        "modulus": modulus,
        "max_pressure": max_pressure,
        "mounting": mounting,
    }
    return _write("robot", file, answers, yes, force)


@init_app.command("task", epilog=_EPILOG)
@with_exit_code
def init_task(
    file: Annotated[str, _file("task")] = "my-task.yaml",
    robot: Robot = None,
    position: Annotated[
        str | None, option("'X, Y, Z'", "Target of the tip; an axis may be free.")
    ] = None,
    direction: Annotated[str | None, option("'X, Y, Z'", "Direction in which to be stiff.")] = None,
    yes: Yes = False,
    force: Force = False,
) -> int:
    """Write a task file: a target, and a direction to be stiff in."""
    answers = {"robot": robot, "position": position, "direction": direction}
    return _write("task", file, answers, yes, force)


@init_app.command("path", epilog=_EPILOG)
@with_exit_code
def init_path(
    file: Annotated[str, _file("path")] = "my-path.yaml",
    robot: Robot = None,
    begin: Annotated[str | None, option("'X, Y, Z'", "Start of the line.", "--from")] = None,
    end: Annotated[str | None, option("'X, Y, Z'", "End of the line.", "--to")] = None,
    speed: Annotated[str | None, option("SPEED", "Speed of the tip.")] = None,
    direction: Annotated[str | None, option("'X, Y, Z'", "Direction in which to be stiff.")] = None,
    yes: Yes = False,
    force: Force = False,
) -> int:
    """Write a path file: a line that the tip follows."""
    answers = {"robot": robot, "from": begin, "to": end, "speed": speed, "direction": direction}
    return _write("path", file, answers, yes, force)


@init_app.command("scene", epilog=_EPILOG)
@with_exit_code
def init_scene(
    file: Annotated[str, _file("scene")] = "my-scene.yaml",
    robot: Robot = None,
    clearance: Annotated[
        str | None, option("LENGTH", "Distance that the whole arm keeps from objects.")
    ] = None,
    yes: Yes = False,
    force: Force = False,
) -> int:
    """Write a scene file: what stands around the arm."""
    return _write("scene", file, {"robot": robot, "clearance": clearance}, yes, force)


@init_app.command("rig", epilog=_EPILOG)
@with_exit_code
def init_rig(
    file: Annotated[str, _file("rig")] = "my-rig.yaml",
    robot: Robot = None,
    supply: Annotated[
        str | None, option("DRIVER", "simulated, modbus, nidaq or open-regulator.")
    ] = None,
    tracker: Annotated[
        str | None, option("DRIVER", "simulated, aurora, openigtlink, or none.")
    ] = None,
    yes: Yes = False,
    force: Force = False,
) -> int:
    """Write a rig file: the arm's regulators and tracker."""
    return _write("rig", file, {"robot": robot, "supply": supply, "tracker": tracker}, yes, force)
