"""The results of a benchmark's section, and the report of all sections in Markdown."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from counts import TOLERANCE, Difference

METRICS = """\
All times are wall times of whole calls from Python, in one process unless said otherwise. Calls
that are compared are interleaved, task by task, in changing order; each is repeated and the
median over the repetitions taken, then the median over the tasks. A *ratio* is the peer's time
over stiffopt's, taken task by task, and its median: above 1 stiffopt is faster. What is built
once (symbolic functions, `nlpsol`, compiled code, JIT) is built before the clock starts, for
all; "First solution" has what it costs stiffopt. Every answer is judged by one model: its pose
within the tolerance, its pressures within the limits."""

LIMITATIONS = """\
- Times are of one machine, with whatever else ran on it; the load is given. Ratios taken side
  by side move less than times, but they move: tens of percent between runs on a busy machine.
- Tens of tasks per arm do not prove shares of 98 or 99 %. "Best" is the best that was found
  here, not a proof; `quality.py` has the reference that shares nothing with the optimiser.
- Targets are poses of random pressures: regions that few pressures reach are seldom visited.
- The peers were used as a careful user would, not as their authors might. IPOPT runs with MUMPS
  and exact Hessians in CasADi's virtual machine; generating C for it would make its evaluations
  faster. SLSQP has no warm start for multipliers.
- pink solves an easier problem: no pressure limits, no choice among poses, and a local method
  from one start.
- soromox starts from strains, stiffopt from pressures. JAX may use all cores, as may stiffopt's
  batches.
- Cold times are of tasks whose structure was seen before; the first task of a structure pays
  for building.
- Loads are covered by two kinds of tasks on the two-segment arm."""


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
    """One part of the report: a table with its text, verdicts and comparisons.

    `data` is what results.json and the plots get, `skipped` says why a peer was left out, by name.
    """

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
    return Verdict(
        what, f"at most {_with_unit(limit, unit)}", _found(value, unit), bool(value <= limit)
    )


def at_least(what: str, limit: float, value: float, unit: str) -> Verdict:
    """Verdict on a figure that should be large; NaN is a miss."""
    return Verdict(
        what, f"at least {_with_unit(limit, unit)}", _found(value, unit), bool(value >= limit)
    )


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


# -- Markdown -------------------------------------------------------------------------------------


def markdown(
    sections: Sequence[Section],
    differences: Sequence[Difference],
    environment: dict[str, str],
    loads: tuple[float, float],
    seed: int,
    quick: bool,
    minutes: float,
) -> str:
    """The whole report."""
    parts = ["# Results of the speed benchmarks", ""]
    if quick:
        parts += ["**Quick form: it shows that everything runs; its figures mean little.**", ""]
    parts += [
        f"Seed {seed}, {minutes:.1f} minutes. "
        f"Load average {loads[0]:.2f} before, {loads[1]:.2f} after.",
        "", "## Metrics", "", METRICS, "", "## Bars", "", *_bars(sections), "",
        "## Where a peer is better", "", *_better(sections), "", "## Environment", "",
        *table(("", ""), environment.items()), "",
    ]  # fmt: skip
    for section in sections:
        parts += [f"## {section.title}", "", section.text, ""]
        if section.rows:
            parts += [*table(section.header, section.rows), ""]
        parts += [f"Skipped: {name}: {why}." for name, why in section.skipped.items()]
        parts += [""] if section.skipped else []
    parts += ["## Counts", "", *_counts(differences), "", "## Limitations", "", LIMITATIONS, ""]
    return "\n".join(parts)


def summary(sections: Iterable[Section], differences: Iterable[Difference]) -> str:
    """Few lines for the terminal."""
    verdicts = [verdict for section in sections for verdict in section.verdicts]
    missed = [v for v in verdicts if not v.met]
    lines = [f"  missed: {v.what}: {v.measured}, bar {v.bar}" for v in missed]
    lines += [f"  {difference}" for difference in differences if difference.fails]
    return "\n".join([f"{len(verdicts) - len(missed)} of {len(verdicts)} bars met", *lines])


def _bars(sections: Sequence[Section]) -> list[str]:
    verdicts: list[Verdict] = [v for section in sections for v in section.verdicts]
    met = sum(v.met for v in verdicts)
    rows = [(v.what, v.bar, v.measured, "met" if v.met else "**not met**") for v in verdicts]
    return [
        f"{met} of {len(verdicts)} met.", "",
        *table(("figure", "bar", "measured", ""), rows),
    ]  # fmt: skip


def _better(sections: Sequence[Section]) -> list[str]:
    found = [c for section in sections for c in section.comparisons if c.times_better < 1]
    if not found:
        return ["Nowhere in this run."]
    rows = [(c.work, c.peer, c.measure, times(1 / c.times_better), c.remark) for c in found]
    return table(("work", "peer", "in", "how many times better", "remark"), rows)


def _counts(differences: Sequence[Difference]) -> list[str]:
    """The groups, and each count that is not the same."""
    intro = (
        "Compared with `results/counts.json`; tolerances: "
        + ", ".join(f"{group} {100 * share:g} %" for group, share in TOLERANCE.items())
        + f". {len(differences)} counts, {sum(d.fails for d in differences)} worse."
    )
    changed = [d for d in differences if d.state != "same"]
    rows = [(d.group, d.name, str(d.expected), str(d.found), d.state) for d in changed]
    if not rows:
        return [intro, "", "All are within their tolerance."]
    return [intro, "", *table(("group", "count", "on record", "found", ""), rows)]


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]
