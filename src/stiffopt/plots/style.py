"""Colours and lengths that the pictures share."""

SEGMENTS = ("#7fa8c9", "#a9c47f", "#c9a27f", "#a58fc4", "#7fc4b8")
"""Of the segments in turn."""
TARGET = "#d62728"
DIRECTIONS = ("#c2571a", "#8c2d04", "#e0a100", "#b5547a")
"""Of the stiffnesses that a task names, in turn."""
ELLIPSOID = "#6a3d9a"
LIMIT = "#f28e2b"
INSIDE = "#4e79a7"
RANGE = "#e9ecef"
LOAD = "#111111"


def colour(segment: int) -> str:
    """Return the colour of a segment, counted from 0."""
    return SEGMENTS[segment % len(SEGMENTS)]


def edge(segment: int) -> str:
    """Return a segment's colour, dark enough for text."""
    red, green, blue = (int(colour(segment)[i : i + 2], 16) for i in (1, 3, 5))
    return f"#{red * 6 // 10:02x}{green * 6 // 10:02x}{blue * 6 // 10:02x}"
