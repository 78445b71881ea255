"""How much farther than modelled an arm may respond until feedback makes it swing.

One axis: regulator with dead time and lag, bending mode, tracker with its delay; the loop's own
estimator, average and gains. The mode takes part with another share of the tip's displacement than
that of the straight arm, which is 1, and vibrates at 1.48 Hz instead of 1.41 Hz.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stiffopt.control.estimator import TipEstimator
from stiffopt.control.feedback import GainSchedule
from stiffopt.control.reference import VibrationFilter
from stiffopt.control.tuning import EstimatorTuning, FeedbackTuning
from stiffopt.control.vibration import BendingMode, transition
from stiffopt.optimise.tip import TipAt
from stiffopt.rig.tracking import PoseSample

PERIOD, FRAMES, LATENCY = 0.01, 0.025, 0.025  # s
LAG, DEAD_TIME, FINE = 0.06, 0.01, 0.001  # s
MODELLED, TRUE = 2 * np.pi * 1.41, 2 * np.pi * 1.48  # rad/s
DAMPING, TRUE_DAMPING = 0.04, 0.02
MASS, AMPLITUDE, NOISE = 0.04, 2e-3, 5e-5
LEARNS = EstimatorTuning()
KNOWS = replace(LEARNS, frequency_offset=0.0, frequency_deviation=0.0)  # so it believes


def swing(
    response: float, share: float, believed: float, tuning: EstimatorTuning, duration: float = 8.0
) -> float:
    """Return the swing from end to end in the last second, in m, of an arm that swings at first.

    It responds `response` times as far as modelled, and the mode takes part with `share`; the loop
    believes in the share `believed`. A pressure is given as its displacement; `tuning` is that of
    the estimator.
    """
    stiffness, rng = MASS * MODELLED**2, np.random.default_rng(0)
    estimator = TipEstimator(PERIOD, 1, BendingMode(MASS, np.full(1, believed)), tuning)
    gains = GainSchedule(PERIOD, LAG, DAMPING, FeedbackTuning().effort).at(MODELLED)
    weight = FeedbackTuning().mode_weight ** 2
    averaged = VibrationFilter(PERIOD, DAMPING, 1)
    averaged.begin(np.zeros(1))
    jacobian = np.zeros((6, 1))
    jacobian[0] = 1.0
    compliance = np.diag([1 / stiffness] * 2 + [1e-6] + [1.0] * 3)
    step, forward = np.array(transition(TRUE, TRUE_DAMPING, FINE)), np.exp(-FINE / LAG)
    p, mode, commands, frames, seen = 0.0, np.array([AMPLITUDE, 0.0]), [0.0], 0, []
    samples: list[PoseSample] = []
    for tick in range(round(duration / PERIOD)):
        now, pose = tick * PERIOD, np.eye(4)
        estimator.learns = now < LEARNS.swings_on  # as after a motion
        pose[:3, 3] = p, 0.0, 0.18
        estimator.advance(now, np.array([p]), TipAt(pose, jacobian, compliance))
        estimator.take([s for s in samples if s.time + LATENCY <= now + 1e-9])
        samples = [s for s in samples if s.time + LATENCY > now + 1e-9]
        averaged.advance(estimator.offset[:1], MODELLED)
        goal, (reached, moving) = -averaged.value[0], -averaged.motion[:, 0]
        settles = np.exp(-DEAD_TIME / LAG)
        ahead = p * settles + commands[-1] * (1 - settles)
        later = np.array(transition(MODELLED, DAMPING, DEAD_TIME)) @ estimator.vibration[:, 0]
        sigma, tip = believed * ahead - goal, believed * ahead + later[0] - reached
        wanted = goal - gains @ np.array([sigma, tip, later[1] - moving])
        commands.append((1 + weight * believed) / (1 + weight * believed**2) * wanted)
        for fine in range(round(PERIOD / FINE)):
            p = p * forward + commands[-2] * (1 - forward)  # one dead time ago
            rest = share * response * p
            mode = step @ (mode - [rest, 0.0]) + [rest, 0.0]
            time = now + (fine + 1) * FINE
            if time >= (frames + 1) * FRAMES - 1e-9:
                frames += 1
                x = (1 - share) * response * p + mode[0]
                noisy = np.array([x, 0.0, 0.18]) + NOISE * rng.standard_normal(3)
                samples.append(PoseSample(time, time + LATENCY, frames, noisy, None))
        seen.append((1 - share) * response * p + mode[0])
    last = np.array(seen[-round(1 / PERIOD) :])
    times = np.linspace(-1, 1, len(last))
    return float(np.ptp(last - np.polyval(np.polyfit(times, last, 1), times)))


@pytest.mark.parametrize(
    ("share", "response", "believed", "tuning", "rests"),
    [
        (1.0, 2.0, 1.0, KNOWS, True),
        (1.4, 1.1, 1.0, KNOWS, True),
        (1.4, 1.7, 1.0, KNOWS, False),
        (1.6, 1.35, 1.0, KNOWS, False),
        (1.4, 1.8, 1.4, KNOWS, True),
        (1.6, 1.8, 1.6, KNOWS, True),
        (1.0, 2.0, 1.0, LEARNS, True),
        (1.4, 1.1, 1.0, LEARNS, True),
        (1.4, 1.8, 1.4, LEARNS, True),
        (1.6, 1.8, 1.6, LEARNS, True),
    ],
)
def test_a_loop_with_the_share_of_the_bent_arm_rests_where_that_of_the_straight_one_swings(
    share, response, believed, tuning, rests
):
    amplitude = swing(response, share, believed, tuning)
    assert amplitude < 4e-4 if rests else amplitude > 1e-3
