"""Report a commissioning: on the terminal, as a Markdown page with its figure, and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from stiffopt.cli.tables import MarkdownPage, TextTable, labelled, title
from stiffopt.commissioning.commission import Commissioning
from stiffopt.commissioning.record import CommissioningRecord, RecordedChannel, RecordedFinding
from stiffopt.display import display_units
from stiffopt.errors import printable

FIGURE = "commissioning.png"


@dataclass(frozen=True)
class CommissioningReport:
    """The content of the report, for the terminal and for the page."""

    title: str
    verdict: str
    findings: tuple[RecordedFinding, ...]
    lines: tuple[tuple[str, str], ...]
    table: TextTable
    corrected: str

    def renderable(self, folder: str, record: str) -> RenderableType:
        """Return the report for the terminal."""
        blocks: list[RenderableType] = [title(self.title), Text(f"  {self.verdict}"), Text("")]
        for finding in self.findings:
            mark, style = ("note  ", "dim") if finding.fits else ("WRONG ", "bold red")
            blocks.append(Text.assemble("  ", (mark, style), printable(finding.text)))
            if finding.advice:
                blocks.append(Text(f"        -> {printable(finding.advice)}", "dim"))
        if self.corrected:
            blocks.append(Text(f"  {printable(self.corrected)}"))
        if self.findings:
            blocks.append(Text(""))
        files = (("record", record), ("folder", folder))
        lines = [(label, printable(text)) for label, text in (*self.lines, *files)]
        return Group(*blocks, labelled(lines), Text(""), self.table.renderable())

    def write(self, folder: Path, found: Commissioning | None) -> None:
        """Write the report as a page into a folder, with a figure of `found` if given."""
        page = MarkdownPage(folder, self.title)
        page.text(f"{self.verdict}.")
        if self.findings:
            page.heading("Findings")
            page.bullets(
                [
                    f"{'note' if each.fits else 'WRONG'}: {each.text}"
                    + (f". What to do: {each.advice}" if each.advice else "")
                    for each in self.findings
                ]
            )
        if self.corrected:
            page.bullets([self.corrected])
        page.heading("Measured")
        page.bullets([f"{label}: {text}" for label, text in self.lines])
        page.table(self.table)
        if found is not None:
            from stiffopt.plots.commissioning import plot_commissioning

            texts = [("" if each.fits else "WRONG: ") + each.text for each in self.findings]
            figure = plot_commissioning(found, title=self.title, findings=texts or [self.verdict])
            page.figure(FIGURE, "responses, steps, noise and findings", figure)
        page.write()


def report(
    record: CommissioningRecord,
    found: Commissioning,
    rig_file: str,
    changed: Sequence[str],
    out: str | None,
) -> CommissioningReport:
    """Return the report; `changed` are the keys that the corrected rig file changes."""
    corrected = ""
    if changed:
        where = f"{out} has it" if out else f"--out FILE.yaml writes it, beside {rig_file}"
        corrected = f"a corrected rig file changes {', '.join(changed)}: {where}"
    wrong = sum(not finding.fits for finding in record.findings)
    verdict = "the rig fits its files" if record.fits else (
        f"the rig does NOT fit its files: {wrong} thing{'s' * (wrong > 1)} to put right"
    )  # fmt: skip
    how = "quick commissioning" if record.quick else "commissioning"
    return CommissioningReport(
        title=f"{record.rig}: {how}",
        verdict=verdict,
        findings=tuple(record.findings),
        lines=tuple(_lines(record)),
        table=_table(record),
        corrected=corrected,
    )


def _lines(record: CommissioningRecord) -> list[tuple[str, str]]:
    units, tracker = display_units(), record.tracker
    assert tracker is not None
    assert record.step is not None
    lines = [
        ("robot", record.robot),
        ("steps", f"of {units.pressure.text(record.step, '.3f')}, one channel after another"),
        (
            "tracker",
            f"{tracker.rate:.0f} samples a second, {1e3 * tracker.latency:.0f} ms old, noise "
            f"{units.length.text(tracker.noise, '.3f')}",
        ),
    ]
    lags = [
        max(c.lag_up or 0.0, c.lag_down or 0.0) for c in record.channels if c.lag_up is not None
    ]
    if lags:
        dead = np.mean([c.dead_time for c in record.channels if c.dead_time is not None])
        text = (
            f"dead time {1e3 * dead:.0f} ms, lag {1e3 * min(lags):.0f} to {1e3 * max(lags):.0f} ms"
        )
        lines.append(("regulators", text))
    swing = "none seen"
    if record.swing is not None:
        s = record.swing
        swing = f"{s.frequency:.2f} Hz, damping {100 * s.damping:.1f} %"
    return [*lines, ("swing", swing)]


def _table(record: CommissioningRecord) -> TextTable:
    unit = display_units().length
    rows = []
    for number, channel in enumerate(record.channels, start=1):
        drives = "+".join(map(str, channel.drives)) or "nothing"
        way, expected = (_vector(v) for v in (channel.displacement, channel.expected))
        gauge = "-" if channel.gauge is None else f"{100 * channel.gauge:.0f} %"
        ratio = np.linalg.norm(channel.displacement) / np.linalg.norm(channel.expected)
        lag = _milliseconds(channel)
        rows.append((str(number), drives, way, expected, f"{ratio:.2f}", gauge, lag))
    return TextTable(
        "",
        ("channel", "drives", f"tip ({unit})", "modelled", "ratio", "gauge", "lag (ms)"),
        tuple(rows),
        "tip: how a step moves it in the base frame; ratio: of the lengths; gauge: of the step; "
        "lag: up, down",
        words=("drives",),
    )


def _vector(values: Sequence[float]) -> str:
    unit = display_units().length
    return ", ".join(unit.number(value, ".2f") for value in values)


def _milliseconds(channel: RecordedChannel) -> str:
    if channel.lag_up is None or channel.lag_down is None:
        return "-"
    return f"{1e3 * channel.lag_up:.0f}, {1e3 * channel.lag_down:.0f}"


_SUFFIXES = {
    "displacement": "_m", "expected": "_m", "deviation": "_m", "gauge_offset": "_pa",
    "gauge_noise": "_pa", "dead_time": "_s", "lag_up": "_s", "lag_down": "_s",
    "rate_up": "_pa_per_s", "rate_down": "_pa_per_s", "position": "_m",
    "orientation": "_quaternion_wxyz", "noise": "_m", "angular_noise": "_rad", "rate": "_hz",
    "latency": "_s", "tip_delay": "_s",
    "frequency": "_hz", "frequency_deviation": "_hz", "amplitude": "_m",
    "step": "_pa", "unexplained": "_m",
}  # fmt: skip


def as_record(record: CommissioningRecord) -> dict[str, Any]:
    """Return a record for JSON: in SI, with the units in the keys."""

    def named(values: dict[str, Any]) -> dict[str, Any]:
        return {f"{key}{_SUFFIXES.get(key, '')}": value for key, value in values.items()}

    data = record.model_dump()
    numbers = data.pop("numbers")
    for key in ("tracker", "swing"):
        data[key] = None if data[key] is None else named(data[key])
    data["channels"] = [named(channel) for channel in data["channels"]]
    return {**named(data), "numbers": numbers}
