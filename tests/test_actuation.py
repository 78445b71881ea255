"""From pressures to forces: sections with their chambers, and corrections of what channels do."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from independent.arms import FLOP, Arm, eq_9
from stiffopt.errors import InputError
from stiffopt.model.actuation import SectionGeometry, onset
from stiffopt.model.description import RobotDescription
from stiffopt.model.segment import Corrections, Segment
from tested_laws import LAWS, TUBES, evaluated, segment_of, some_pressures, strain_and_compliance


@pytest.mark.parametrize("name", TUBES)
def test_section_properties_by_counting_cells(name: str) -> None:
    """Crude, but it knows nothing of discs, signs or parallel axes: 4e6 cells, in or out."""
    tube, n = TUBES[name], 2000
    geometry = SectionGeometry.of(segment_of(tube))
    edge = np.linspace(-1, 1, n + 1) * tube.outer_radius
    x, y = np.meshgrid((edge[1:] + edge[:-1]) / 2, (edge[1:] + edge[:-1]) / 2)
    cell = (edge[1] - edge[0]) ** 2
    solid = (x**2 + y**2 < tube.outer_radius**2) & (x**2 + y**2 > tube.inner_radius**2)
    bores = []
    for angle in np.radians(tube.angles):
        cx, cy = tube.offset * np.cos(angle), tube.offset * np.sin(angle)
        bores.append((x - cx) ** 2 + (y - cy) ** 2 < tube.chamber_radius**2)
    for bore in bores:
        solid &= ~bore
    xs, ys = x[solid], y[solid]
    size = tube.outer_radius
    assert xs.size * cell == pytest.approx(geometry.area, rel=1e-3)
    assert geometry.centroid == pytest.approx([xs.mean(), ys.mean()], abs=1e-4 * size)
    moments = np.cov(xs, ys, bias=True) * xs.size * cell
    assert geometry.second_moment == pytest.approx(moments, abs=1e-3 * moments.max())
    for channel, members in enumerate(tube.channels):
        fed = np.logical_or.reduce([bores[number - 1] for number in members])
        area = fed.sum() * cell
        assert geometry.channel_force[channel] == pytest.approx(area, rel=3e-3)
        first = [x[fed].sum() * cell, y[fed].sum() * cell]
        assert geometry.channel_moment[channel] == pytest.approx(first, abs=3e-3 * area * size)


def test_chambers_and_moments_of_equations_8_and_9() -> None:
    """Six chambers at eq. 9's angles, each adding ``(0, 0, f; r x f)``, pair by pair."""
    p = np.array([0.3e5, 1.1e5, 0.7e5])
    wrench = np.zeros(6)
    for i in range(1, 7):
        turn = np.radians(eq_9(i))
        r = 0.0101 * np.array([np.cos(turn), np.sin(turn), 0])
        f = np.array([0, 0, p[(i - 1) // 2] * np.pi * 0.00225**2])
        wrench += np.concatenate([f, np.cross(r, f)])
    E = 100e3 - 0.2 * np.linalg.norm(p)
    strain, _ = strain_and_compliance(FLOP, p)
    stretch = 1 + wrench[2] / (E * 1.2 * 547.8e-6)
    kappa = wrench[3:5] / (E * 1.05 * 3.445e-8)
    # only as many digits as Table II has
    assert strain == pytest.approx([0, 0, stretch, *(stretch * kappa), 0], rel=2e-4, abs=1e-12)


@pytest.mark.parametrize("band", [1.0, 2e3, 3e4])
def test_the_onset_is_smooth_and_monotone(band: float) -> None:
    p = ca.SX.sym("p")
    value = onset(p, band)
    slope = ca.jacobian(value, p)
    f = ca.Function("onset", [p], [value, slope, ca.jacobian(slope, p)])
    w = band / 2
    places = [0.0, 1e-9, band / 3, band, band * (1 + 1e-12), 16 * band, 16.5 * band, 21 * band, 1e7]
    for place in places:
        z = (place - band) / w
        found = [float(part) for part in f(place)]
        rise = 1 / (1 + np.exp(-z))
        assert found[0] == pytest.approx(
            w * (np.logaddexp(0, z) - np.logaddexp(0, -2)), rel=1e-12, abs=1e-12 * band
        )
        assert found[1] == pytest.approx(rise, rel=1e-12)
        assert found[2] * w == pytest.approx(rise * (1 - rise), rel=1e-9, abs=1e-12)
    many = f(np.linspace(0, 30 * band, 4001)[np.newaxis])[0].full()[0]
    assert (np.diff(many) > 0).all()
    assert many[0] == 0


@pytest.mark.parametrize("law", LAWS)
def test_corrections_are_dead_band_then_gain_then_offset(law: str) -> None:
    tube = LAWS[law](FLOP)
    gain, offset = np.array([1.1, 0.9, 1.0]), np.array([2e3, -1e3, 0.0])
    corrections = Corrections(gain=gain, offset=offset, dead_band=8e3)
    corrected = Segment(**tube.mapping() | {"corrections": corrections})
    for seed in range(3):
        p = some_pressures(tube, seed)
        z = (p - 8e3) / 4e3
        acting = gain * 4e3 * (np.logaddexp(0, z) - np.logaddexp(0, -2)) + offset
        for found, expected in zip(
            evaluated(corrected, p), evaluated(segment_of(tube), acting), strict=True
        ):
            assert found == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("law", LAWS)
def test_an_azimuth_turns_the_moment_of_its_channel(law: str) -> None:
    """In a law that is linear in the moment, those of channels add up."""
    tube = LAWS[law](replace(FLOP, factors=None))
    azimuth = np.array([0.1, -0.2, 0.3])
    segment = Segment(**tube.mapping() | {"corrections": Corrections(azimuth=azimuth)})
    p = some_pressures(tube)
    stretched = np.full(3, p.mean())  # the same force, and no moment
    rest, C = evaluated(segment_of(tube), stretched)
    expected = rest[3:5].copy()
    for channel, turn in enumerate(azimuth):
        alone = stretched + np.where(np.arange(3) == channel, p[channel], 0) - p[channel] / 3
        c, s = np.cos(turn), np.sin(turn)
        expected += np.array([[c, -s], [s, c]]) @ evaluated(segment_of(tube), alone)[0][3:5]
    strain, turned = evaluated(segment, p)
    assert strain[3:5] == pytest.approx(expected, rel=1e-10)
    assert strain[2] == pytest.approx(rest[2], rel=1e-12)
    assert turned == pytest.approx(C, rel=1e-12, abs=1e-15)


def test_a_dead_band_needs_pressures_that_are_never_negative() -> None:
    mapping = Arm((FLOP, FLOP)).mapping()
    mapping["segments"][1]["corrections"] = {"dead_band": 8e3}
    robot = RobotDescription(**mapping)
    assert robot.segments[1].corrections == Corrections(dead_band=8e3)
    lowest = [-1e3, -1e3, -1e3, 0.0, 0.0, 0.0]
    RobotDescription(**mapping | {"pressure": {"min": lowest, "max": 1e5}})
    lowest[4] = -1e3
    with pytest.raises(InputError, match=r"segments\[1\]\.corrections\.dead_band.*-0\.01 bar"):
        RobotDescription(**mapping | {"pressure": {"min": lowest, "max": 1e5}})
