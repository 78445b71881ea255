"""Slopes of force against displacement, and their intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from stiffopt.experiments.slope import LineFit, combine, fit_line, fit_lines, student_t


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 10, 11, 54, 301])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_students_quantile(confidence: float, freedom: int) -> None:
    expected = stats.t.ppf((1 + confidence) / 2, freedom)
    assert student_t(confidence, freedom) == pytest.approx(expected, rel=1e-10)


def test_a_line_by_least_squares() -> None:
    random = np.random.default_rng(0)
    x = np.linspace(0, 0.003, 9)
    y = 14 * x + 0.01 + 1e-3 * random.normal(size=9)
    found, expected = fit_line(x, y), stats.linregress(x, y)
    assert found is not None
    assert found.slope == pytest.approx(expected.slope)
    assert found.freedom == 7
    assert found.sigma == pytest.approx(expected.stderr)
    assert fit_line(x[:2], y[:2]) is None
    assert fit_line([1, 1, 1], [1, 2, 3]) is None
    assert fit_line([1, np.nan, 2], [1, 2, 3]) is None


def test_a_trend_is_taken_off_where_it_can_be_told() -> None:
    random = np.random.default_rng(0)
    x, t = np.array([0, 1, 2, 3, 2, 1, 0.0]), np.arange(7.0)
    y = 14 * x - 0.3 * t + 0.1 * random.normal(size=7)
    columns = np.stack([np.ones(7), x, t], axis=1)
    expected, (rest,), _, _ = np.linalg.lstsq(columns, y)
    sigma = math.sqrt(rest / 4 * np.linalg.inv(columns.T @ columns)[1, 1])
    found = fit_line(x, y, t)
    assert found is not None
    assert (found.slope, found.sigma) == pytest.approx((expected[1], sigma))
    assert (found.freedom, found.points) == (4, 7)
    alike = fit_line(t, y, t + 1e-3 * random.normal(size=7))
    plain = fit_line(t, y)
    assert alike is not None
    assert plain is not None
    assert (alike.slope, alike.freedom) == pytest.approx((plain.slope, 5))


def test_what_bends_beyond_doubt_is_fitted_by_a_parabola() -> None:
    """The slope that counts is that of the arm at rest, where x is 0."""
    random = np.random.default_rng(1)
    x, t = np.array([0, 1, 2, 3, 4, 3, 2, 1, 0.0]), np.arange(9.0)

    def repeated(bend: float) -> list[float]:
        series = [
            (x, 14 * x + bend * x**2 + 0.1 * t + 0.2 * random.normal(size=9), t) for _ in range(4)
        ]
        lines = fit_lines(series)
        assert {line.freedom for line in lines} == ({5} if bend else {6})
        return [line.slope for line in lines]

    np.testing.assert_allclose(repeated(0.0), 14, atol=0.25)
    np.testing.assert_allclose(repeated(-1.0), 14, atol=0.9)
    columns = np.stack([np.ones(9), x, x**2, t], axis=1)
    y = random.normal(size=9)
    found = fit_line(x, y, t, curved=True)
    assert found is not None
    assert found.slope == pytest.approx(np.linalg.lstsq(columns, y)[0][1])


def test_repetitions_that_differ_are_believed_over_residuals_that_do_not() -> None:
    lines = [LineFit(slope, 0.01, 7, 9) for slope in (13.0, 14.0, 15.0)]
    found = combine(lines)
    assert found is not None
    assert found.value == pytest.approx(14)
    assert found.spread == pytest.approx(1)
    assert found.sigma == pytest.approx(1 / math.sqrt(3))
    assert found.half_width == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)


def test_repetitions_that_agree_by_luck_do_not_hide_the_residuals() -> None:
    found = combine([LineFit(14.0, 0.5, 7, 9)] * 2)
    assert found is not None
    assert found.sigma == pytest.approx(0.5 / math.sqrt(2))
    assert found.half_width == pytest.approx(2.1448 * 0.5 / math.sqrt(2), rel=1e-4)
    assert combine([]) is None


@pytest.mark.parametrize("between", [0.0, 0.5])
def test_the_interval_holds_the_truth_as_often_as_it_says(between: float) -> None:
    random = np.random.default_rng(7)
    x, held, trials = np.linspace(0, 3, 7), 0, 800
    for _ in range(trials):
        lines = []
        for _ in range(5):
            slope = 14 + between * random.normal()
            line = fit_line(x, slope * x + random.normal(size=7) * 0.5)
            assert line is not None
            lines.append(line)
        found = combine(lines)
        assert found is not None
        held += abs(found.value - 14) <= found.half_width
    assert 0.93 <= held / trials <= 0.995
