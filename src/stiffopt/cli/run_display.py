"""Show a run: as a live status on a terminal, or as lines of text or JSON."""

from __future__ import annotations

import math
import os
import select
import sys
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import accumulate
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from stiffopt.cli.console import console_on
from stiffopt.cli.tables import labelled
from stiffopt.control.state import Event, Severity, Snapshot, State
from stiffopt.control.state_fields import Entry, Kind, entries
from stiffopt.daemon.state_json import plain
from stiffopt.display import DisplayUnit, display_units
from stiffopt.errors import printable
from stiffopt.safety.messages import json_line

if TYPE_CHECKING:
    from stiffopt.daemon.daemon import Daemon

_LONGEST = 500  # characters of a text, since a pipe takes up to 4096 bytes atomically
_COLOURS = {
    State.UNCONFIGURED: "bold white",
    State.INACTIVE: "bold cyan",
    State.ACTIVE: "bold green",
    State.HOLDING: "bold yellow",
    State.FAULT: "bold white on red",
}
_CONTACTS = {"held": "green", "uncertain": "yellow", "lost": "bold red"}
_LEVELS = {Severity.INFO: "dim", Severity.WARNING: "yellow", Severity.ERROR: "bold red"}
_BAR = 24  # characters of a pressure's bar
_EVENTS = 6
_UNKNOWN = "-"
_DECIMALS = {"m": 1, "rad": 1}  # of vectors, in the usual display units


def write_at_once(stream: TextIO, line: str) -> None:
    """Write a line unless that would block, or the stream is closed or absent."""
    data = f"{line}\n".encode(errors="backslashreplace")
    with suppress(OSError, ValueError, AttributeError):
        number = stream.fileno()
        ready = select.poll()
        ready.register(number, select.POLLOUT)
        if ready.poll(0):
            os.write(number, data)


class Lines:
    """Writes a line to stdout for each event and each change of state.

    Writing never blocks and never fails: a line is dropped if its reader is slow or gone, since the
    arm is more important.

    `as_json`: whether lines are JSON objects with ``time`` (of day, UTC), ``level``, ``kind`` and
    ``text``, rather than text for people. `now`: returns the time on the rig's clock, in s.
    """

    period = 0.05  # s, between two updates

    def __init__(self, *, as_json: bool, now: Callable[[], float] = time.monotonic) -> None:
        self._as_json, self._now = as_json, now
        self._last: dict[str, Any] = {}

    def say(self, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        """Write a line about this moment."""
        self._line(self._now(), str(severity), kind, text)

    def begin(self, daemon: Daemon) -> None:
        """Write the daemon's addresses and the path of its recording."""
        found: dict[str, Any] = {
            "url": daemon.url,
            "token_file": None if daemon.token_file is None else str(daemon.token_file),
            "recording": daemon.recording,
            "foxglove_port": daemon.foxglove_port,
        }
        known = {key: value for key, value in found.items() if value is not None}
        words = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in known.items())
        self._line(self._now(), "info", "started", f"runs; {words or 'no ports'}", **known)

    def update(self, now: Snapshot, events: list[Event]) -> None:
        """Write new events, and the state if it has changed."""
        for event in events:
            self._line(event.time, str(event.severity), event.kind, event.text)
        shown = [entry for entry in entries(type(now)) if entry.shown.line]
        fields = {entry.json[0]: plain(getattr(now, entry.name), entry) for entry in shown}
        if fields != self._last:
            self._last = fields
            text = f"{now.state}: {now.reason}" if now.reason else str(now.state)
            level = "error" if now.state is State.FAULT else "info"
            self._line(now.time, level, "state", text, **fields)

    def end(self) -> None:
        """Do nothing; see `LiveStatus`."""

    def _line(self, moment: float, level: str, kind: str, text: str, **more: Any) -> None:
        text = text[:_LONGEST]
        stamp = datetime.fromtimestamp(time.time() - (self._now() - moment), UTC)
        if self._as_json:
            line = json_line(level, kind, text, stamp, **more)
        else:
            mark = "" if level == "info" else f"{level.upper()}: "
            clock = stamp.astimezone().strftime("%H:%M:%S")
            line = f"{clock} {mark}{printable(text)} [{kind}]"
        write_at_once(sys.stdout, line)


