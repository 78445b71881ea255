"""What a section of the benchmarks has to say."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Verdict:
    """A bar and what was measured.

    Attributes
    ----------
    what : of which figure.
    bar : in words, with its unit.
    measured : the same.
    met : whether it was met.
    """

    what: str
    bar: str
    measured: str
    met: bool


@dataclass(frozen=True)
class Comparison:
    """The same work by stiffopt and by a peer, side by side.

    Attributes
    ----------
    work : what was done.
    peer : by whom else.
    times_better : how many times better stiffopt is; below 1 the peer is better.
    measure : what "better" is about, such as "time".
    remark : what to know of it.
    """

    work: str
    peer: str
    times_better: float
    measure: str = "time"
    remark: str = ""


@dataclass
class Section:
    """One part of the report."""

    title: str
    text: str
    header: tuple[str, ...] = ()
    rows: list[tuple[str, ...]] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)


def at_most(what: str, limit: float, value: float, unit: str) -> Verdict:
    """Verdict on a figure that should be small; NaN is a miss."""
    return Verdict(what, f"at most {_with_unit(limit, unit)}", _found(value, unit), value <= limit)


def at_least(what: str, limit: float, value: float, unit: str) -> Verdict:
    """Verdict on a figure that should be large; NaN is a miss."""
    return Verdict(what, f"at least {_with_unit(limit, unit)}", _found(value, unit), value >= limit)


def _found(value: float, unit: str) -> str:
    return "not measured" if value != value else _with_unit(value, unit)


def _with_unit(value: float, unit: str) -> str:
    number = f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return number + ("" if unit == "x" else " ") + unit


def times(value: float) -> str:
    """A ratio in words of a table."""
    if value != value:
        return "-"
    return f"{value:.3g}x"


def milliseconds(seconds: float) -> str:
    """A time for a table whose column says ms."""
    return "-" if seconds != seconds else f"{seconds * 1e3:.3g}"


def percent(share: float) -> str:
    """A share in percent."""
    return "-" if share != share else f"{100 * share:.0f} %"
