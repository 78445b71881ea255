"""Plot the times of the full task, with logarithmic axes."""

from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import FuncFormatter

import settings as bars

STYLES = {
    "stiffopt": ("#0b6e4f", "o"),
    "stiffopt, in a row": ("#86bfa8", "o"),
    "CasADi + IPOPT": ("#c1440e", "s"),
    "CasADi + IPOPT, energy form": ("#e8963a", "D"),
    "SLSQP, CasADi gradients": ("#5b7db1", "v"),
}


def draw(data: dict[str, Any], path: Path) -> None:
    """Times of all solvers over the arms, cold and warm, with the bars.

    `data` is that of the section on the full task.
    """
    figure, both = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
    arms = sorted(int(key) for key in data)
    titles = ("Cold, from the task alone", "Warm, target moved by 0.5 mm")
    columns = zip(both, ("cold_s", "warm_s"), (bars.COLD_MS, bars.WARM_MS), titles, strict=True)
    for axes, key, limit, title in columns:
        for name in data[str(arms[0])]:
            times = [1e3 * data[str(n)].get(name, {}).get(key, float("nan")) for n in arms]
            colour, marker = STYLES.get(name, ("black", "o"))
            axes.plot(range(len(arms)), times, label=name, color=colour, marker=marker)
        for place, n in enumerate(arms):
            if n in limit:
                label = "bar for stiffopt" if place == 0 else None
                span = (place - 0.3, place + 0.3)
                axes.plot(span, [limit[n]] * 2, color="black", linewidth=1.5, label=label)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xticks(range(len(arms)), [str(n) for n in arms])
        axes.set_xlabel("segments")
        axes.set_title(title, fontsize=11)
        axes.grid(True, color="#dddddd", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    both[0].set_ylabel("time per solution (ms)")
    handles, labels = both[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=130)
    plt.close(figure)
