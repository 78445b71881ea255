"""Builds the arrays of the simulated rod and its material from a robot file."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import NO_HISTORY, Memory
from stiffopt.model.segment import Compensation, Corrections, Segment
from stiffopt.plant.material import LINEAR, YEOH, SectionMaterial
from stiffopt.plant.rod import DiscreteRod
from stiffopt.plant.settings import Mismatch, PlantSettings
from stiffopt.registration import Placement

_ON_RING = 6  # fibres on each of two rings
_SAME = 1e-6  # of a segment's length; a load as near to a node as this acts on the node
_DENSITY = 1070.0  # kg/m^3, of silicone; for robots without gravity and density


class ChannelEffects(NamedTuple):
    """The effect of the channels: corrections of the robot file, plus the mismatch.

    `dead_band`, `gain`, `offset`: (n,); ``gain onset(p) + offset`` acts if the shape is that of the
    pressure p, Pa; see `stiffopt.model.segment.Corrections`. `angle`: rotation of the channel's
    chambers about the axis (n,), rad.
    """

    dead_band: Array
    gain: Array
    offset: Array
    angle: Array

    def acting(self, effective: Array) -> Array:
        """Return the pressures (m, n) that act for shapes of effective ones (m, n), in Pa."""
        if self.dead_band.any():
            w = np.where(self.dead_band > 0, self.dead_band / 2, 1.0)
            begun = w * (np.logaddexp(0, (effective - self.dead_band) / w) - np.logaddexp(0, -2))
            effective = np.where(self.dead_band > 0, begun, effective)
        return np.ascontiguousarray(effective * self.gain + self.offset)


def make_channels(robot: RobotDescription, mismatch: Mismatch) -> ChannelEffects:
    """Return the effect of the channels of an arm that has this mismatch."""
    parts = [(s.corrections or Corrections(), s.n_channels) for s in robot.segments]
    gain = np.concatenate([corrections.gain or (1.0,) * n for corrections, n in parts])
    offset = np.concatenate([corrections.offset or (0.0,) * n for corrections, n in parts])
    angle = np.concatenate([corrections.azimuth or (0.0,) * n for corrections, n in parts])
    further = np.array(mismatch.gain or (1.0,) * robot.n_pressures)
    return ChannelEffects(
        dead_band=np.concatenate([np.full(n, corrections.dead_band) for corrections, n in parts]),
        gain=further * gain,
        offset=further * offset + np.array(mismatch.offset or (0.0,) * robot.n_pressures),
        angle=angle + np.array(mismatch.angle or (0.0,) * robot.n_pressures),
    )


def _check_compensation(given: Compensation, index: int) -> None:
    """Raise `InputError` if a segment has a compensation that the simulator does not support."""
    plain = {"bending_radius": 0, "lengthening": 0, "modulus_law": "linear"}
    for name, value in plain.items():
        if getattr(given, name) != value:
            raise InputError(
                f"the simulated arm has no segments[{index}].compensation.{name}; simulate a "
                "robot without it, which the optimiser's model may still have"
            )


def make_memory(robot: RobotDescription) -> Memory | None:
    """Return the channels' histories, or None if shapes follow the pressures at once."""
    histories = [s.history or NO_HISTORY for s in robot.segments for _ in range(s.n_channels)]
    if all(history == NO_HISTORY for history in histories):
        return None
    return Memory(histories, [c for s in robot.segments for c in range(s.n_channels)])


