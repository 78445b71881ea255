"""Running `stiffopt lab`: start the virtual lab, carry out typed commands, stop it in order."""

from __future__ import annotations

import queue
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stiffopt.cli.console import report_error, report_note, warnings_as_notes, write_line
from stiffopt.cli.exits import BAD_INPUT, FAULT, SOLVED
from stiffopt.errors import InputError, StiffoptError
from stiffopt.files import file_text, save_file
from stiffopt.model.robot_files import load_description, robot_path
from stiffopt.rig.config import load_rig_description

if TYPE_CHECKING:
    from stiffopt.lab.virtual import VirtualLab

_TICK = 0.2  # s, between looks at whether the arm still moves


def run(rig: str, out: str | None, supply: str, tracker: str, *, quiet: bool) -> int:
    """Run the lab until it is ended; return the exit code."""
    try:
        from stiffopt.lab.virtual import VirtualLab  # here: without numba there is none

        _refuse_to_overwrite(rig, out)
        description = load_rig_description(rig)
        folder = Path(rig).parent
        robot = load_description(description.robot, base=folder)
        with warnings_as_notes(quiet=quiet):
            virtual_lab = VirtualLab(description, robot, supply, tracker)
        with virtual_lab as lab, _until_signal() as ended:
            addressed = lab.start().model_copy(
                update={"robot": robot_path(description.robot, folder)}
            )
            if out is None:
                write_line(file_text("rig", addressed).rstrip())
            else:
                save_file(out, "rig", addressed)
            if not quiet:
                where = f"in {out}" if out else "above"
                report_note(f"the lab runs; the rig file {where} drives it. Ctrl-C ends it.")
            _serve(lab, ended, quiet=quiet)
    except StiffoptError as error:
        report_error(str(error))
        return BAD_INPUT
    if lab.bench.failure is not None:
        report_error(str(lab.bench.failure))
        return FAULT
    return SOLVED


def _serve(lab: VirtualLab, ended: threading.Event, *, quiet: bool) -> None:
    """Carry out what is typed until the lab is ended or the arm cannot be followed."""
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
    """Pass on what is typed; in the background of a terminal, or without one, that is nothing."""
    if sys.stdin is None:
        return
    with suppress(OSError, ValueError):
        for line in sys.stdin:
            if line.strip():
                lines.put(line)


def _refuse_to_overwrite(rig: str, out: str | None) -> None:
    files = [Path(path) for path in (rig, out) if path is not None]
    if len(files) == 2 and all(path.exists() for path in files) and files[0].samefile(files[1]):
        raise InputError(f"--out {out} is the rig file itself; give another name")


def _obey(lab: VirtualLab, words: list[str]) -> str:
    """Carry out a command and return what to say about it."""
    if words[0] == "fault" and len(words) in (3, 4):
        channel = None if len(words) == 3 else _channel(words[3])
        lab.world.inject(words[1], words[2], channel)
        return f"{words[1]}: {words[2]}"
    if words[0] == "mount" and len(words) == 4:
        lab.bench.mount(_direction(words[1:]))
        return f"the probe's rail is along {' '.join(words[1:])}"
    if words == ["status"]:
        bars = ", ".join(f"{p * 1e-5:.3f}" for p in lab.world.pressures)
        tip = ", ".join(f"{x * 1e3:.1f}" for x in lab.world.plant.tip_pose()[:3, 3])
        faults = {device: fault for device, fault in lab.world.faults.items() if fault != "ok"}
        told = ", ".join(f"{device} {fault}" for device, fault in faults.items()) or "none"
        return f"pressures {bars} bar; tip at {tip} mm; faults: {told}"
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
    """Give an event that Ctrl-C and SIGTERM set."""
    ended = threading.Event()

    def end(number: int, frame: Any) -> None:
        ended.set()

    handlers: dict[int, Any] = {signal.SIGINT: end, signal.SIGTERM: end}
    if hasattr(signal, "SIGTTIN"):  # to read a terminal from the background would stop the lab
        handlers[signal.SIGTTIN] = signal.SIG_IGN
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
