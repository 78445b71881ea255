"""The command `stiffopt robots`."""

from typing import TYPE_CHECKING

from stiffopt.cli.console import show

if TYPE_CHECKING:
    from stiffopt.model.description import RobotDescription


def robots() -> None:
    """List the robots that come with stiffopt; a task file names one of them or a robot file."""
    from rich.table import Table

    from stiffopt.model.robot_files import builtin_robots, load_description

    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="bold")
    table.add_column("robot", no_wrap=True)
    for heading in ("segments", "channels", "length", "pressures", "gravity, m/s^2"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name in builtin_robots():
        table.add_row(name, *_columns(load_description(name)))
    show(table)


def _columns(robot: "RobotDescription") -> tuple[str, ...]:
    low, high = min(robot.pressure_min) * 1e-5, max(robot.pressure_max) * 1e-5
    gravity = ", ".join(f"{component:g}" for component in robot.gravity)
    return (
        str(robot.n_segments),
        str(robot.n_pressures),
        f"{robot.length * 1e3:g} mm",
        f"{low:g} to {high:g} bar",
        f"({gravity})" if any(robot.gravity) else "none",
    )
