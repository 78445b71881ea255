"""The silicone: stress in the fibres of a section, with viscosity, creep and hysteresis.

A section consists of fibres along the arm with strains ``v_z + u_x y - u_y x``. Each fibre has a
hyperelastic spring and, in parallel to it, a dashpot (Kelvin-Voigt), springs in series with a
dashpot (Maxwell: creep), and springs in series with a slider (Jenkin: hysteresis). Shear and twist
are linear and have only the dashpot. Stresses and strains are nominal: per area and length at rest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from stiffopt.plant.jit import jit
from stiffopt.plant.rod import DiscreteRod, strain_at

Array = Any

LINEAR, YEOH = 0, 1
_SOFTEST = 0.05  # lower bound of the modulus under pressure, as a share of that at rest
_THINNEST = 0.1  # stretch below which the hyperelastic law is continued by its tangent


class SectionMaterial(NamedTuple):
    """The sections and their material, constant in time. S segments, f fibres, n channels."""

    law: int  # `LINEAR` or `YEOH` (neo-Hookean with no stiffening)
    stiffening: float  # C2 / C1 of the Yeoh law
    viscosity: float  # of the dashpot, over the modulus, s
    # creep_share, creep_time: of the Maxwell branches (c,)
    creep_share: Array
    creep_time: Array
    # slip_share, slip_strain: of the Jenkin elements (j,)
    slip_share: Array
    slip_strain: Array
    # modulus, modulus_slope: of the segments (S,): E at rest in Pa, and its change per norm of the
    # segment's pressures
    modulus: Array
    modulus_slope: Array
    # actuation, actuation_slope: of the segments (S,): factor on the effect of pressure at rest,
    # and the slope of the modulus that free shapes show, instead of `modulus_slope`
    actuation: Array
    actuation_slope: Array
    # shear, torsion: G A / E and G J / E of the segments (S,)
    shear: Array
    torsion: Array
    centroid: Array  # of the sections (S, 2), m
    # fibre_x, fibre_y, fibre_area: of the fibres (S, f), m and m^2
    fibre_x: Array
    fibre_y: Array
    fibre_area: Array
    first_channel: Array  # of the segments (S + 1,)
    # channel_force, channel_x, channel_y: of the channels (n,): area, and first moments of area
    channel_force: Array
    channel_x: Array
    channel_y: Array


class FibreMemory(NamedTuple):
    """History variables of the fibres. S segments, g Gauss points, f fibres."""

    strain: Array  # of the fibres (S, g, f)
    creep: Array  # strain of the Maxwell branches' dashpots (S, g, c, f)
    slip: Array  # strain of the Jenkin elements' springs (S, g, j, f)


class Scheme(NamedTuple):
    """Time discretisation of one step."""

    step: float  # s
    # weight of the step's end in the strain for elastic stresses: 1/2 is the midpoint rule, which
    # loses no energy; 1 is backward Euler, which does not oscillate
    share: float
    # whether there are creep and hysteresis; without them the stresses are those in the long run
    history: bool


@jit
def stress(material: SectionMaterial, strain: float) -> float:
    """Return the hyperelastic stress over Young's modulus."""
    if material.law == LINEAR:
        return strain
    stretch = max(1 + strain, _THINNEST)
    inverse = 1 / stretch
    surplus = stretch * stretch + 2 * inverse - 3
    value = (stretch - inverse * inverse) * (1 + 2 * material.stiffening * surplus) / 3
    if 1 + strain < _THINNEST:
        value += (1 + strain - _THINNEST) * 2 * inverse**3
    return value


@jit
def energy(material: SectionMaterial, strain: float) -> float:
    """Return the hyperelastic energy over Young's modulus."""
    if material.law == LINEAR:
        return 0.5 * strain * strain
    stretch = max(1 + strain, _THINNEST)
    surplus = stretch * stretch + 2 / stretch - 3
    return surplus * (1 + material.stiffening * surplus) / 6


@jit
def pressed_modulus(
    material: SectionMaterial, segment: int, pressures: Array
) -> tuple[float, float]:
    """Return Young's modulus under pressures (n,) over that at rest, and the effect per pressure.

    The effect is such that the arm's free shapes are those of a modulus with the slope
    `SectionMaterial.actuation_slope`, unaffected by `SectionMaterial.actuation`.
    """
    total = 0.0
    for channel in range(material.first_channel[segment], material.first_channel[segment + 1]):
        total += pressures[channel] * pressures[channel]
    norm = total**0.5
    modulus = material.modulus[segment]
    pressed = max((modulus + material.modulus_slope[segment] * norm) / modulus, _SOFTEST)
    free = max((modulus + material.actuation_slope[segment] * norm) / modulus, _SOFTEST)
    return pressed, material.actuation[segment] * pressed / free


