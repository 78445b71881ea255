"""Few plots of the results, with logarithmic axes."""

from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter

import settings as bars

COLOURS = {
    "stiffopt": "#0b6e4f",
    "CasADi + IPOPT": "#c1440e",
    "CasADi + IPOPT, energy form": "#e8963a",
    "SLSQP, CasADi gradients": "#5b7db1",
    "SLSQP, finite differences": "#9aa5b1",
    "CasADi VM": "#c1440e",
    "soromox (JAX)": "#7b4fa3",
}
MARKERS = dict(zip(COLOURS, "osDv^sD", strict=True))


def draw(data: dict[str, Any], folder: Path) -> list[Path]:
    """All plots that the results allow."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for name, of, plot in (
        ("full_task", "Full task: pose and stiffness", _full_task),
        ("growth", "Growth with segments", _growth),
        ("starts", "Growth with starts", _starts),
        ("evaluations", "Evaluations", _evaluations),
    ):
        if data.get(of):
            figure = plot(data[of])
            path = folder / f"{name}.png"
            figure.savefig(path, dpi=130)
            plt.close(figure)
            made.append(path)
    return made


def _style(name: str) -> dict[str, Any]:
    return {"color": COLOURS.get(name, "black"), "marker": MARKERS.get(name, "o"), "markersize": 6}


def _plain_ticks(axis: Axis) -> None:
    """Numbers such as 0.1, 1, 10 on a logarithmic axis, and 2 and 5 between if it is short."""
    low, high = sorted(axis.get_view_interval())
    between = (1.0, 2.0, 5.0) if high < 50 * low else (1.0,)
    axis.set_major_locator(LogLocator(base=10, subs=between))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _finish(axes: Axes, x: str, y: str, title: str) -> None:
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log" and not isinstance(axis.get_major_locator(), FixedLocator):
            _plain_ticks(axis)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, fontsize=11)
    axes.grid(True, which="major", color="#dddddd", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _full_task(data: dict[str, Any]) -> Any:
    """Times of all solvers over the arms, with the bars."""
    figure, both = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
    arms = sorted(int(key) for key in data)
    limits = (bars.COLD_MS, bars.WARM_MS)
    for axes, how, limit in zip(both, ("cold", "warm"), limits, strict=True):
        places = range(len(arms))
        for name in data[str(arms[0])]:
            lines = [data[str(n)].get(name, {}).get(f"{how}_s", float("nan")) for n in arms]
            axes.plot(places, [1e3 * t for t in lines], label=name, **_style(name))
        for place, n in enumerate(arms):
            if n in limit:
                label = "bar for stiffopt" if place == 0 else None
                span = (place - 0.3, place + 0.3)
                axes.plot(span, [limit[n]] * 2, color="black", linewidth=1.5, label=label)
        axes.set_yscale("log")
        axes.set_xticks(list(places), [str(n) for n in arms])
        title = {"cold": "Cold, from the task alone", "warm": "Warm, target moved by 0.5 mm"}
        _finish(axes, "segments", "time per solution (ms)" if how == "cold" else "", title[how])
    handles, labels = both[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _growth(data: dict[str, Any]) -> Any:
    figure, both = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
    for axes, how in zip(both, ("cold", "warm"), strict=True):
        arms: list[int] = []
        for name, line in data.items():
            arms = line["segments"]
            axes.plot(arms, [1e3 * t for t in line[f"{how}_s"]], label=name, **_style(name))
        axes.set_yscale("log")
        axes.set_xscale("log")
        axes.set_xticks(arms, [str(n) for n in arms])
        axes.minorticks_off()
        label = "time per solution (ms)" if how == "cold" else ""
        _finish(axes, "segments", label, how.capitalize())
    handles, labels = both[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _starts(data: dict[str, Any]) -> Any:
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for name, points in data.items():
        x = [1e3 * point["seconds"] for point in points]
        y = [100 * point["best"] for point in points]
        axes.plot(x, y, label=name, **_style(name))
        for i, point in enumerate(points):
            axes.annotate(
                f"{point['starts']}", (x[i], y[i]), textcoords="offset points",
                xytext=(0, 7), ha="center", fontsize=8, color=COLOURS.get(name),
            )  # fmt: skip
    axes.set_xscale("log")
    axes.margins(y=0.15)
    axes.legend(frameon=False, fontsize=9, loc="best")
    title = "Two segments, cold; at each point its number of local searches"
    _finish(axes, "time per task (ms)", "tasks within 0.5 % of the best (%)", title)
    return figure


def _evaluations(data: dict[str, Any]) -> Any:
    """Two segments: microseconds per evaluation, single and batched."""
    figure, both = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
    for axes, where in zip(both, ("single", "batch"), strict=True):
        lines = {
            key.removesuffix(f", {where} 2"): value
            for key, value in data.items()
            if key.endswith(f", {where} 2")
        }
        works = list(lines)[::-1]
        for row, work in enumerate(works):
            for name, seconds in lines[work].items():
                style = {**_style(name), "linestyle": "none", "markersize": 8}
                label = name if row == len(works) - 1 else None
                axes.plot([1e6 * seconds], [row], label=label, **style)
        axes.set_xscale("log")
        axes.set_yticks(range(len(works)), works)
        axes.margins(y=0.12)
        title = {"single": "One call", "batch": "In a batch, per row"}[where]
        _finish(axes, "time (µs)", "", f"{title}; two segments")
    handles, labels = both[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure
