"""Draw map.png, the picture of docs/map.md: `python docs/images/map.py`."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

BLUE, GREEN, VIOLET = "#dbe7f5", "#d9efe0", "#e7dcf2"
YELLOW, RED, GREY = "#fcefcf", "#f8d9d5", "#eeeeee"
TARGET, SAMPLE = "#b23a2e", "#1f628e"
BOXES = (  # name, left, bottom, width, height, colour, text
    ("cli", 0, 84, 48, 10, BLUE, "the commands"),
    ("studio", 50, 84, 25, 10, BLUE, "the page in the browser"),
    ("ros", 77, 84, 23, 10, BLUE, "a node on a ROS 2 graph"),
    ("plots", 0, 70, 22, 11, BLUE, "figures"),
    ("daemon", 24, 70, 44, 11, GREEN, "HTTP and WebSocket, telemetry,\nrecordings, lease, client"),
    ("commissioning", 70, 70, 30, 11, GREEN, "wiring, frames and gauges,\nby small steps"),
    ("identify, export", 0, 55, 22, 12, BLUE, "calibration; models for\nother programs"),
    (
        "control",
        *(24, 55, 44, 12, GREEN),
        "the loop: requests, supervisor, estimator,\nplanner, reference, allocation",
    ),
    ("lab, plant", 70, 55, 30, 12, VIOLET, "simulated devices\nand the simulated arm"),
    ("paths", 0, 42, 22, 11, YELLOW, "of the tip; motions\namong obstacles"),
    ("experiments, workspace", 70, 42, 30, 11, BLUE, "protocols of the paper;\nmaps"),
    (
        "optimise",
        0,
        29,
        46,
        11,
        YELLOW,
        "which pressures: task, terms, measures,\nsearch (Python and C)",
    ),
    (
        "safety",
        48,
        29,
        52,
        11,
        RED,
        "who may command what: gate, guard process,\nmonitors; the only way to a supply",
    ),
    (
        "model",
        0,
        14,
        46,
        12,
        YELLOW,
        "what an arm is and does: strain laws, shape,\ncompliance, equilibrium, scenes, contact",
    ),
    ("rig", 48, 14, 52, 12, RED, "one interface to pressure, tracking and force;\ndrivers"),
    (
        "core",
        0,
        2,
        100,
        9,
        GREY,
        "errors, units, schema, documents, files, lie, directions, registration, logs",
    ),
)
ARROWS = (  # from, to, colour
    ((38, 85), (38, 80), TARGET), ((38, 71), (38, 66), TARGET), ((30, 56), (30, 39), TARGET),
    ((34, 39), (34, 56), TARGET), ((12, 30), (12, 25), TARGET), ((54, 56), (54, 39), TARGET),
    ((56, 30), (56, 25), TARGET), ((92, 25), (92, 30), SAMPLE), ((62, 39), (62, 56), SAMPLE),
    ((60, 66), (60, 71), SAMPLE), ((44, 80), (44, 85), SAMPLE),
)  # fmt: skip


def main() -> None:
    """Write the picture next to this file."""
    figure, axes = plt.subplots(figsize=(10.5, 7.6), dpi=100)
    for name, left, bottom, width, height, colour, text in BOXES:
        style = "round,pad=0,rounding_size=0.8"
        axes.add_patch(
            FancyBboxPatch((left, bottom), width, height, style, fc=colour, ec="black", lw=1.2)
        )
        middle = left + width / 2
        axes.text(middle, bottom + height - 2.2, name, ha="center", va="center", weight="bold")
        axes.text(middle, bottom + 0.36 * height, text, ha="center", va="center", fontsize=8.5)
    for begin, end, colour in ARROWS:
        axes.add_patch(
            FancyArrowPatch(begin, end, arrowstyle="-|>", mutation_scale=13, color=colour, lw=2.2)
        )
    axes.text(0, 96, "Imports point down.")
    axes.text(22, 96, "Red: a target on its way to the regulators.", color=TARGET)
    axes.text(61, 96, "Blue: a tracker's sample on its way back.", color=SAMPLE)
    axes.set(xlim=(-0.5, 100.5), ylim=(1, 99))
    axes.axis("off")
    figure.tight_layout(pad=0.3)
    figure.savefig(Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
