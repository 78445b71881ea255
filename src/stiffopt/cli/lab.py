"""The command `stiffopt lab`: a simulated arm behind the protocols of real devices."""

from __future__ import annotations

import queue
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stiffopt.cli.console import report_error, report_note, warnings_as_notes, write_line
from stiffopt.cli.exits import ENDING_SIGNALS, FAULT, SOLVED, handled, with_exit_code
from stiffopt.cli.options import RigArgument, Units, option
from stiffopt.errors import InputError

if TYPE_CHECKING:
    from stiffopt.lab.virtual import VirtualLab

_TICK = 0.2  # s, period of checks whether the simulation still runs

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


@with_exit_code
def lab(
    rig: RigArgument,
    out: Annotated[
        str | None, option("FILE", "Write the rig file here instead of printing it.")
    ] = None,
    supply: Annotated[
        str,
        option(
            "DRIVER",
            "In place of a simulated supply: modbus, nidaq, open-regulator or that of a package.",
        ),
    ] = "modbus",
    tracker: Annotated[
        str,
        option(
            "DRIVER", "In place of a simulated tracker: aurora, openigtlink or that of a package."
        ),
    ] = "aurora",
    units: Units = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print no notes; the rig file and errors only.")
    ] = False,
) -> int:
    """Start a simulated arm in real time behind the protocols of a rig file's devices.

    The devices of RIG are emulated on this machine: a Modbus server, an NDI Aurora on a
    pseudo-terminal, an OpenIGTLink server, an NI-DAQ gRPC server, a Zaber stage on TCP, the
    firmware of an open regulator in a simulated microcontroller. The printed rig file has the real
    drivers for them. Simulated devices of RIG are replaced by real ones (--supply, --tracker). Ends
    with Ctrl-C.

    While it runs it accepts commands, one per line: 'fault DEVICE NAME [CHANNEL]' (if the rig file
    enables faults), 'mount X Y Z' (turns the probe's rail), 'status', 'quit'.
    """
    # here, so that --help waits for no numerics; the lab needs numba
    from stiffopt.files import file_text, save_file
    from stiffopt.lab.virtual import VirtualLab
    from stiffopt.model.robot_files import robot_path
    from stiffopt.rig.config import load_rig

    if out is not None and Path(out).exists() and Path(rig).exists() and Path(out).samefile(rig):
        raise InputError(f"--out {out} is the rig file itself; give another name")
    description, robot = load_rig(rig)
    with warnings_as_notes(quiet=quiet):
        virtual_lab = VirtualLab(description, robot, supply, tracker)
    with virtual_lab, _until_signal() as ended:
        addressed = virtual_lab.start()
        known = robot_path(description.robot, Path(rig).parent)
        addressed = addressed.model_copy(update={"robot": known})
        if out is None:
            write_line(file_text("rig", addressed).rstrip())
        else:
            save_file(out, "rig", addressed)
        if not quiet:
            where = f"in {out}" if out else "above"
            report_note(f"the lab runs; the rig file {where} drives it. Ctrl-C ends it.")
        _serve(virtual_lab, ended, quiet=quiet)
    if virtual_lab.bench.failure is not None:
        report_error(str(virtual_lab.bench.failure))
        return FAULT
    return SOLVED


def _serve(lab: VirtualLab, ended: threading.Event, *, quiet: bool) -> None:
    """Carry out typed commands until the lab ends or the simulation fails."""
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(lines,), daemon=True).start()
    while not ended.is_set() and lab.bench.failure is None:
        try:
            words = lines.get(timeout=_TICK).split()
        except queue.Empty:
            continue
        if words == ["quit"]:
            return
        try:
            answer = _obey(lab, words)
        except InputError as error:
            report_error(str(error))
        else:
            if answer and not quiet:
                report_note(answer)


def _listen(lines: queue.SimpleQueue[str]) -> None:
    """Queue typed lines; there are none in the background of a terminal or without one."""
    if sys.stdin is None:
        return
    with suppress(OSError, ValueError):
        for line in sys.stdin:
            if line.strip():
                lines.put(line)


def _obey(lab: VirtualLab, words: list[str]) -> str:
    """Carry out a command and return its answer."""
    if words[0] == "fault" and len(words) in (3, 4):
        channel = None if len(words) == 3 else _channel(words[3])
        lab.world.inject(words[1], words[2], channel)
        return f"{words[1]}: {words[2]}"
    if words[0] == "mount" and len(words) == 4:
        lab.bench.mount(_direction(words[1:]))
        return f"the probe's rail is along {' '.join(words[1:])}"
    if words == ["status"]:
        from stiffopt.display import display_units

        pressure, length = display_units().pressure, display_units().length
        pressures = ", ".join(pressure.number(p, ".3f") for p in lab.world.pressures)
        tip = ", ".join(length.number(x, ".1f") for x in lab.world.plant.tip_pose()[:3, 3])
        faults = {device: fault for device, fault in lab.world.faults.items() if fault != "ok"}
        active = ", ".join(f"{device} {fault}" for device, fault in faults.items()) or "none"
        return f"pressures {pressures} {pressure}; tip at {tip} {length}; faults: {active}"
    raise InputError(
        f"'{' '.join(words)}' is no command; there are: fault DEVICE NAME [CHANNEL], "
        "mount X Y Z, status, quit"
    )


def _channel(word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise InputError(f"expected a channel counted from 1, not '{word}'")
    return int(word) - 1


def _direction(words: list[str]) -> list[float]:
    try:
        direction = [float(word) for word in words]
    except ValueError:
        raise InputError(f"expected a direction such as '0 1 0', not '{' '.join(words)}'") from None
    if not any(direction) or not all(abs(x) < 1e9 for x in direction):
        raise InputError("expected a direction such as '0 1 0'")
    return direction


@contextmanager
def _until_signal() -> Iterator[threading.Event]:
    """Context with an event that Ctrl-C and other signals to end set."""
    ended = threading.Event()
    handlers: dict[int, Any] = dict.fromkeys(ENDING_SIGNALS, lambda number, frame: ended.set())
    if hasattr(signal, "SIGTTIN"):  # reading the terminal from the background would stop the lab
        handlers[signal.SIGTTIN] = signal.SIG_IGN
    with handled(handlers):
        yield ended
