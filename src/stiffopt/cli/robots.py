"""The command `stiffopt robots`: a table of the robots that come with stiffopt."""

from typing import TYPE_CHECKING

from stiffopt.cli.console import show
from stiffopt.cli.exits import with_exit_code
from stiffopt.cli.options import Units

if TYPE_CHECKING:
    from stiffopt.model.description import RobotDescription


@with_exit_code
def robots(units: Units = None) -> None:
    """List the robots that come with stiffopt; a task file names one of them or a robot file."""
    from stiffopt.cli.tables import number_table
    from stiffopt.model.robot_files import builtin_robots, load_description

    table = number_table("robot", "segments", "channels", "length", "pressures", "g in m/s^2")
    for name in builtin_robots():
        table.add_row(name, *_columns(load_description(name)))
    show(table)


def _columns(robot: "RobotDescription") -> tuple[str, ...]:
    from stiffopt.display import display_units

    pressure = display_units().pressure
    low, high = min(robot.pressure_min), max(robot.pressure_max)
    gravity = ", ".join(f"{component:g}" for component in robot.gravity)
    return (
        str(robot.n_segments),
        str(robot.n_pressures),
        display_units().length.text(robot.length),
        f"{pressure.number(low)} to {pressure.text(high)}",
        f"({gravity})" if any(robot.gravity) else "none",
    )
