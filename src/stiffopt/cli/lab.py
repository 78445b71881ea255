"""The command `stiffopt lab`: a simulated arm behind real protocols."""

from typing import Annotated

import typer

LAB_HELP = """\
Start a simulated arm in real time behind the protocols of a rig file's devices.

The devices of RIG are emulated on this machine: a Modbus server, an NDI Aurora on a
pseudo-terminal, an OpenIGTLink server, an NI-DAQ gRPC server, a Zaber stage on TCP. The rig file
that is printed drives them with the real drivers. Simulated devices of RIG are replaced by real
ones (--supply, --tracker). Ends with Ctrl-C.

While it runs it takes commands, one a line: 'fault DEVICE NAME [CHANNEL]' (if the rig file enables
faults), 'mount X Y Z' (turn the probe's rail), 'status', 'quit'.
"""

LAB_EPILOG = """\
\b
Examples:
  stiffopt lab rig/virtual-lab.yaml --out my-lab.yaml
  stiffopt lab rig/sim.yaml --supply nidaq --tracker openigtlink --out my-lab.yaml

\b
Exit codes:
  0    ended by Ctrl-C, a signal or 'quit'
  2    bad input, an address in use, a missing library
  5    the simulated arm could not be followed
"""


def lab(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="A rig file.")],
    out: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Write the rig file here instead of printing it."),
    ] = None,
    supply: Annotated[
        str,
        typer.Option(
            metavar="DRIVER",
            help="In place of a simulated supply: modbus, nidaq or that of an installed package.",
        ),
    ] = "modbus",
    tracker: Annotated[
        str,
        typer.Option(
            metavar="DRIVER",
            help="In place of a simulated tracker: aurora, openigtlink or that of a package.",
        ),
    ] = "aurora",
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print no notes; the rig file and errors only.")
    ] = False,
) -> None:
    """Run the virtual lab."""
    from stiffopt.cli.lab_run import run  # here, so that --help waits for no numerics

    raise typer.Exit(run(rig, out, supply, tracker, quiet=quiet))
