"""The feedback law at the tip, against the same in plain NumPy and a swing in fine steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from stiffopt import Target, lie
from stiffopt.control.feedback import (
    prescribed_components,
    tracking_rows,
    with_excess,
    with_offsets,
    with_reference,
)
from stiffopt.control.formula import Formula
from stiffopt.control.tuning import FeedbackTuning

LEVER = FeedbackTuning().lever
N, DAMPING, DEAD_TIME = 6, 0.04, 0.013
TARGETS = {
    "position": Target(position=(0.01, 0.0, 0.2)),
    "height": Target(position=(None, None, 0.2)),
    "pointing": Target(position=(0.01, 0.0, 0.2), pointing=(0.0, 0.0, 1.0)),
    "pose": Target(position=(0.01, 0.0, 0.2), orientation=(1.0, 0.0, 0.0, 0.0)),
}


def drawn(seed):
    """A tip and what is known of it, at random."""
    rng = np.random.default_rng(seed)
    pose = np.array(lie.exp(np.concatenate([rng.normal(size=3) * 0.1, rng.normal(size=3) * 0.5])))
    jacobian = rng.normal(size=(6, N)) * np.repeat([3e-7, 3e-6], 3)[:, None]
    correction = rng.normal(size=6) * np.repeat([1e-3, 1e-2], 3)
    root = rng.normal(size=(3, 3))
    swing = (
        rng.normal(size=(2, 3)) * [[1e-3], [1e-2]], root @ root.T / 4,
        rng.normal(size=(3, N)) * 3e-7, 9.0,
        rng.uniform(0, 1, 3), *(rng.uniform(0, 1e5, N) for _ in range(4)), rng.normal(size=N) * 1e5,
        rng.normal(size=(2, 3)) * [[1e-3], [1e-2]],
    )  # fmt: skip
    return pose, jacobian, correction, swing


def evaluated(system, *values):
    outputs = [system.rows, system.values, system.linear]
    return Formula(system.inputs, outputs, [*system.matrices, system.rows, system.linear])(*values)


def task(pose, jacobian, correction, target, feedback):
    """Rows and values that a target asks for, one after the other."""
    R = pose[:3, :3]
    linear, angular = R @ jacobian[:3], jacobian[3:]  # in base axes, in the tip's
    shift, turn = correction[:3] + feedback, R.T @ correction[3:]
    rows, values = [], []
    for k in range(3):
        if target.position[k] is not None:
            rows.append(linear[k])
            values.append(shift[k])
    if target.pointing is not None:
        rows += list(LEVER * angular[:2])
        values += list(LEVER * turn[:2])
    if target.orientation is not None:
        rows += list(LEVER * angular)
        values += list(LEVER * turn)
    return np.array(rows), np.array(values)


@pytest.mark.parametrize("name", list(TARGETS))
@pytest.mark.parametrize("swings", [True, False])
def test_rows_are_those_of_the_task(name, swings):
    target, system = TARGETS[name], tracking_rows(N, swings, DAMPING, DEAD_TIME)
    pose, jacobian, correction, swing = drawn(3)
    if swings:  # without feedback
        swing = (*swing[:4], np.zeros(3), *swing[5:])
    given = (pose, jacobian, prescribed_components(target), correction, *(swing if swings else ()))
    rows, values, linear = evaluated(system, *given)
    expected, wanted = task(pose, jacobian, correction, target, np.zeros(3))
    rows, values = rows[: system.task_rows], values[: system.task_rows]
    used = np.abs(rows).sum(axis=1) > 0
    assert rows[used] == pytest.approx(expected, rel=1e-12)
    assert values[used] == pytest.approx(wanted, rel=1e-9, abs=1e-15)
    assert not values[~used].any()
    assert linear == pytest.approx(pose[:3, :3] @ jacobian[:3], rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_feedback_of_an_arm_that_swings(seed):
    target, system = TARGETS["position"], tracking_rows(N, True, DAMPING, DEAD_TIME)
    pose, jacobian, correction, swing = drawn(seed)
    now, across, own, omega, gains, ahead, strained, chamber, path, rate, intended = swing
    given = (pose, jacobian, prescribed_components(target), correction, *swing)
    rows, values, _ = evaluated(system, *given)
    home, (there, moving) = across @ correction[:3], intended @ across
    free = np.array([[0, 1], [-(omega**2), -2 * DAMPING * omega]])
    later = expm(DEAD_TIME * free) @ now
    sigma = own @ (ahead - chamber) - home
    tip, speed = own @ (strained - path) + later[0] - there, later[1] - own @ rate - moving
    feedback = -(gains[0] * sigma + gains[1] * tip + gains[2] * speed)
    expected, wanted = task(pose, jacobian, correction, target, feedback)
    assert rows[:3] == pytest.approx(expected, rel=1e-12)
    assert values[:3] == pytest.approx(wanted, rel=1e-9)
    weight = np.linalg.norm(rows[8:]) / np.linalg.norm(own)
    assert weight > 1
    assert rows[8:] == pytest.approx(weight * own, rel=1e-9)
    assert values[8:] == pytest.approx(weight * (home + feedback), rel=1e-9)


@pytest.mark.parametrize("most", [np.inf, 1e-3])
@pytest.mark.parametrize("swings", [True, False])
def test_the_law_finds_its_correction_from_the_offset_and_its_average(swings, most):
    """The average counts, the present offset along a stiff axis; what grows with motion is led."""
    pose, jacobian, _, swing = drawn(5)
    rng = np.random.default_rng(6)
    accounted, offset = rng.normal(size=(2, 6)) * 1e-3
    average = np.concatenate([rng.normal(size=6) * 1e-3, pose[:3, 3] + rng.normal(size=3) * 1e-2])
    slope, stiff, rate, delay = (
        0.1 * rng.normal(size=(3, 3)),
        np.diag([0.0, 0.3, 0.9]),
        swing[8],
        0.1,
    )
    velocity = pose[:3, :3] @ jacobian[:3] @ rate
    grown = slope @ (pose[:3, 3] - average[6:])
    corrected = average[:6].copy()
    corrected[:3] += grown + slope @ velocity * delay
    corrected[:3] += stiff @ (offset[:3] - average[:3] - grown)
    correction = accounted - corrected
    size = np.linalg.norm(correction[:3])
    assert size > 1e-3
    correction *= min(1.0, most / size)
    law, dynamic = tracking_rows(N, swings, DAMPING, DEAD_TIME), swing if swings else ()
    known = (accounted, offset, average, slope, stiff, rate, delay, most)
    plain = evaluated(law, pose, jacobian, np.ones(5), correction, *dynamic)
    found = evaluated(with_offsets(law), pose, jacobian, np.ones(5), *dynamic, *known)
    for value, expected in zip(found, plain, strict=True):
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("swings", [True, False])
def test_the_law_takes_what_it_needs_from_reference_and_averages(swings):
    pose, jacobian, _, swing = drawn(9)
    rng = np.random.default_rng(10)
    motion, averages = rng.normal(size=(4, N + 6)), rng.normal(size=(3, 9)) * 1e-2
    offset, slope, stiff = rng.normal(size=6), rng.normal(size=(3, 3)), np.diag([0.0, 0.3, 0.9])
    path, rate = motion[:2]
    dynamic = ()
    if swings:
        intended = motion[:2, N : N + 3] - averages[1:, :3]
        dynamic = (*swing[:8], path[:N], rate[:N], intended)
    known = (path[N:], offset, averages[0], slope, stiff, rate[:N], 0.1, np.inf)
    law = with_offsets(tracking_rows(N, swings, DAMPING, DEAD_TIME))
    plain = evaluated(law, pose, jacobian, np.ones(5), *dynamic, *known)
    given = (*dynamic[:8], offset, slope, stiff, 0.1, np.inf, motion, averages)
    found = evaluated(with_reference(law), pose, jacobian, np.ones(5), *given)
    for value, expected in zip(found, plain, strict=True):
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_the_law_finds_the_mode_from_the_shares_of_its_channels_and_an_excess():
    pose, jacobian, correction, swing = drawn(7)
    now, across, excess, *others = swing
    shares = np.random.default_rng(8).uniform(0.3, 1.5, N)
    own = across @ pose[:3, :3] @ jacobian[:3] * shares + excess
    law, given = (
        tracking_rows(N, True, DAMPING, DEAD_TIME),
        (pose, jacobian, np.ones(5), correction),
    )
    plain = evaluated(law, *given, now, across, own, *others)
    found = evaluated(with_excess(law, shares), *given, now, across, excess, *others)
    for value, expected in zip(found, plain, strict=True):
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-15)
    assert np.abs(own - excess).max() > 0.1 * np.abs(excess).max()
