"""The view of a timeline: play the arm's motion beside charts of stiffness and pressures."""

from __future__ import annotations

import threading
from time import monotonic
from typing import Any

import numpy as np

from stiffopt.plots import style
from stiffopt.studio import texts
from stiffopt.studio.drawing import ArmTube, add_surroundings, place, rgb
from stiffopt.studio.scene_view import draw_object
from stiffopt.studio.timeline import Timeline, TimelineChart

_FRAME = 0.05  # s, period of the animation
_CHARTS = 0.25  # s, period at which the charts' marks move
_SPEEDS = {"1/4": 0.25, "as it is": 1.0, "4 times": 4.0, "20 times": 20.0}


class TimelineView:
    """Plays a timeline. `server`: viser.ViserServer."""

    def __init__(self, server: Any, timeline: Timeline) -> None:
        self.server, self.timeline = server, timeline
        description = timeline.robot.description
        self._length = description.length
        add_surroundings(server, description)
        self._arm = ArmTube(server, "/arm", description)
        self._add_scene()
        self._add_panel()
        self._show(0.0)
        self._wanted, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._play, name="player", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop playing."""
        self._over.set()
        self._thread.join()

    @property
    def time(self) -> float:
        """The shown moment, in s."""
        return float(self._slider.value)

    def _add_scene(self) -> None:
        timeline = self.timeline
        tips = timeline.robot.tip_pose(timeline.pressures[timeline.shown_rows()])[:, :3, 3]
        self._add_line("/tips", tips, style.DARK)
        if timeline.asked is not None:
            self._add_line("/asked", timeline.asked, style.TARGET)
        self._seen = self.server.scene.add_icosphere(
            "/seen", radius=0.02 * self._length, color=rgb(style.MEASURED), visible=False
        )
        if timeline.scene is not None:
            for number, item in enumerate(timeline.scene.objects):
                draw_object(self.server, item, number, self._length)

    def _add_line(self, name: str, points: Any, colour: str) -> None:
        pairs = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        self.server.scene.add_line_segments(
            name, pairs, rgb(colour), thickness=2.5, thickness_units="screen"
        )

    def _add_panel(self) -> None:
        gui, timeline = self.server.gui, self.timeline
        self._words = gui.add_html("")
        self._button = gui.add_button("play")
        self._button.on_click(self._pressed)
        self._speed = gui.add_dropdown("speed", tuple(_SPEEDS), initial_value="as it is")
        step = max(timeline.duration / 1000, 1e-3)
        self._slider = gui.add_slider("time (s)", 0.0, timeline.duration, step, 0.0)
        self._slider.on_update(self._slid)
        rows = timeline.shown_rows()
        self._charts = [self._add_chart(gui, chart, rows) for chart in timeline.charts]

    def _add_chart(self, gui: Any, chart: TimelineChart, rows: Any) -> tuple[Any, Any]:
        data = (self.timeline.times[rows], *(_without_gaps(line) for line in chart.values[rows].T))
        low, high = float(np.min(data[1:])), float(np.max(data[1:]))
        margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
        low, high = low - margin, high + margin
        series: list[Any] = [{"label": "time (s)"}]
        for number, name in enumerate(chart.names):
            series.append(
                {"label": name or "value", "stroke": style.channel_colour(number), "width": 2}
            )
        series.append({"label": "now", "stroke": style.DARK, "width": 0,
                       "points": {"show": True, "size": 9, "fill": style.DARK}})  # fmt: skip
        hidden = np.full(len(rows), low - 1e3 * (high - low))  # below the chart's range
        handle = gui.add_uplot(
            (*data, hidden), tuple(series), title=chart.title, height=150,
            scales={"x": {"time": False}, "y": {"range": (low, high)}}, legend={"show": False},
        )  # fmt: skip
        return handle, (*data, hidden)

    # -- events of the browser ----------------------------------------------------------------

    def _pressed(self, _: Any) -> None:
        if self._wanted.is_set():
            self._wanted.clear()
        else:
            if self.time >= self.timeline.duration:
                self._slider.value = 0.0
            self._wanted.set()
        self._button.label = "pause" if self._wanted.is_set() else "play"

    def _slid(self, event: Any) -> None:
        if event.client is not None:
            self._show(self.time)

    def _play(self) -> None:
        drawn = before = monotonic()
        while not self._over.wait(_FRAME):
            now = monotonic()
            passed, before = now - before, now
            if not self._wanted.is_set():
                continue
            time = min(self.time + passed * _SPEEDS[self._speed.value], self.timeline.duration)
            self._slider.value = time
            is_over = time >= self.timeline.duration
            self._show(time, with_charts=is_over or now - drawn > _CHARTS)
            drawn = now if now - drawn > _CHARTS else drawn
            if is_over:
                self._wanted.clear()
                self._button.label = "play"

    # -- drawing ------------------------------------------------------------------------------

    def _show(self, time: float, *, with_charts: bool = True) -> None:
        moment = self.timeline.at(time)
        with self.server.atomic():
            self._arm.show(self.timeline.robot, moment.pressures)
            self._seen.visible = moment.seen is not None
            if moment.seen is not None:
                place(self._seen, moment.seen)
        self._words.content = texts.moment_html(self.timeline, time)
        if with_charts:
            self._mark(time)

    def _mark(self, time: float) -> None:
        """Mark the moment in the charts."""
        for handle, data in self._charts:
            now = data[-1].copy()
            row = int(np.clip(np.searchsorted(data[0], time), 0, len(now) - 1))
            now[row] = data[1][row]
            handle.data = (*data[:-1], now)


def _without_gaps(values: Any) -> Any:
    """Interpolate missing values in (N,); 0 if all are missing."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(len(values))
    rows = np.arange(len(values))
    return np.interp(rows, rows[known], values[known])