@jit
def creep_coefficients(material: SectionMaterial, scheme: Scheme, out: Array) -> None:
    """Set the coefficients (c, 2) of the Maxwell branches.

    A branch's dashpot ends the step at ``out[0] creep + out[1] mean``. This is the theta method;
    `mean` is the fibre's strain at theta between the ends of the step.
    """
    for k in range(len(material.creep_time)):
        rate = scheme.step / material.creep_time[k]
        divisor = 1 + scheme.share * rate
        out[k, 0] = (1 - (1 - scheme.share) * rate) / divisor
        out[k, 1] = rate / divisor
        if not scheme.history:
            out[k, 0], out[k, 1] = 0.0, 1.0


@jit
def slip_after(limit: float, spring: float, change: float) -> float:
    """Return the strain of a Jenkin element's spring after a change of the fibre's strain."""
    return min(max(spring + change, -limit), limit)


@jit
def internal_forces(
    rod: DiscreteRod,
    material: SectionMaterial,
    scheme: Scheme,
    memory: FibreMemory,
    pressures: Array,
    before: Array,
    after: Array,
    out: Array,
) -> None:
    """Set the generalised forces (n,) of stresses minus pressures during a step."""
    out[:] = 0.0
    e0 = np.empty(6)
    e1 = np.empty(6)
    force = np.empty(6)
    share = scheme.share
    rest = 1 - share
    history = scheme.history
    viscous = material.viscosity / scheme.step
    branches, sliders = len(material.creep_share), len(material.slip_share)
    fibres = material.fibre_x.shape[1]
    ends, stresses, pull = np.empty(fibres), np.empty(fibres), np.empty(branches)
    dashpot = np.empty((branches, 2))
    creep_coefficients(material, scheme, dashpot)
    stiff = 0.0  # stress of the Maxwell branches per mean strain
    for k in range(branches):
        stiff += material.creep_share[k] * (1 - share * dashpot[k, 1]) if history else 0.0
        pull[k] = material.creep_share[k] * (share * dashpot[k, 0] + rest)
    for s in range(len(rod.length)):
        pressed, acting = pressed_modulus(material, s, pressures)
        E = material.modulus[s]
        cx, cy = material.centroid[s, 0], material.centroid[s, 1]
        push, push_x, push_y = 0.0, 0.0, 0.0
        for c in range(material.first_channel[s], material.first_channel[s + 1]):
            push += acting * pressures[c] * material.channel_force[c]
            push_x += acting * pressures[c] * material.channel_x[c]
            push_y += acting * pressures[c] * material.channel_y[c]
        for g in range(len(rod.weight)):
            strain_at(rod, s, rod.basis[g], before, e0)
            strain_at(rod, s, rod.basis[g], after, e1)
            for i in range(6):  # the linear part: shear at the centroid, and twist
                force[i] = pressed * (share * e1[i] + rest * e0[i])
                force[i] += viscous * (e1[i] - e0[i])
            shear = material.shear[s] * E
            nx = shear * (force[0] - force[5] * cy)
            ny = shear * (force[1] + force[5] * cx)
            mz = material.torsion[s] * E * force[5] - nx * cy + ny * cx
            strain, creep, slip = memory.strain[s, g], memory.creep[s, g], memory.slip[s, g]
            for f in range(fibres):
                ends[f] = e1[2] + e1[3] * material.fibre_y[s, f] - e1[4] * material.fibre_x[s, f]
                mean = share * ends[f] + rest * strain[f]
                stresses[f] = stiff * mean + viscous * (ends[f] - strain[f])
                stresses[f] += pressed * stress(material, mean)
            if history:
                for k in range(branches):
                    for f in range(fibres):
                        stresses[f] -= pull[k] * creep[k, f]
                for k in range(sliders):
                    stiffness, limit = material.slip_share[k], material.slip_strain[k]
                    for f in range(fibres):
                        new = slip_after(limit, slip[k, f], ends[f] - strain[f])
                        stresses[f] += stiffness * (share * new + rest * slip[k, f])
            nz, mx, my = 0.0, 0.0, 0.0
            for f in range(fibres):
                n = material.fibre_area[s, f] * stresses[f]
                nz += n
                mx += n * material.fibre_y[s, f]
                my -= n * material.fibre_x[s, f]
            force[0], force[1], force[2] = nx, ny, E * nz - push
            force[3], force[4], force[5] = E * mx - push_y, E * my + push_x, mz
            weight = rod.weight[g] * rod.length[s]
            for c in range(6):
                first = s * rod.per_segment + rod.first[c]
                for k in range(rod.count[c]):
                    out[first + k] += weight * rod.basis[g, k] * force[c]


