"""What makes one doubt a recording is told."""

from __future__ import annotations

import numpy as np
import pytest

from stiffopt.experiments.kinematics_result import doubts
from stiffopt.logs import Log

TIME = np.arange(0, 20, 0.025)


def log(measured: np.ndarray | None = None, tip: np.ndarray | None = None, **given: object) -> Log:
    commanded = np.stack([5e4 * (1 - np.cos(TIME)), 0 * TIME], axis=1)
    if measured is None:
        late = 5e4 * (1 - np.cos(np.maximum(TIME - 0.07, 0)))  # a good regulator
        measured = np.stack([late, 0 * TIME], axis=1) + 150 * np.sin(900 * TIME)[:, None]
    if tip is None:
        tip = np.zeros((len(TIME), 3))
    values = {"time": TIME, "commanded": commanded, "measured": measured, "tip_position": tip}
    return Log(**{**values, **given})  # type: ignore[arg-type]


def test_a_good_recording_is_not_doubted() -> None:
    assert doubts([log(), log()]) == ()


@pytest.mark.parametrize("stuck", [0.0, 9e4])
def test_a_regulator_that_does_not_obey(stuck: float) -> None:
    measured = log().measured
    assert measured is not None
    measured = measured.copy()
    measured[300:, 0] = stuck
    (doubt,) = doubts([log(), log(measured=measured)])
    assert "channel 1" in doubt
    assert "bar away" in doubt


def test_a_tip_that_was_out_of_sight() -> None:
    tip = np.zeros((len(TIME), 3))
    tip[100:140] = np.nan
    (doubt,) = doubts([log(tip=tip)])
    assert "out of sight for up to 1.0 s" in doubt


def test_frames_that_did_not_come() -> None:
    kept = np.random.default_rng(0).random(len(TIME)) < 0.7
    good = log()
    assert good.measured is not None
    thin = Log(
        time=TIME[kept],
        commanded=good.commanded[kept],
        measured=good.measured[kept],
        tip_position=good.tip_position[kept],
    )
    (doubt,) = doubts([thin])
    assert "% of a recording's frames" in doubt