def make_rod(
    robot: RobotDescription, settings: PlantSettings, mismatch: Mismatch, station: float | None
) -> DiscreteRod:
    """Discretise the arm.

    Parameters
    ----------
    robot : description of the arm.
    settings : settings of the plant.
    mismatch : the mismatch of this arm, including its random part.
    station : arc length at rest that must be a node, in m; None for the tip.
    """
    grid = settings.discretisation
    bending, shear = grid.bending_degree + 1, grid.shear_degree + 1
    count = np.array([shear, shear, shear, bending, bending, shear])
    basis_size = max(bending, shear)
    points, weights = legendre.leggauss(max(grid.bending_degree, grid.shear_degree) + 2)
    lengths = _lengths(robot, mismatch)
    cuts = [_cuts(grid.sub_intervals) for _ in robot.segments]
    if station is not None:
        segment, place, _ = station_of(robot, station)
        if np.abs(cuts[segment] - place).min() > _SAME:
            cuts[segment] = np.sort(np.append(cuts[segment], place))
    most = max(len(c) - 1 for c in cuts)
    interval = np.zeros((len(cuts), most))
    interval_basis = np.zeros((len(cuts), most, 2, basis_size))
    for s, c in enumerate(cuts):
        h = np.diff(c)
        interval[s, : len(h)] = h * lengths[s]
        middle = 0.5 * (c[1:] + c[:-1])
        for m in range(len(h)):
            gauss = middle[m] + h[m] * np.array([-1, 1]) / (2 * math.sqrt(3))
            interval_basis[s, m] = _legendre(gauss, basis_size)
    intervals = np.array([len(c) - 1 for c in cuts])
    first_node = np.concatenate(([0], np.cumsum(intervals + 1)[:-1]))
    base = mismatch.base.transform()
    gravity = robot.gravity if settings.gravity is None else settings.gravity
    return DiscreteRod(
        first=np.concatenate(([0], np.cumsum(count)[:-1])),
        count=count,
        per_segment=int(count.sum()),
        length=lengths,
        connector=np.array([segment.connector for segment in robot.segments]),
        first_node=first_node,
        intervals=intervals,
        interval=interval,
        interval_basis=interval_basis,
        weight=weights / 2,
        basis=_legendre((points + 1) / 2, basis_size),
        base_rotation=np.ascontiguousarray(base[:3, :3]),
        base_position=np.ascontiguousarray(base[:3, 3]),
        mass=_masses(robot, settings, lengths, cuts, grid.sub_intervals),
        gravity=np.array(gravity, dtype=float),
    )


def station_of(robot: RobotDescription, at: float) -> tuple[int, float, float]:
    """Return segment (from 0), place within it (0 to 1) and lever on its connector (m).

    `robot`: defines the lengths; those of the simulated arm do not count. `at`: arc length at rest,
    connectors included, in m. Raises `InputError`: the arm is shorter.
    """
    begin = 0.0
    for s, segment in enumerate(robot.segments):
        end = begin + segment.length
        if begin <= at <= end:
            return s, (at - begin) / segment.length, 0.0
        begin = end + segment.connector
        if end < at <= begin * (1 + 1e-9):
            return s, 1.0, at - end
    raise InputError(
        f"a load at {at * 1e3:g} mm is not on the arm, which is {begin * 1e3:g} mm long"
    )


def _lengths(robot: RobotDescription, mismatch: Mismatch) -> Array:
    factors = mismatch.length or (1.0,) * robot.n_segments
    return np.array([s.length * f for s, f in zip(robot.segments, factors, strict=True)])


def _legendre(places: Array, size: int) -> Array:
    """Return values (m, size) of Legendre polynomials at places (m,) between 0 and 1."""
    values = legendre.legvander(2 * np.asarray(places) - 1, size - 1)
    return np.ascontiguousarray(values, dtype=float)  # compiled code expects this layout


def _cuts(intervals: int) -> Array:
    """Return the ends of intervals, from 0 to 1: Lobatto points, which integrate inertia best."""
    inner = np.sort(legendre.legroots(legendre.legder([0] * intervals + [1])))
    return np.concatenate(([0.0], (inner + 1) / 2, [1.0]))


def _lobatto_weights(intervals: int) -> Array:
    x = 2 * _cuts(intervals) - 1
    values = legendre.legval(x, [0] * intervals + [1])
    return 1 / (intervals * (intervals + 1) * values**2)


def _masses(
    robot: RobotDescription,
    settings: PlantSettings,
    lengths: Array,
    cuts: list[Array],
    intervals: int,
) -> Array:
    """Return the mass of each node over (position, x axis, y axis) (N, 3, 3)."""
    masses = []
    for s, segment in enumerate(robot.segments):
        density = segment.material.density or _DENSITY
        per_length = density * _section_moments(segment)
        at = dict(zip(_cuts(intervals), _lobatto_weights(intervals), strict=True))
        masses += [at.get(place, 0.0) * lengths[s] * per_length for place in cuts[s]]
    tip = np.zeros((3, 3))
    tip[0, 0] = robot.tip_mass + settings.payload
    return np.array([*masses, tip])