class LiveStatus:
    """Shows the state of the loop in one place of the terminal.

    If the terminal fails, nothing is shown and the run goes on. `name` is the rig's, `channels` are
    the names of its n channels.
    """

    period = 0.25  # s, between two updates

    def __init__(
        self, name: str, channels: Sequence[str], *, console: Console | None = None
    ) -> None:
        self._name, self._channels = name, channels
        self._live = Live(
            console=console or console_on(), auto_refresh=False, vertical_overflow="crop"
        )
        self._events: deque[Event] = deque(maxlen=_EVENTS)
        self._daemon: Daemon | None = None
        self._rate = math.nan
        self._before: tuple[float, int] | None = None
        self._works = True

    def say(self, kind: str, text: str, severity: Severity = Severity.INFO) -> None:
        """Show a message as an event of this moment."""
        self._events.append(Event(time.monotonic(), kind, text, severity))
        if not self._live.is_started:
            self._attempt(lambda: self._live.console.print(Text(text, _LEVELS[severity])))

    def begin(self, daemon: Daemon) -> None:
        """Start the display, with the addresses of a daemon."""
        self._daemon = daemon
        self._attempt(self._live.start)

    def update(self, now: Snapshot, events: list[Event]) -> None:
        """Show the state, and the last events."""
        self._events.extend(events)
        if self._before is not None and now.time > self._before[0]:
            self._rate = (now.timing.ticks - self._before[1]) / (now.time - self._before[0])
        if self._before is None or now.time > self._before[0] + 1:
            self._before = (now.time, now.timing.ticks)
        shown = status(
            now, self._name, self._channels, self._rate, tuple(self._events), self._daemon
        )
        self._attempt(lambda: self._live.update(shown, refresh=True))

    def end(self) -> None:
        """End the display; the last status stays visible."""
        self._attempt(self._live.stop)

    def _attempt(self, show: Callable[[], object]) -> None:
        if not self._works:
            return
        try:
            show()
        except (OSError, ValueError):
            self._works = False
            with suppress(OSError, ValueError):
                self._live.stop()


def status(
    now: Snapshot,
    name: str,
    channels: Sequence[str],
    rate: float = math.nan,
    events: Sequence[Event] = (),
    daemon: Daemon | None = None,
) -> RenderableType:
    """Return the state of the loop for the terminal.

    `name` is the rig's, `channels` are the names of its n channels, `rate` is the loop's in Hz, NaN
    if unknown. The addresses and files of the daemon come last.
    """
    armed = now.state in (State.ACTIVE, State.HOLDING)
    rows: list[tuple[str, RenderableType]] = [*_stiffness(now)] if armed else []
    rows += [*_brace(now), *_loop(now, rate)]
    for alarm in now.alarms:
        rows.append(("ALARM", Text(f"{printable(alarm.text)} [{alarm.kind}]", "bold red")))
    parts: list[RenderableType] = [_headline(now, name), labelled(_fields(now, armed))]
    parts += [_pressures(now, channels), labelled(rows)]
    for event in events:
        line = f"  {printable(event.text)} [{event.kind}]"
        parts.append(Text(line, _LEVELS[event.severity]))
    if daemon is not None:
        parts.append(labelled(_places(daemon)))
    return Group(*parts)


def _headline(now: Snapshot, name: str) -> Text:
    text = Text.assemble((f" {str(now.state).upper()} ", _COLOURS[now.state]), f" {name}")
    if now.task:
        text.append(f"  {now.task}")
    if now.reason:
        text.append(f"  {printable(now.reason)}", "yellow")
    return text


def _fields(now: Snapshot, armed: bool) -> list[tuple[str, RenderableType]]:
    """Return the rows that the fields' definitions name; fields of one row are joined."""
    rows: dict[str, list[str]] = {}
    for entry in entries(type(now)):
        value = getattr(now, entry.name)
        if entry.shown.row and value is not None and (armed or not entry.shown.armed_only):
            texts = rows.setdefault(entry.shown.row, [])
            if (text := _shown(value, entry)) != _UNKNOWN:
                texts.append(text)
    return [(row, ", ".join(texts) or _UNKNOWN) for row, texts in rows.items()]


def _shown(value: Any, entry: Entry) -> str:
    """Return a value as text in its display unit."""
    if entry.kind is Kind.FLAG:
        return "yes" if value else "no"
    if entry.kind is Kind.FLAGS:  # the channels that have it
        return ", ".join(str(k) for k, has in enumerate(value, start=1) if has) or "none"
    if entry.kind not in (Kind.NUMBERS, Kind.NUMBER):
        return printable(str(value))
    si = entry.shown.unit if isinstance(entry.shown.unit, str) else entry.shown.unit[0]
    unit, decimals = display_units().of_si(si), _DECIMALS.get(si, 3)
    if entry.kind is Kind.NUMBERS:
        text = _triple(value, unit, f".{decimals}f", entry.shown.unknown)
    elif math.isfinite(value):
        text = unit.number(value, f".{decimals + 1}f")
    else:
        return entry.shown.unknown
    return f"{text} {unit}".rstrip()


