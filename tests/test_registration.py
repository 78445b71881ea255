"""From a tracker's readings to the tip in the base frame: signs, and what is unseen."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from stiffopt.registration import Placement, Registration
from stiffopt.rig.interface import PoseSample, PoseTracker, RawPose

Array = NDArray[np.float64]


def quaternion_of(rotation: Rotation) -> Array:
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


def rotation_of(quaternion: ArrayLike) -> Rotation:
    w, x, y, z = np.asarray(quaternion, dtype=float)
    return Rotation.from_quat([x, y, z, w])


def matrix(position: ArrayLike, quaternion: ArrayLike) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(quaternion).as_matrix(), position
    return T


def random_placement(rng: np.random.Generator) -> Placement:
    turn = quaternion_of(Rotation.random(random_state=rng))
    return Placement(position=tuple(rng.normal(size=3)), orientation=tuple(turn))


class Tracker(PoseTracker):
    def _open(self) -> None: ...
    def _close(self) -> None: ...

    def sees(self, position: ArrayLike, quaternion: ArrayLike | None) -> PoseSample:
        self._deliver(RawPose(1.0, 7, position, quaternion, 2.0))
        (sample,) = self.read()
        assert (sample.time, sample.received, sample.frame) == (1.0, 2.0, 7)
        return sample


@pytest.fixture
def tracker() -> Tracker:
    tracker = Tracker()
    tracker.open()
    return tracker


@pytest.mark.parametrize("seed", range(30))
def test_the_tip_is_where_the_matrices_have_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base, tip = random_placement(rng), random_placement(rng)
    registration = Registration(tracker_in_base=base, tip_in_sensor=tip)
    position, turn = rng.normal(size=3), quaternion_of(Rotation.random(random_state=rng))
    expected = (
        matrix(base.position, base.orientation)
        @ matrix(position, turn)
        @ matrix(tip.position, tip.orientation)
    )
    for sign in (1, -1):
        found, quaternion = registration.tip_in_base(position, sign * turn)
        assert quaternion is not None
        np.testing.assert_allclose(matrix(found, quaternion), expected, rtol=0, atol=1e-14)
        assert quaternion[0] >= 0
        assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-14)
    alone, none = registration.tip_in_base(position, None)
    assert none is None
    there = rotation_of(base.orientation).apply(position) + base.position
    np.testing.assert_allclose(alone, there, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "half_turn", [(0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (0, 0.6, -0.8, 0), (0, -0.6, 0, 0.8)]
)
def test_of_a_half_turn_the_sign_is_always_the_same(half_turn: tuple[float, ...]) -> None:
    plus, minus = np.array(half_turn, dtype=float), -np.array(half_turn, dtype=float)
    _, one = Registration().tip_in_base(np.zeros(3), plus)
    _, other = Registration().tip_in_base(np.zeros(3), minus)
    assert one is not None
    assert other is not None
    assert one.tolist() == other.tolist()
    assert max(one, key=abs) > 0  # as `lie.quaternion_from_rotation` has it


@pytest.mark.parametrize("kind", [list, tuple, np.array, lambda v: np.array(v, dtype=np.float32)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_sample_has_length_1_and_one_sign(tracker: Tracker, kind: type, sign: int) -> None:
    turn = sign * 1.04 * np.array([0.5, 0.5, -0.5, 0.5])
    sample = tracker.sees(kind([0.1, 0.2, 0.3]), kind(turn.tolist()))
    assert sample.visible
    assert sample.quaternion == pytest.approx([0.5, 0.5, -0.5, 0.5], abs=1e-7)
    assert sample.position == pytest.approx([0.1, 0.2, 0.3], abs=1e-7)


GOOD, TURN = (0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("position", "quaternion"),
    [
        ((np.nan, 0.2, 0.3), TURN),
        ((0.1, np.inf, 0.3), TURN),
        ((0.1, 0.2, -np.inf), None),
        ((0.1, 0.2), TURN),
        ((0.1, 0.2, 0.3, 0.4), None),
        (GOOD, (np.nan, 0.0, 0.0, 0.0)),
        (GOOD, (np.inf, 0.0, 0.0, 0.0)),
        (GOOD, (1e300, 1e300, 1e300, 1e300)),
        (GOOD, (0.0, 0.0, 0.0, 0.0)),
        (GOOD, (0.94, 0.0, 0.0, 0.0)),
        (GOOD, (1.06, 0.0, 0.0, 0.0)),
        (GOOD, (1.0, 0.0, 0.0)),
        (GOOD, (1.0, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_what_is_no_pose_was_not_seen(
    tracker: Tracker, position: ArrayLike, quaternion: ArrayLike | None
) -> None:
    seen = tracker.sees(GOOD, TURN)
    assert seen.visible
    sample = tracker.sees(position, quaternion)
    assert not sample.visible
    assert sample.position.shape == (3,)
    assert np.isnan(sample.position).all()
    assert sample.quaternion is None
    assert tracker.latest is sample
    assert tracker.age() < np.inf  # of the one that was seen


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", range(3))
def test_a_sample_is_visible_if_all_of_its_position_is(bad: float, axis: int) -> None:
    position = np.array(GOOD)
    assert PoseSample(0.0, 0.0, 1, position.copy(), None).visible is True
    position[axis] = bad
    assert PoseSample(0.0, 0.0, 1, position, None).visible is False