def _section_moments(segment: Segment) -> Array:
    """Return ``int (1, x, y) (1, x, y)' dA`` (3, 3) of the silicone at rest, about the axis."""
    x, y, dA = _quadrature(segment)
    places = np.stack([np.ones_like(x), x, y])
    moments = (places * dA) @ places.T
    moments[np.abs(moments) < 1e-14 * moments[0, 0]] = 0.0
    return np.asarray(moments)


def make_material(
    robot: RobotDescription,
    settings: PlantSettings,
    mismatch: Mismatch,
    channels: ChannelEffects,
    viscosity: float,
) -> SectionMaterial:
    """Return the sections of the arm; `viscosity` is the dashpot's over E, in s.

    Raises `InputError`: the robot file has a compensation that the simulator does not support.
    """
    silicone = settings.silicone
    n = robot.n_segments
    factors = mismatch.modulus or (1.0,) * n
    modulus, slope, shear, torsion = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    actuation, actuation_slope = np.empty(n), np.empty(n)
    centroid = np.empty((n, 2))
    fibres, area = np.empty((n, 2 * _ON_RING, 2)), np.empty((n, 2 * _ON_RING))
    for s, segment in enumerate(robot.segments):
        lamb = segment.compensation or Compensation()
        _check_compensation(lamb, s)
        actuation[s] = lamb.stiffness
        modulus[s] = segment.material.youngs_modulus * factors[s] * lamb.stiffness
        actuation_slope[s] = lamb.modulus_per_pressure * factors[s] * lamb.stiffness
        slope[s] = actuation_slope[s] * lamb.softening
        fibres[s], area[s] = _fibres(segment, lamb.area, lamb.inertia)
        centroid[s] = area[s] @ fibres[s] / area[s].sum()
        in_shear = 1 / (2 * (1 + segment.material.poisson_ratio))  # G / E
        shear[s] = in_shear * area[s].sum()
        torsion[s] = in_shear * (area[s] @ ((fibres[s] - centroid[s]) ** 2).sum(axis=1))
    force, first = _chambers(robot, channels)
    return SectionMaterial(
        law=LINEAR if silicone.law == "linear" else YEOH,
        stiffening=silicone.stiffening if silicone.law == "yeoh" else 0.0,
        viscosity=viscosity,
        creep_share=np.array([c.share for c in silicone.creep], dtype=float),
        creep_time=np.array([c.time for c in silicone.creep], dtype=float),
        slip_share=np.array([h.share for h in silicone.hysteresis], dtype=float),
        slip_strain=np.array([h.strain for h in silicone.hysteresis], dtype=float),
        modulus=modulus,
        modulus_slope=slope,
        actuation=actuation,
        actuation_slope=actuation_slope,
        shear=shear,
        torsion=torsion,
        centroid=centroid,
        fibre_x=np.ascontiguousarray(fibres[:, :, 0]),
        fibre_y=np.ascontiguousarray(fibres[:, :, 1]),
        fibre_area=area,
        first_channel=np.cumsum([0, *(segment.n_channels for segment in robot.segments)]),
        channel_force=force,
        channel_x=first[:, 0].copy(),
        channel_y=first[:, 1].copy(),
    )


