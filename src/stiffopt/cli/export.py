"""The commands `stiffopt export mjcf` and `stiffopt export mesh`."""

from typing import Annotated, Any

from stiffopt.cli.console import write_line
from stiffopt.cli.exits import interruptible_work, with_exit_code
from stiffopt.cli.options import PressuresOption, Quiet, RobotArgument, command_group, option
from stiffopt.cli.outputs import check_ending, check_writable

export_app = command_group(help="Write an arm under pressure for other programs.")

_CODES = """
\b
Exit codes:
  0    the file is written
  2    bad input, or the file cannot be written
  130  interrupted (Ctrl-C)
"""

_MJCF_EPILOG = f"""\
\b
Examples:
  stiffopt export mjcf stiff-flop-2 --pressures '0.6, 0, 0.2, 0, 0, 0.4 bar' --out arm.xml
  python -m mujoco.viewer --mjcf=arm.xml
{_CODES}"""

_MESH_EPILOG = f"""\
\b
Examples:
  stiffopt export mesh stiff-flop-2 --pressures '0.6, 0, 0.2, 0, 0, 0.4 bar' --out arm.stl
{_CODES}"""


def _arm(robot: str, pressures: str) -> tuple[Any, Any]:
    from stiffopt.cli import quantities
    from stiffopt.model.manipulator import load_robot

    return load_robot(robot), quantities.listed("--pressures", pressures, "Pa", "pressure")


@export_app.command("mjcf", epilog=_MJCF_EPILOG)
@with_exit_code
def export_mjcf(
    robot: RobotArgument,
    pressures: PressuresOption,
    out: Annotated[str | None, option("FILE.xml", "The file; by default it is printed.")] = None,
    pieces: Annotated[int | None, option("N", "Joints per segment; by default 12.")] = None,
    damping: Annotated[
        float | None,
        option("SHARE", "Damping of the slowest mode, as a share of critical; by default 0.05."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write an arm under pressure as a model for MuJoCo.

    The model is a rod of hinges and slides with the shape and the stiffness of the sections at the
    given pressures, and the masses, the tip's mass and the gravity of the robot file. MuJoCo
    computes the sag itself. The site 'tip' has the pose of the tip. For other pressures, export
    again. ROBOT is the name of a built-in robot or a robot file.
    """
    if out is not None:
        check_ending(out, (".xml",))
        check_writable(out)
    from stiffopt.documents import write_whole
    from stiffopt.export.mjcf import mjcf

    given: dict[str, Any] = {"pieces": pieces, "damping": damping}
    with interruptible_work(quiet=quiet):
        arm, p = _arm(robot, pressures)
        text = mjcf(arm, p, **{key: value for key, value in given.items() if value is not None})
    if out is None:
        write_line(text.rstrip())
    else:
        write_whole(out, text.encode())


@export_app.command("mesh", epilog=_MESH_EPILOG)
@with_exit_code
def export_mesh(
    robot: RobotArgument,
    pressures: PressuresOption,
    out: Annotated[str, option("FILE.stl", "Or .obj or .ply.")],
    quiet: Quiet = False,
) -> None:
    """Write the surface of an arm under pressure as a mesh, in metres.

    It is the body that stiffopt keeps clear of obstacles: a tube of the outer radius with a
    hemisphere at the tip, sagging under the gravity and the tip's mass of the robot file. ROBOT is
    the name of a built-in robot or a robot file.
    """
    from stiffopt.errors import require_package
    from stiffopt.export.mesh import MESH_ENDINGS, save_mesh

    require_package("trimesh", "mesh")
    check_ending(out, MESH_ENDINGS)
    check_writable(out)
    with interruptible_work(quiet=quiet):
        arm, p = _arm(robot, pressures)
        save_mesh(arm, p, out)
