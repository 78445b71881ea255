"""Text tables for the terminal and for Markdown pages."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from stiffopt.documents import write_whole
from stiffopt.errors import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STATUS_COLOURS = {"solved": "green", "unreachable": "yellow", "failed": "red", "bad input": "red"}


@dataclass(frozen=True)
class TextTable:
    """A table of text with an optional title above it and a remark below it.

    The first column, and those whose headings are in `words`, contain words. The others contain
    numbers, aligned to the right and never wrapped. The remark explains headings or numbers.
    """

    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    remark: str = ""
    words: tuple[str, ...] = ()

    def holds_words(self, column: int) -> bool:
        """Whether a column contains words rather than numbers."""
        return column == 0 or self.heading[column] in self.words

    def renderable(self) -> RenderableType:
        """Return the table for the terminal."""
        table = number_table()
        for number, heading in enumerate(self.heading):
            words = self.holds_words(number)
            table.add_column(
                heading, justify="left" if words else "right", no_wrap=not words, overflow="fold"
            )
        for row in self.rows:
            table.add_row(*map(printable, row))
        parts: list[RenderableType] = [table]
        if self.title:
            parts.insert(0, Text(f"  {printable(self.title)}", "bold"))
        if self.remark:
            parts.append(Text(f"  {self.remark}", "dim"))
        return Group(*parts)


def number_table(*headings: str) -> Table:
    """Return an empty table without lines: a column of words, then columns of numbers."""
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="bold")
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    return table


def labelled(lines: Iterable[tuple[str, RenderableType]]) -> Table:
    """Return a grid of lines with their labels."""
    grid = Table.grid(padding=(0, 2), pad_edge=False)
    grid.add_column(no_wrap=True, style="dim")
    grid.add_column(overflow="fold")
    for label, content in lines:
        grid.add_row(f"  {label}", content)
    return grid


def summary(rows: Sequence[tuple[str, ...]], headings: Sequence[str]) -> RenderableType:
    """Return one line for each file, and the number of files with each status.

    The first column is the file, the second its status; a file with bad input has no others.
    """
    names = [os.path.basename(file) for file, *_ in rows]
    if len(set(names)) < len(rows):
        names = [file for file, *_ in rows]
    table = number_table(*headings)
    table.columns[0].no_wrap = False
    table.columns[0].overflow = "fold"
    table.columns[1].justify = "left"
    for name, (_, status, *numbers) in zip(names, rows, strict=True):
        table.add_row(Text(printable(name)), Text(status, STATUS_COLOURS[status]), *numbers)
    counts = {each: sum(status == each for _, status, *_ in rows) for each in STATUS_COLOURS}
    words = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return Group(table, "", Text(f"{len(rows)} {headings[0]}s: {words}"))


def title(text: str) -> Text:
    """Return the title of a report."""
    return Text(printable(text), "bold")


class MarkdownPage:
    """A Markdown page under construction, and the folder for it and its figures."""

    def __init__(self, folder: Path, title: str) -> None:
        self._folder = folder
        self._lines = [f"# {title}", ""]

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._lines += [f"## {text}", ""]

    def text(self, text: str) -> None:
        """Add a paragraph, which may contain Markdown."""
        self._lines += [text, ""]

    def bullets(self, items: Sequence[str]) -> None:
        """Add a list of plain text; text between backticks is code."""
        self._lines += [*(f"- {_escaped(item)}" for item in items), ""]

    def table(self, table: TextTable) -> None:
        """Add a table and its remark, without its title."""
        columns = range(len(table.heading))
        align = "".join(" --- |" if table.holds_words(i) else " ---: |" for i in columns)
        self._lines += [f"| {' | '.join(table.heading)} |", f"|{align}"]
        self._lines += [f"| {' | '.join(map(_cell, row))} |" for row in table.rows]
        self._lines.append("")
        if table.remark:
            self.text(f"{table.remark[:1].upper()}{table.remark[1:]}.")

    def figure(self, name: str, alt: str, figure: Figure) -> None:
        """Write a figure into the folder and show it."""
        from stiffopt.plots import save_figure

        save_figure(figure, self._folder / name)
        self._lines += [f"![{alt}]({name})", ""]

    def write(self, name: str = "report.md") -> None:
        """Write the page into the folder."""
        write_whole(self._folder / name, "\n".join(self._lines).encode())


def _escaped(text: str) -> str:
    """Escape Markdown outside of backticks."""
    parts = text.split("`")
    parts[::2] = [
        part.replace("*", r"\*").replace("_", r"\_").replace("<", "&lt;") for part in parts[::2]
    ]
    return "`".join(parts)


def _cell(text: str) -> str:
    return _escaped(text).replace("|", r"\|")


def block_title(name: str, status: str, timings: Mapping[str, float]) -> Text:
    """Return the first line of a report: name, status and time."""
    seconds = f"  {timings.get('total', 0.0):.2f} s"
    if timings.get("compilation", 0.0) >= 0.5:
        seconds += f", after compiling once for {timings['compilation']:.0f} s"
    return Text.assemble((name, "bold"), "  ", (status, f"bold {STATUS_COLOURS[status]}"), seconds)
