"""The virtual lab's open regulator: the real firmware in simavr, on a pseudo-terminal.

The simulated board has valves, supply line and chambers behind its pins (firmware/simulator). It
reports the pressures in the chambers to the bench, whose own regulators are not used.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, ClassVar

from stiffopt.errors import DeviceError, InputError
from stiffopt.lab.bench import Bench, DevicePeer
from stiffopt.lab.firmware import built_firmware
from stiffopt.rig.drivers.open_regulator import BoardChannel, OpenRegulatorSettings

PAIRS, MOST = 3, 6  # channels of a board with pairs of valves, and with 3-way valves
_END = 2.0  # s
_NOISE = 30  # bytes of 1000 that are corrupted or lost
_HOLE = 0.067  # dm3/(s bar): empties 20 ml with a time constant of 0.3 s
_SLOW = 0.5  # s, time constant of slow valves
_ONCE = {"reset": "reset", "brown-out": "brown-out", "hung": "hang"}
_LINE = {"noise": f"noise {_NOISE}", "losses": f"lose {_NOISE}", "unplugged": "cable 0"}


class OpenRegulatorPeer(DevicePeer[OpenRegulatorSettings]):
    """A board with three pairs of valves, or with six 3-way valves if the rig file asks for more.

    Parameters
    ----------
    settings, bench : see `DevicePeer`.
    built : settings of the firmware's Makefile, such as ``SILENCE_MS``, for tests.

    Attributes
    ----------
    dump_open : whether the dump valve is open.
    """

    faults: ClassVar[tuple[str, ...]] = (*_LINE, *_ONCE)

    def __init__(self, settings: OpenRegulatorSettings, bench: Bench, **built: int) -> None:
        super().__init__(settings, bench)
        most = max(channel.output for channel in settings.channels)
        self._channels = PAIRS if most <= PAIRS else MOST
        self._built = {"PAIRS": int(most <= PAIRS), "BOARD_NUMBER": settings.board, **built}
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None
        self.dump_open = True

    @classmethod
    def stand_in(cls, simulated: Any, n: int) -> OpenRegulatorSettings:
        """Return a board whose first channels are the arm's."""
        if n > MOST:
            raise InputError(f"an open regulator has {MOST} channels at most; the arm has {n}")
        channels = [BoardChannel(output=i + 1) for i in range(n)]
        return OpenRegulatorSettings(port="a pseudo-terminal", channels=channels)

    def start(self) -> OpenRegulatorSettings:
        """Build the firmware if necessary, and switch the board on."""
        if self._process is not None:
            raise DeviceError("the open regulator of the virtual lab runs already")
        folder = built_firmware(**self._built)
        command = [folder / "board", folder / "regulator.elf", self._channels]
        self._process = subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,  # Ctrl-C must only reach the lab, which ends the board
        )
        assert self._process.stdout is not None
        port = self._process.stdout.readline().strip()
        if not port:
            self.close()
            raise DeviceError("the simulated board did not start; are there pseudo-terminals?")
        self._thread = threading.Thread(
            target=self._listen, args=(self._process,), name=type(self).__name__, daemon=True
        )
        self._thread.start()
        return self.settings.model_copy(update={"port": port})

    def close(self) -> None:
        """Switch the board off; a second call does nothing."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait(_END)
        if self._thread is not None and not sys.is_finalizing():
            self._thread.join(_END)
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()

    def tell(self, command: str) -> None:
        """Send a command to the simulated board; see firmware/simulator/board.c."""
        process = self._process
        if process is not None and process.stdin is not None:
            with suppress(OSError, ValueError):  # the board was switched off
                process.stdin.write(f"{command}\n")
                process.stdin.flush()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        """Pass pressures to the bench, and the bench's faults to the board."""
        outputs = [channel.output - 1 for channel in self.settings.channels]
        before: tuple[str, dict[int, str]] = ("ok", {})
        assert process.stdout is not None
        with suppress(ValueError):  # the stream was closed, or its last line was cut
            for line in process.stdout:
                _, *pressures, shut = map(float, line.split())
                self.bench.fill([pressures[output] for output in outputs])
                self.dump_open = not shut
                now = (self.bench.fault("supply"), self.bench.channel_faults())
                if now != before:
                    before = now
                    for command in self._commands(*now):
                        self.tell(command)

    def _commands(self, fault: str, faulty: dict[int, str]) -> Iterator[str]:
        """Yield the commands that give a board exactly these faults."""
        yield from ("noise 0", "lose 0", "cable 1", f"power {int(fault != 'off')}")
        yield f"lag {_SLOW if fault == 'slow' else 0.005}"
        for index, channel in enumerate(self.settings.channels):
            own, place = faulty.get(index, "ok"), channel.output - 1
            yield f"valve {place} {({'high': 1, 'stuck': 2}).get(own, 0)}"
            yield f"leak {place} {_HOLE if own == 'leak' else 0}"
            yield f"sensor {place} {({'garbage': 0, 'wrong': -2}).get(own, -1)}"
        if fault in _LINE:
            yield _LINE[fault]
        elif fault in _ONCE:
            yield _ONCE[fault]
