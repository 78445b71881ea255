"""The commands `stiffopt map workspace`, `map contact` and `map arm`: options, help and work."""

import signal
from time import perf_counter
from typing import Annotated, Any

import typer

from stiffopt.cli.console import ProgressBar, report_note, show, warnings_as_notes, write_json
from stiffopt.cli.exits import (
    INTERRUPTED,
    InterruptBetweenSteps,
    interruptible_work,
    with_exit_code,
)
from stiffopt.cli.options import (
    BoundaryOption,
    FrameOption,
    Json,
    PressuresOption,
    Quiet,
    RobotArgument,
    TimeoutOption,
    Units,
    command_group,
    option,
)
from stiffopt.cli.outputs import check_ending, check_picture, check_writable
from stiffopt.errors import InputError, OutOfTimeError

map_app = command_group(
    help="Map an arm: where its tip can be, how stiff it is there, and how stiff along its length."
)

_CODES = """
\b
Exit codes:
  0    the map is complete
  2    bad input, or the map cannot be made or written
  130  interrupted (Ctrl-C{or_late})
"""

_EPILOG = f"""\
\b
Examples:
  stiffopt map workspace stiff-flop-2 --out map.zarr --samples 10000000 --plot map.png
  stiffopt map workspace my-arm.yaml --levels 6 --cell '5 mm' --direction x --direction 0,1,1
  stiffopt map workspace stiff-flop-3 --out map.zarr --scheduler tcp://10.0.0.5:8786
{_CODES.format(or_late=", or --timeout is over")}"""


@map_app.command("workspace", short_help="Where the tip can be, and how stiff.", epilog=_EPILOG)
@with_exit_code
def workspace(
    robot: RobotArgument,
    out: Annotated[
        str | None, option("FILE.zarr", "Keep the map in this folder, a Zarr group.")
    ] = None,
    samples: Annotated[
        int | None,
        option(
            "N", "Number of quasi-random samples; by default a million, with gravity 1000.", min=1
        ),
    ] = None,
    levels: Annotated[
        int | None, option("K", "Instead: all combinations of K levels of each channel.", min=2)
    ] = None,
    cell: Annotated[str, option("LENGTH", "Size of a cell.")] = "10 mm",
    direction: Annotated[
        list[str] | None,
        option(
            "DIR",
            "x, y, z or a,b,c: direction of a stiffness; may be repeated. By default x, y, z.",
        ),
    ] = None,
    kind: Annotated[str, option("KIND", "translation or rotation.")] = "translation",
    boundary: BoundaryOption = "free",
    frame: FrameOption = "base",
    seed: Annotated[int, option("N", "Seed of the quasi-random samples.", min=0)] = 0,
    scene: Annotated[
        str | None, option("FILE", "A scene file; samples without its clearance are left out.")
    ] = None,
    scheduler: Annotated[
        str | None, option("ADDRESS", "Use the workers of this Dask scheduler.")
    ] = None,
    timeout: TimeoutOption = None,
    plot: Annotated[str | None, option("FILE.png", "Draw sections through the workspace.")] = None,
    as_json: Json = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a map that is in the folder of --out.")
    ] = False,
    units: Units = None,
    quiet: Quiet = False,
) -> int:
    """Sample the pressures of an arm and map its workspace.

    Space is divided into cells. For each cell that the tip reaches, the map contains the number of
    samples and, for each direction, their largest and smallest stiffness with the pressures. ROBOT
    is the name of a built-in robot or a robot file. With --out, the map is kept as a Zarr group;
    the same command continues a run that was interrupted, or ended by --timeout.
    """
    check_picture(plot)
    from stiffopt.cli import map_report, quantities  # here, so that --help waits for no numerics
    from stiffopt.model.manipulator import load_robot
    from stiffopt.model.scene import load_scene
    from stiffopt.workspace import map_workspace

    begin = perf_counter()
    directions = None
    if direction is not None:
        directions = [quantities.direction("--direction", text) for text in direction]
    choices: dict[str, Any] = {"kind": kind, "boundary": boundary, "frame": frame}
    size = quantities.quantity("--cell", cell, "m", "length")
    seconds = None if timeout is None else quantities.quantity("--timeout", timeout, "s", "time")
    mapped = load_robot(robot)
    around = None if scene is None else load_scene(scene)
    interrupt = InterruptBetweenSteps([signal.SIGINT])
    so_far: tuple[int, int] | None = None

    def progress(done: int, total: int) -> None:
        nonlocal so_far
        is_first, so_far = so_far is None, (done, total)
        interrupt.check()
        if is_first and done and not quiet:
            report_note(f"{out} continues after {done:,} of {total:,} samples")
        bar.report(done, total, f"{done:,} of {total:,} samples")

    try:
        with interrupt.handled(), ProgressBar(quiet=quiet) as bar, warnings_as_notes(quiet=quiet):
            found = map_workspace(
                mapped, out, directions=directions, samples=samples, levels=levels, cell=size,
                seed=seed, scene=around, scheduler=scheduler, overwrite=overwrite,
                progress=progress, timeout=seconds, **choices,
            )  # fmt: skip
    except (KeyboardInterrupt, OutOfTimeError) as ended:
        if so_far is not None and not quiet:
            how = (
                f"the same command goes on with {out}"
                if out
                else "nothing was kept: with --out a run can be resumed"
            )
            why = "out of time; " if isinstance(ended, OutOfTimeError) else ""
            report_note(why + "stopped after {:,} of {:,} samples; ".format(*so_far) + how)
        return INTERRUPTED
    took = perf_counter() - begin
    if out is not None and not found.evaluated and not quiet:
        report_note(f"{out} is complete; there was nothing left to sample")
    if as_json:
        write_json(map_report.workspace_record(found, out, took))
    elif not quiet:
        show(map_report.workspace_summary(found, out, took))
    if plot is not None:
        from stiffopt.plots import save_figure
        from stiffopt.plots.maps import plot_workspace

        save_figure(plot_workspace(found), plot)
    return 0


