"""Twists and wrenches as screws: axes, pitches, magnitudes, changes of frame."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from independent.motions import hat6
from stiffopt.errors import InputError
from stiffopt.model.screws import Twist, Wrench

Vector = NDArray[np.float64]

ALIKE = settings(derandomize=True, max_examples=60, deadline=None)
numbers = st.floats(-2, 2)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
directions = vectors.filter(lambda d: np.linalg.norm(d) > 0.05)
screws = st.tuples(*[numbers] * 6).map(np.array)
motions = screws.map(lambda x: expm(hat6(x)))
kinds = st.sampled_from([Twist, Wrench])


@ALIKE
@given(kinds, vectors, directions, numbers)
def test_a_screw_gives_back_its_axis(
    kind: type[Twist | Wrench], point: Vector, direction: Vector, pitch: float
) -> None:
    screw = kind.from_axis(point, direction, pitch)
    length = np.linalg.norm(direction)
    assert screw.magnitude == pytest.approx(length)
    assert screw.axis_direction == pytest.approx(direction / length)
    assert screw.pitch == pytest.approx(pitch, abs=1e-11)
    # the nearest point of the axis: on it, and square to it
    assert screw.axis_point @ direction == pytest.approx(0, abs=1e-11)
    assert np.cross(screw.axis_point - point, direction) == pytest.approx(0, abs=1e-11)
    again = kind.from_axis(screw.axis_point, screw.magnitude * screw.axis_direction, screw.pitch)
    assert again.coordinates == pytest.approx(screw.coordinates, abs=1e-11)


@ALIKE
@given(vectors, directions, numbers)
def test_coordinates_are_those_of_equations_1_and_4(
    point: Vector, direction: Vector, pitch: float
) -> None:
    twist, wrench = (kind.from_axis(point, direction, pitch) for kind in (Twist, Wrench))
    assert twist.angular == pytest.approx(direction)
    assert twist.linear == pytest.approx(-np.cross(direction, point) + pitch * direction)
    assert wrench.force == pytest.approx(direction)
    assert wrench.moment == pytest.approx(np.cross(point, direction) + pitch * direction)


@ALIKE
@given(directions, vectors)
def test_a_twist_leaves_its_axis_in_place(direction: Vector, point: Vector) -> None:
    T = expm(hat6(Twist.from_axis(point, direction).coordinates))
    for along in (0.0, 1.7):
        p = np.append(point + along * direction, 1)
        assert T @ p == pytest.approx(p, abs=1e-11)
    advance = 0.3
    turn = 2 * np.pi * direction / np.linalg.norm(direction)
    T = expm(hat6(Twist.from_axis(point, turn, advance).coordinates))  # a whole turn
    assert T[:3, :3] == pytest.approx(np.eye(3), abs=1e-11)
    assert T[:3, 3] == pytest.approx(advance * turn, abs=1e-11)


@ALIKE
@given(kinds, vectors, directions, numbers, motions)
def test_a_change_of_frame_keeps_pitch_and_magnitude(
    kind: type[Twist | Wrench], point: Vector, direction: Vector, pitch: float, T: Vector
) -> None:
    screw = kind.from_axis(point, direction, pitch)
    moved = screw.transformed(T)
    assert type(moved) is kind
    assert moved.pitch == pytest.approx(pitch, abs=1e-9)
    assert moved.magnitude == pytest.approx(screw.magnitude)
    expected = kind.from_axis((T @ np.append(point, 1))[:3], T[:3, :3] @ direction, pitch)
    assert moved.coordinates == pytest.approx(expected.coordinates, abs=1e-11)
    back = moved.transformed(np.linalg.inv(T))
    assert back.coordinates == pytest.approx(screw.coordinates, abs=1e-11)


@ALIKE
@given(screws, screws, motions)
def test_power_is_the_same_in_every_frame(twist: Vector, wrench: Vector, T: Vector) -> None:
    power = Wrench(wrench).power(Twist(twist))
    assert power == pytest.approx(wrench[:3] @ twist[:3] + wrench[3:] @ twist[3:])
    moved = Wrench(wrench).transformed(T).power(Twist(twist).transformed(T))
    assert moved == pytest.approx(power, abs=1e-10)


@ALIKE
@given(vectors, directions, directions)
def test_lines_that_meet_do_no_work(p: Vector, a: Vector, b: Vector) -> None:
    """A pure force does no work on a pure rotation about an axis that it cuts (reciprocal)."""
    force, rotation = Wrench.from_axis(p, a), Twist.from_axis(p + 2 * b, b)
    assert force.power(rotation) == pytest.approx(0, abs=1e-11)


@pytest.mark.parametrize("kind", [Twist, Wrench])
def test_translations_and_couples_have_infinite_pitch(kind: type[Twist | Wrench]) -> None:
    free = [3.0, 0.0, 4.0]
    none = [0.0, 0.0, 0.0]
    screw = kind(np.array(free + none if kind is Twist else none + free))
    assert screw.pitch == inf
    assert screw.magnitude == 5
    assert screw.axis_direction == pytest.approx([0.6, 0, 0.8])
    assert screw.axis_point == pytest.approx([0, 0, 0])
    T = expm(hat6([0.5, -1, 2, 0.3, 0.4, -0.5]))
    moved = screw.transformed(T)
    assert moved.pitch == inf
    assert moved.magnitude == pytest.approx(5)
    assert moved.axis_direction == pytest.approx(T[:3, :3] @ [0.6, 0, 0.8])


@pytest.mark.parametrize("kind", [Twist, Wrench])
def test_the_zero_screw_has_no_axis(kind: type[Twist | Wrench]) -> None:
    zero = kind(np.zeros(6))
    assert zero.magnitude == 0
    assert zero.pitch == inf
    assert np.array_equal(zero.axis_direction, np.zeros(3))
    assert np.array_equal(zero.axis_point, np.zeros(3))


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros(5),
        np.zeros((6, 1)),
        [1, 2, 3, 4, 5, np.nan],
        [1, 2, 3, 4, 5, inf],
        "twist",
        ["1"] * 6,
        [None] * 6,
        [True] * 6,
        1j * np.ones(6),
    ],
)
@pytest.mark.parametrize("kind", [Twist, Wrench])
def test_anything_but_six_finite_numbers_is_refused(kind: type[Twist | Wrench], wrong: Any) -> None:
    with pytest.raises(InputError, match=f"a {kind.__name__.lower()} has six finite coordinates"):
        kind(wrong)


def test_screws_are_values() -> None:
    given_array = np.arange(6.0)
    twist = Twist(given_array)
    given_array[0] = 7
    assert twist.coordinates[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        twist.coordinates[0] = 1
    assert twist == Twist(range(6))  # type: ignore[arg-type]
    assert twist != Twist(np.ones(6))
    assert twist != Wrench(np.arange(6.0))
    assert twist != "twist"
    assert len({twist, Twist(np.arange(6.0)), Wrench(np.arange(6.0))}) == 2
    assert "Twist" in repr(twist)
