"""Everything that is seen in a repetition of the stiffness experiment."""

from __future__ import annotations

from pathlib import Path

from stiffopt.experiments.conductor import Conductor, Row
from stiffopt.logs import LogLayout, LogWriter, McapLogWriter

__all__ = ["RawRecording"]

_PAUSE = 1.0  # s between the times of two runs that share a file


class RawRecording:
    """Recording of all rows from now on; a run that is resumed continues the CSV file.

    Parameters
    ----------
    folder : Path
    repetition : int
        Counted from 1; names the files.
    conductor : Conductor
        Has seen the tip.
    rig : str
        Its name, for the MCAP file.
    """

    def __init__(self, folder: Path, repetition: int, conductor: Conductor, rig: str) -> None:
        self.repetition = repetition
        self._conductor = conductor
        turns = any(row.quaternion is not None for row in conductor.rows)
        layout = LogLayout(
            n=conductor.n, measured=True, tip_quaternion=turns, force=True, stage=True
        )
        name = f"stiffness_{repetition}"
        self._csv = LogWriter(folder / f"{name}.csv", layout)
        part, mcap = 1, folder / f"{name}.mcap"
        while mcap.exists():
            part += 1
            mcap = folder / f"{name}_{part}.mcap"
        about = {"experiment": "stiffness", "repetition": str(repetition), "rig": rig}
        self._mcap = McapLogWriter(mcap, layout, about)
        last = self._csv.last_time
        now = conductor.clock.now()
        begin = now if last is None else now - last - _PAUSE

        def keep(row: Row) -> None:
            if row.time >= now:
                self._csv.append(row.logged(begin))
                self._mcap.append(row.logged(begin))

        conductor.sink = keep

    def close(self) -> None:
        """Close both files."""
        self._conductor.sink = None
        try:
            self._csv.close()
        finally:
            self._mcap.close()