def _pressures(now: Snapshot, channels: Sequence[str]) -> Table:
    table, unit = Table.grid(padding=(0, 2, 0, 0)), display_units().pressure
    for k, name in enumerate(channels):
        commanded, high = float(now.commanded[k]), float(now.high[k])
        measured = float(now.measured[k])
        table.add_row(
            f"  {name}",
            _bar(measured if math.isfinite(measured) else commanded, commanded, high),
            unit.text(commanded, ".3f"),
            "not measured" if math.isnan(measured) else f"is {unit.number(measured, '.3f')}",
            Text("saturated" if now.saturated[k] else "", "yellow"),
        )
    return table


def _bar(measured: float, commanded: float, high: float) -> Text:
    """Return the measured pressure as a bar up to its limit, with a mark at the command."""
    share = min(max(measured / high, 0.0), 1.0) if high > 0 else 0.0
    wanted = min(max(commanded / high, 0.0), 1.0) if high > 0 else 0.0
    filled, mark = round(share * _BAR), min(round(wanted * _BAR), _BAR - 1)
    colour = "red" if share > 0.98 else "green"
    text = Text("█" * filled, colour)
    text.append("─" * (_BAR - filled), "dim")
    if abs(share - wanted) > 1 / _BAR:
        text = Text.assemble(text[:mark], ("┃", "bold"), text[mark + 1 :])
    return text


def _stiffness(now: Snapshot) -> list[tuple[str, RenderableType]]:
    rows: list[tuple[str, RenderableType]] = []
    if math.isfinite(now.stiffness):
        unit = display_units().of_si(now.stiffness_unit)
        text = unit.text(now.stiffness, ".3g")
        if math.isfinite(now.best_stiffness) and now.best_stiffness > 0:
            share = now.stiffness / now.best_stiffness
            text += f" of {unit.number(now.best_stiffness, '.3g')} ({share:.0%})"
        rows.append(("stiffness", text))
    if now.touches:
        unit = display_units().force
        text = f"felt at the tip: {_triple(now.wrench[:3], unit, '.4f')} {unit}"
        if math.isfinite(now.press_force):
            pressing = unit.number(now.press_force, ".4f")
            text += f"; presses with {pressing} of {unit.text(now.press_goal)}"
        rows.append(("force", text))
    return rows


def _brace(now: Snapshot) -> list[tuple[str, RenderableType]]:
    """Return the phase of a brace, and a row for each contact while it is held."""
    rows: list[tuple[str, RenderableType]] = [("brace", now.brace)] if now.brace else []
    for each in now.leans_on:
        rows.append(("contact", Text(printable(str(each)), _CONTACTS.get(each.state, ""))))
    return rows


def _loop(now: Snapshot, rate: float) -> list[tuple[str, RenderableType]]:
    timing = now.timing
    parts = [f"{rate:.1f} Hz" if math.isfinite(rate) else _UNKNOWN]
    parts.append(f"tick {timing.tick_time * 1e3:.2f} ms")
    parts.append(f"{timing.overruns} overruns of {timing.ticks}")
    late = _percentile(timing.lateness, 0.99)
    if late:
        parts.append(f"99 % begin within {late}")
    age = f"{now.seen_age * 1e3:.0f} ms" if math.isfinite(now.seen_age) else "never"
    return [("loop", ", ".join(parts)), ("seen", f"{age} ago" if age != "never" else age)]


def _percentile(lateness: tuple[tuple[float, ...], tuple[int, ...]], share: float) -> str:
    """Return the edge of the lateness histogram below which a share of all ticks lies."""
    edges, counts = lateness
    so_far = list(accumulate(counts))
    if not so_far or not so_far[-1]:
        return ""
    at = bisect_left(so_far, share * so_far[-1])
    return f"{edges[at] * 1e3:g} ms" if at < len(edges) else "more than 0.5 s"


def _places(daemon: Daemon) -> list[tuple[str, RenderableType]]:
    rows: list[tuple[str, RenderableType]] = []
    if daemon.url is not None:
        token = "" if daemon.token_file is None else f", token in {daemon.token_file}"
        rows.append(("control", f"{daemon.url}{token}"))
    if daemon.foxglove_port is not None:
        rows.append(("Foxglove", f"ws port {daemon.foxglove_port}"))
    if daemon.recording is not None:
        rows.append(("recording", daemon.recording))
    rows.append(("", Text("Ctrl-C lets the pressures down and ends; twice vents at once", "dim")))
    return rows


def _triple(values: Iterable[float], unit: DisplayUnit, form: str, unknown: str = _UNKNOWN) -> str:
    numbers = [float(value) for value in values]
    return f"({', '.join(unit.number(x, form) if math.isfinite(x) else unknown for x in numbers)})"