_CONTACT_EPILOG = f"""\
\b
Examples:
  stiffopt map contact stiff-flop-2 --scene scene.yaml --pressures '0.6, 0, 0.2, 0, 0, 0.4 bar'
  stiffopt map contact my-arm.yaml --scene scene.yaml --pressures '0.3, 0, 0 bar' --json
{_CODES.format(or_late="")}"""


@map_app.command(
    "contact", short_help="How an arm rests against objects of a scene.", epilog=_CONTACT_EPILOG
)
@with_exit_code
def contact(
    robot: RobotArgument,
    scene: Annotated[str, option("FILE", "A scene file.")],
    pressures: PressuresOption,
    plot: Annotated[str | None, option("FILE.png", "Draw the arm and its contacts.")] = None,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> None:
    """Lean an arm on the objects of a scene that allow contact, and report its stiffness.

    Prints the contacts with their forces, the stiffness of the tip free and braced, with contacts
    that slide and that stick, and the pushes that lose the first contact. The equilibrium is the
    one reached from rest as all pressures grow in proportion. ROBOT is the name of a built-in robot
    or a robot file.
    """
    check_picture(plot)
    from stiffopt.cli import contact_report, quantities
    from stiffopt.model.manipulator import load_robot
    from stiffopt.model.scene import load_scene

    p = quantities.listed("--pressures", pressures, "Pa", "pressure")
    with interruptible_work(quiet=quiet):
        arm, around = load_robot(robot), load_scene(scene)
        around.check_against(arm.description)
        found = arm.contact_equilibrium(p, around)
    if plot is not None:
        from stiffopt.plots import save_figure
        from stiffopt.plots.contact import plot_contact

        save_figure(plot_contact(arm, found, around), plot)
    if as_json:
        write_json(contact_report.record(arm, found))
    elif not quiet:
        show(contact_report.summary(arm, found))


_ARM_EPILOG = f"""\
\b
Examples:
  stiffopt map arm stiff-flop-1 --plot arm.png
  stiffopt map arm stiff-flop-2 --channels 1 --channels 4 --pressures '0:1.5:0.5 bar'
  stiffopt map arm stiff-flop-1 --over 1,2 --plot tip.png --csv tip.csv
{_CODES.format(or_late="")}"""


@map_app.command("arm", short_help="How stiff an arm is along its length.", epilog=_ARM_EPILOG)
@with_exit_code
def arm(
    robot: RobotArgument,
    channels: Annotated[
        list[str] | None,
        option(
            "LIST",
            "Channels (counted from 1) that are pressurised together, such as 1 or 1,2; may "
            "be repeated.",
        ),
    ] = None,
    pressures: Annotated[
        str | None,
        option(
            "LIST", "Pressures, '0,0.5,1 bar' or '0:1.5:0.5 bar'; by default seven up to the limit."
        ),
    ] = None,
    points: Annotated[
        int | None, option("N", "Points along the arm; by default 25.", min=2)
    ] = None,
    over: Annotated[
        str | None, option("A,B", "Instead: the tip over the pressures of two channels.")
    ] = None,
    levels: Annotated[
        int | None, option("K", "With --over: levels of each channel; by default 31.", min=2)
    ] = None,
    boundary: BoundaryOption = "free",
    frame: FrameOption = "base",
    plot: Annotated[str | None, option("FILE.png", "Draw the map.")] = None,
    csv: Annotated[str | None, option("FILE.csv", "Write the map as a table, in SI units.")] = None,
    as_json: Json = False,
    units: Units = None,
    quiet: Quiet = False,
) -> None:
    """Map the stiffness along an arm, from near its base to its tip, as in figure 6 of the paper.

    Groups of channels are pressurised to several pressures: by default the first pair of each
    segment, then the first two. With --over 1,2 the map is that of the tip's stiffness over the
    pressures of these two channels. ROBOT is the name of a built-in robot or a robot file.
    """
    check_picture(plot)
    if csv is not None:
        check_ending(csv, (".csv",))
        check_writable(csv)
    alone = {"--channels": channels, "--pressures": pressures, "--points": points}
    for name, value in alone.items():
        if over is not None and value is not None:
            raise InputError(f"{name} has no meaning for a map over two pressures (--over)")
    if over is None and levels is not None:
        raise InputError("--levels is for a map over two pressures; give --over too")

    from stiffopt.cli import map_report, quantities
    from stiffopt.experiments.arm_map import ArmMap, TipMap, map_arm, map_tip
    from stiffopt.model.manipulator import load_robot

    with interruptible_work(quiet=quiet) as report:

        def progress(done: float, total: float) -> None:
            report(done, total, "stiffness")

        mapped = load_robot(robot)
        choices: dict[str, Any] = {"boundary": boundary, "frame": frame}
        found: ArmMap | TipMap
        if over is not None:
            found = map_tip(
                mapped, quantities.channels("--over", over), levels=levels or 31,
                progress=progress, **choices,
            )  # fmt: skip
        else:
            groups, peaks = None, None
            if channels is not None:
                groups = [quantities.channels("--channels", text) for text in channels]
            if pressures is not None:
                peaks = quantities.pressures("--pressures", pressures)
            found = map_arm(
                mapped, groups, peaks, points=points or 25, progress=progress, **choices
            )
    if csv is not None:
        map_report.write_csv(csv, found)
    if plot is not None:
        from stiffopt.plots import save_figure
        from stiffopt.plots.maps import plot_arm_map, plot_tip_map

        drawn = plot_arm_map(found) if isinstance(found, ArmMap) else plot_tip_map(found)
        save_figure(drawn, plot)
    if as_json:
        write_json(map_report.record(found))
    elif not quiet:
        show(map_report.summary(found))