@jit
def remember(
    rod: DiscreteRod,
    material: SectionMaterial,
    scheme: Scheme,
    memory: FibreMemory,
    pressures: Array,
    before: Array,
    after: Array,
) -> tuple[float, float]:
    """Update the memory by a step; return the energy dissipated and the pressures' work."""
    e0 = np.empty(6)
    e1 = np.empty(6)
    share = scheme.share
    ends = np.empty((len(material.creep_share), 2))
    creep_coefficients(material, scheme, ends)
    lost, work = 0.0, 0.0
    for s in range(len(rod.length)):
        E = material.modulus[s]
        _, acting = pressed_modulus(material, s, pressures)
        cx, cy = material.centroid[s, 0], material.centroid[s, 1]
        for g in range(len(rod.weight)):
            weight = rod.weight[g] * rod.length[s]
            strain_at(rod, s, rod.basis[g], before, e0)
            strain_at(rod, s, rod.basis[g], after, e1)
            for i in range(6):
                e0[i] = e1[i] - e0[i]
            for c in range(material.first_channel[s], material.first_channel[s + 1]):
                swept = e0[2] * material.channel_force[c]
                swept += e0[3] * material.channel_y[c] - e0[4] * material.channel_x[c]
                work += weight * acting * pressures[c] * swept
            gx, gy = e0[0] - e0[5] * cy, e0[1] + e0[5] * cx
            sheared = material.shear[s] * (gx * gx + gy * gy) + material.torsion[s] * e0[5] ** 2
            lost += weight * E * material.viscosity / scheme.step * sheared
            for f in range(material.fibre_x.shape[1]):
                x, y = material.fibre_x[s, f], material.fibre_y[s, f]
                end = e1[2] + e1[3] * y - e1[4] * x
                begin = memory.strain[s, g, f]
                change = end - begin
                per_area = material.viscosity * change * change / scheme.step
                memory.strain[s, g, f] = end
                for k in range(len(material.creep_share)):
                    old = memory.creep[s, g, k, f]
                    inside = share * end + (1 - share) * begin
                    new = ends[k, 0] * old + ends[k, 1] * inside
                    mean = share * (end - new) + (1 - share) * (begin - old)
                    per_area += material.creep_share[k] * mean * (new - old)
                    memory.creep[s, g, k, f] = new
                for k in range(len(material.slip_share)):
                    old = memory.slip[s, g, k, f]
                    new = slip_after(material.slip_strain[k], old, change)
                    new = new if scheme.history else 0.0
                    mean = share * new + (1 - share) * old
                    per_area += material.slip_share[k] * mean * (change - (new - old))
                    memory.slip[s, g, k, f] = new
                lost += weight * E * material.fibre_area[s, f] * per_area
    return lost, work


@jit
def stored(
    rod: DiscreteRod, material: SectionMaterial, memory: FibreMemory, pressures: Array, q: Array
) -> float:
    """Return the elastic energy of the segments, including creep and hysteresis, in J."""
    e = np.empty(6)
    total = 0.0
    for s in range(len(rod.length)):
        pressed, _ = pressed_modulus(material, s, pressures)
        cx, cy = material.centroid[s, 0], material.centroid[s, 1]
        for g in range(len(rod.weight)):
            strain_at(rod, s, rod.basis[g], q, e)
            gx, gy = e[0] - e[5] * cy, e[1] + e[5] * cx
            per_length = material.shear[s] * (gx * gx + gy * gy) + material.torsion[s] * e[5] ** 2
            per_length *= 0.5 * pressed
            for f in range(material.fibre_x.shape[1]):
                strain = e[2] + e[3] * material.fibre_y[s, f] - e[4] * material.fibre_x[s, f]
                per_area = pressed * energy(material, strain)
                for k in range(len(material.creep_share)):
                    spring = memory.strain[s, g, f] - memory.creep[s, g, k, f]
                    per_area += 0.5 * material.creep_share[k] * spring * spring
                for k in range(len(material.slip_share)):
                    spring = memory.slip[s, g, k, f]
                    per_area += 0.5 * material.slip_share[k] * spring * spring
                per_length += material.fibre_area[s, f] * per_area
            total += rod.weight[g] * rod.length[s] * material.modulus[s] * per_length
    return total
