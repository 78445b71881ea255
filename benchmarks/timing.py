"""Compare times fairly: interleaved calls, medians, paired ratios."""

from collections.abc import Callable, Mapping
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Times = dict[str, Vector]
"""Seconds per name, (repetitions, items); NaN where a call was left out."""


def interleaved(
    calls: Mapping[str, Callable[[int], object]],
    items: int,
    repetitions: int,
    most_seconds: float = np.inf,
    prepare: Callable[[str, int], object] | None = None,
) -> Times:
    """Time each call on each item, the names in turn, so that a slow spell hits all of them.

    Parameters
    ----------
    calls : callables of the item's number.
    items, repetitions : how many of both.
    most_seconds : a name that has used up this time is not called any more; later items of it
        are NaN.
    prepare : called, untimed but counting for `most_seconds`, before the first call on an item.
    """
    times = {name: np.full((repetitions, items), np.nan) for name in calls}
    used = dict.fromkeys(calls, 0.0)
    names = list(calls)
    for repetition in range(repetitions):
        for item in range(items):
            first = (repetition + item) % len(names)
            for name in names[first:] + names[:first]:
                if used[name] > most_seconds and (item or repetition):
                    continue
                start = perf_counter()
                if prepare is not None and repetition == 0:
                    prepare(name, item)
                elif prepare is not None and np.isnan(times[name][0, item]):
                    continue
                begin = perf_counter()
                calls[name](item)
                end = perf_counter()
                times[name][repetition, item] = end - begin
                used[name] += end - start
    return times


def looped(
    calls: Mapping[str, Callable[[], object]], repetitions: int, shortest: float = 2e-3
) -> Times:
    """Time calls of microseconds, each repetition a loop of at least `shortest` seconds."""
    counts = {}
    for name, call in calls.items():
        call()
        begin, count = perf_counter(), 0
        while perf_counter() - begin < shortest:
            call()
            count += 1
        counts[name] = max(1, count)

    def loop(name: str) -> Callable[[int], None]:
        def run(_: int) -> None:
            call = calls[name]
            for _ in range(counts[name]):
                call()

        return run

    times = interleaved({name: loop(name) for name in calls}, 1, repetitions)
    return {name: times[name] / counts[name] for name in calls}


def per_item(times: Vector) -> Vector:
    """Median over the repetitions of each item that was timed, (items,) with NaN elsewhere."""
    timed = ~np.isnan(times).all(axis=0)
    result = np.full(times.shape[1], np.nan)
    result[timed] = np.nanmedian(times[:, timed], axis=0)
    return result


def median(times: Vector) -> float:
    """Median over the items of their medians over the repetitions, in s."""
    return float(np.nanmedian(per_item(times)))


def ratio(times: Vector, of: Vector) -> float:
    """Median over the items of how many times longer `times` are than `of`, item by item.

    Both are medians over the repetitions, which were taken in turn.
    """
    pairs = per_item(times) / per_item(of)
    return float(np.nanmedian(pairs)) if np.isfinite(pairs).any() else float("nan")
