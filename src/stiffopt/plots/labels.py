"""Place labels in a picture of an arm where they cover nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.text import Annotation

from stiffopt.arrays import Array
from stiffopt.plots.style import literal
from stiffopt.plots.view import box_corners, projected

if TYPE_CHECKING:
    from stiffopt.plots.arm import Label


_SIZE = 8.5  # points, of letters
_CELL = 3  # pixels, size of a cell in the map of covered area
_WAYS = 24  # number of directions that are tried
_DISTANCES = (7.0, 12.0, 19.0, 28.0, 40.0, 55.0, 75.0, 100.0)  # points, that are tried
_LINED_FROM = 15.0  # points; from this distance a line leads to the text
_GAP = 2.0  # points, margin around a text
_NUMBERS = 10.0  # points, width of the numbers at an axis within the box
_MARK = 8.0  # points, margin around a marker
_COVERS, _COVERS_TEXT, _OUTSIDE, _FAR = 60.0, 120.0, 40.0, 0.05  # costs; the last per point
_CUT = 500.0  # cost of a text that leaves the axes


class PlacedLabel(Annotation):
    """A text that stays beside a point in space when the view changes."""

    def __init__(self, label: Label) -> None:
        text = "\n".join(map(literal, label.text.split("\n")))
        super().__init__(
            text, (0, 0), (0, 0), textcoords="offset points", fontsize=_SIZE, color=label.colour,
            ha="center", va="center", zorder=20, annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": label.colour, "linewidth": 0.7, "shrinkA": 1},
        )  # fmt: skip
        self.point = label.point

    def follow(self) -> None:
        """Move to the point's place in the picture."""
        x, y = projected(self.axes, self.point[None])
        self.xy = (float(x[0]), float(y[0]))

    def move(self, offset: Array, *, with_line: bool) -> None:
        """Put the middle of the text at an offset (2,) from its point, in points."""
        self.set_position((float(offset[0]), float(offset[1])))
        if self.arrow_patch is not None:
            self.arrow_patch.set_visible(with_line)

    def draw(self, renderer: Any) -> None:
        """See `matplotlib.artist.Artist.draw`."""
        self.follow()
        super().draw(renderer)


def place_labels(axes: Any, labels: Sequence[Label], covered: Array, marks: Array) -> None:
    """Place texts in 3-D axes whose limits and view are set.

    Parameters
    ----------
    axes :
    labels : the most important first.
    covered : (k, 3), points of the axes, close together, which texts avoid.
    marks : (j, 3), points with a marker, which texts avoid with a margin.
    """
    if not labels:
        return
    axes.apply_aspect()
    places = _CoveredCells(axes)
    places.cover(covered, 0.0)
    places.cover(marks, _MARK)
    for label in labels:
        placed = PlacedLabel(label)
        axes.add_artist(placed)
        placed.follow()
        places.put(placed)


class _TextPlace(NamedTuple):
    """A place for a text: its cost, its distance in points, and its middle in pixels."""

    cost: float
    distance: float
    middle: Array


class _CoveredCells:
    """A map of the covered area of axes, in cells of a few pixels."""

    def __init__(self, axes: Any) -> None:
        self.axes = axes
        self.pixels = axes.get_figure(root=True).dpi / 72  # per point
        self.start = np.array([axes.bbox.x0, axes.bbox.y0])
        self.size = np.array([axes.bbox.width, axes.bbox.height])
        self.cells = np.zeros(np.maximum(self.size // _CELL, 1).astype(int) + 1)
        corners = self.at(box_corners(axes))
        edge = np.array([_NUMBERS * self.pixels, 0.0])
        self.low, self.high = corners.min(axis=0) + edge, corners.max(axis=0) - edge

    def at(self, points: Array) -> Array:
        """Return points (k, 3) in pixels (k, 2) from the lower left corner of the axes."""
        plane = projected(self.axes, np.atleast_2d(points)).T
        return np.asarray(self.axes.transData.transform(plane) - self.start)

    def cover(self, points: Array, radius: float) -> None:
        """Mark squares around points (k, 3) as covered; the radius is in points."""
        reach = round(radius * self.pixels / _CELL) + 1
        bounds = np.array(self.cells.shape) - 1
        cells = (self.at(points) // _CELL).astype(int)
        for shift in np.ndindex(2 * reach + 1, 2 * reach + 1):
            at = np.clip(cells + shift - reach, 0, bounds)
            self.cells[at[:, 0], at[:, 1]] = 1.0

    def put(self, label: PlacedLabel) -> None:
        """Put a label at the best place near its point, and mark that place as covered."""
        box = label.get_window_extent()
        half = np.array([box.width, box.height]) / 2 + _GAP * self.pixels
        anchor = self.at(label.point)[0]
        angles = np.linspace(0, 2 * np.pi, _WAYS, endpoint=False)
        places = [
            self._place(anchor, np.array([np.cos(angle), np.sin(angle)]), distance, half)
            for distance in _DISTANCES
            for angle in angles
        ]
        best = min(places, key=lambda place: place.cost)
        offset = (best.middle - anchor) / self.pixels
        label.move(offset, with_line=best.distance > _LINED_FROM)
        self._of(best.middle - half, best.middle + half)[:] = _COVERS_TEXT / _COVERS

    def _place(self, anchor: Array, way: Array, distance: float, half: Array) -> _TextPlace:
        """Rate a place in a direction (2,) from an anchor; `half` (2,) is half the text's size."""
        edge = 1 / max(np.abs(way) / half)  # from the middle of the text to its frame
        middle = anchor + way * (distance * self.pixels + edge)
        low, high = middle - half, middle + half
        outside = np.maximum(self.low - low, 0) + np.maximum(high - self.high, 0)
        cost = (
            _COVERS * self._of(low, high).mean()
            + _OUTSIDE * float(np.sum(outside / self.size))
            + _CUT * float(np.sum(np.maximum(-low, 0) + np.maximum(high - self.size, 0)) > 0)
            + _FAR * distance
        )
        return _TextPlace(cost, distance, middle)

    def _of(self, low: Array, high: Array) -> Array:
        """Return the cells of a box in pixels; cells at the edge for a box outside the axes."""
        bounds = np.array(self.cells.shape)
        first = np.clip((low // _CELL).astype(int), 0, bounds - 1)
        last = np.clip((high // _CELL).astype(int) + 1, first + 1, bounds)
        return self.cells[first[0] : last[0], first[1] : last[1]]