def _fibres(segment: Segment, scale_area: float, scale_inertia: float) -> tuple[Array, Array]:
    """Return fibres (f, 2) that represent a section, and their areas (f,).

    They form two rings, mapped to match the section's second moments, with the radii and areas of
    the Gauss rule for the squared distance. For a symmetric section, moments of area up to the
    sixth are exact. The compensation scales area and second moments.
    """
    x, y, dA = _quadrature(segment)
    area = dA.sum()
    places = np.stack([x, y], axis=1)
    centroid = dA @ places / area
    places = places - centroid
    values, axes = np.linalg.eigh((places.T * dA) @ places / area)
    root = axes @ np.diag(np.sqrt(values)) @ axes.T
    squared = ((places @ np.linalg.inv(root)) ** 2).sum(axis=1)
    m1, m2, m3 = (dA @ squared**k / area for k in (1, 2, 3))
    # orthogonal polynomial t^2 - b t + c of the measure; its roots are the squared radii
    b, c = np.linalg.solve([[m1, -1.0], [m2, -m1]], [m2, m3])
    radii = np.sort(np.roots([1.0, -b, c]).real)
    outer_share = (m1 - radii[0]) / (radii[1] - radii[0])
    rings, areas = [], []
    for ring, (radius, share) in enumerate(zip(radii, (1 - outer_share, outer_share), strict=True)):
        angles = 2 * np.pi * (np.arange(_ON_RING) + 0.5 * ring) / _ON_RING
        rings.append(math.sqrt(radius) * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        areas.append(np.full(_ON_RING, share * area * scale_area / _ON_RING))
    spread = math.sqrt(scale_inertia / scale_area)
    return centroid + spread * np.concatenate(rings) @ root.T, np.concatenate(areas)


def _quadrature(segment: Segment) -> tuple[Array, Array, Array]:
    """Return points and weights (m,) of a section, exact up to degree seven: discs minus discs."""
    chambers = segment.chambers
    discs = [(0.0, 0.0, segment.outer_radius, 1.0), (0.0, 0.0, segment.inner_radius, -1.0)]
    for angle in chambers.angles:
        x, y = chambers.offset * math.cos(angle), chambers.offset * math.sin(angle)
        discs.append((x, y, chambers.radius, -1.0))
    nodes, weights = legendre.leggauss(4)
    turns = 2 * np.pi * np.arange(8) / 8
    xs, ys, areas = [], [], []
    for x, y, radius, sign in discs:
        r = radius * np.sqrt((nodes + 1) / 2)
        xs.append((x + np.outer(r, np.cos(turns))).ravel())
        ys.append((y + np.outer(r, np.sin(turns))).ravel())
        share = np.repeat(weights / 2, len(turns)) / len(turns)
        areas.append(sign * math.pi * radius**2 * share)
    return np.concatenate(xs), np.concatenate(ys), np.concatenate(areas)


def _chambers(robot: RobotDescription, channels: ChannelEffects) -> tuple[Array, Array]:
    """Return area (n,) and first moments of area (n, 2) of the channels' chambers."""
    force, first = [], []
    turns = iter(channels.angle)
    for segment in robot.segments:
        chambers = segment.chambers
        hole = math.pi * chambers.radius**2
        for channel in segment.channels:
            angles = np.array([chambers.angles[number - 1] for number in channel]) + next(turns)
            centres = chambers.offset * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            force.append(hole * len(channel))
            first.append(hole * centres.sum(axis=0))
    return np.array(force), np.array(first)


def node_at(robot: RobotDescription, rod: DiscreteRod, at: float) -> tuple[int, float]:
    """Return node and lever (m) of a place on a rod that was made with a station there."""
    segment, place, lever = station_of(robot, at)
    m = int(rod.intervals[segment])
    cuts = np.concatenate(([0.0], np.cumsum(rod.interval[segment, :m]))) / rod.length[segment]
    return int(rod.first_node[segment]) + int(np.abs(cuts - place).argmin()), lever


def draw(robot: RobotDescription, settings: PlantSettings) -> Mismatch:
    """Return the mismatch of the settings, plus a random part from their spread and seed.

    Raises `InputError`: a list does not have one value per channel or per segment.
    """
    given = settings.mismatch
    channels, segments = robot.n_pressures, robot.n_segments
    given.check_lengths(robot)
    if settings.spread is None:
        return given
    spread = settings.spread
    rng = np.random.default_rng([settings.seed, 1])  # the noise of the devices has other streams

    def factors(values: tuple[float, ...], size: int, deviation: float) -> tuple[float, ...]:
        drawn = 1 + deviation * np.clip(rng.standard_normal(size), -3, 3)
        return tuple((np.array(values or (1.0,) * size) * np.maximum(drawn, 0.1)).tolist())

    def added(values: tuple[float, ...], size: int, deviation: float) -> tuple[float, ...]:
        drawn = deviation * np.clip(rng.standard_normal(size), -3, 3)
        return tuple((np.array(values or (0.0,) * size) + drawn).tolist())

    return Mismatch(
        gain=factors(given.gain, channels, spread.gain),
        offset=added(given.offset, channels, spread.offset),
        angle=added(given.angle, channels, spread.angle),
        modulus=factors(given.modulus, segments, spread.modulus),
        length=factors(given.length, segments, spread.length),
        base=_moved(given.base, rng, spread.base_position, spread.base_tilt),
        registration=_moved(
            given.registration, rng, spread.registration_position, spread.registration_angle
        ),
    )


def _moved(given: Placement, rng: np.random.Generator, shift: float, turn: float) -> Placement:
    twist = np.clip(rng.standard_normal(6), -3, 3) * np.repeat([shift, turn], 3)
    return Placement.of(given.transform() @ np.asarray(lie.exp(twist)))
