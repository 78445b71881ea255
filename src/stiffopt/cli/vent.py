"""The command `stiffopt vent`: vent a rig, even while a program commands it."""

from typing import Annotated

import typer

from stiffopt.cli.console import report_error, write_json, write_line
from stiffopt.cli.exits import BAD_INPUT, FAULT, SOLVED, with_exit_code
from stiffopt.cli.options import RigArgument
from stiffopt.errors import DeviceError, StiffoptError

VENT_EPILOG = """\
\b
Examples:
  stiffopt vent rig/modbus-aurora.yaml
  sudo stiffopt vent rig/modbus-aurora.yaml

\b
Exit codes:
  0    vented, or nothing to vent
  2    bad input, a missing library
  5    it is NOT certain that the arm is vented
"""


@with_exit_code
def vent(
    rig: RigArgument,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object: vented, text.")
    ] = False,
) -> int:
    """Let all pressure out of the arm of RIG at once.

    If a program commands it, that program's guard vents and accepts no command until somebody arms
    again. If none does, the supply is vented directly. A guard that does not answer is ended first.
    This needs no network, no token and no control interface. It works for the user who started the
    program, and for root.
    """
    from stiffopt.safety.vent import vent_rig  # here, so that --help waits for no numerics

    vented, code = False, SOLVED
    try:
        text, vented = vent_rig(rig), True
    except DeviceError as error:
        text, code = f"THE ARM MAY BE UNDER PRESSURE: {error}", FAULT
    except StiffoptError as error:
        text, code = str(error), BAD_INPUT
    if as_json:
        write_json({"vented": vented, "text": text})
    elif vented:
        write_line(text)
    if not vented:
        report_error(text)
    return code
