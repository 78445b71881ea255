"""Export an arm under pressure as a model for MuJoCo (MJCF).

Each segment is divided into pieces of equal length h at rest.  In the middle of a piece is a joint
of three slides and three hinges; half of the piece, exp(xi h / 2) as the pressures strain it, lies
on either side.  A wrench strains the section by C_S per length, so the joint has the compliance C_S
h, and its stiffness is the inverse.  MuJoCo has one stiffness per axis.  If axes are coupled, six
fixed tendons along the eigenvectors of the stiffness store the same energy.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError
from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.segment import Segment
from stiffopt.model.shooting import mass_per_length

PIECES = 12
"""Joints per segment."""
DAMPING = 0.05
"""Share of critical damping of the slowest vibration."""

_LONGEST_STEP = 2e-3  # of time, in s
_COUPLED = 1e-6  # of the geometric mean of two stiffnesses; smaller couplings are rounding errors
_SILICONE = 1070.0  # kg/m^3, for robots without densities: bodies in MuJoCo need masses
_TIP_RADIUS = 2e-3  # of the site, and of the ball for the tip's mass, in m


class _Part(NamedTuple):
    """A straight piece of a link: its ends and centroid in the link's axes, (3,) each."""

    start: Array
    end: Array
    centroid: Array
    radius: float
    mass: float


@dataclass
class _Link:
    """A rigid body and the joint that connects it to the link before."""

    name: str
    placed: Array  # pose (4, 4) of the joint in the axes of the link before
    stiffness: Array | None  # (6, 6) of the joint, linear first; None: it is fixed
    parts: list[_Part] = field(default_factory=list)  # its pieces, from the joint on


def mjcf(
    robot: Manipulator, pressures: ArrayLike, *, pieces: int = PIECES, damping: float = DAMPING
) -> str:
    """Return a robot under pressure as the text of an MJCF file.

    The joints rest where the free arm is; MuJoCo computes the sag under gravity.  Wrenches
    at the tip from `Manipulator.with_load` are not exported.  The site ``tip`` has the tip's pose.

    Parameters
    ----------
    robot : Manipulator
        Its densities give the masses; a segment without one counts as silicone.
    pressures : (n,)
        In Pa.  Shape and stiffness are those at these pressures: for others, export again.
    pieces : int
        Joints per segment.  The error falls with the square of their number.
    damping : float
        Share of critical damping of the slowest vibration.  Dampers are proportional to the
        springs.

    Raises
    ------
    PressureError
        The pressures are not (n,), or the strain law does not hold there.
    InputError
        `pieces` or `damping` is out of range.
    """
    if not 2 <= pieces <= 100:
        raise InputError(f"an arm needs 2 to 100 pieces per segment, not {pieces}")
    if not 0 < damping <= 10:
        raise InputError(
            f"damping is a share of the critical one, above 0 and at most 10: {damping:g}"
        )
    p = robot.checked_pressures(pressures)
    links, tip = _links(robot, p, pieces)
    delay = 2 * damping / _slowest_swing(robot, p, pieces)  # damping over stiffness, in s
    return _document(robot, links, tip, delay)


def _links(robot: Manipulator, p: Array, pieces: int) -> tuple[list[_Link], Array]:
    """Return the links from the base to the tip, and the tip's pose in the last one."""
    sections = [np.array(part) for part in robot._section_parts(p)]
    strains, compliances = sections[: robot.n_segments], sections[robot.n_segments :]
    links, here = [_Link("base", np.eye(4), None)], np.eye(4)

    def go(step: Array, segment: Segment, mass: float = 0.0) -> None:
        nonlocal here
        there = here @ step
        off_axis = here[:3, :3] @ [*SectionGeometry.of(segment).centroid, 0.0]
        centroid = (here + there)[:3, 3] / 2 + off_axis
        part = _Part(here[:3, 3], there[:3, 3], centroid, segment.outer_radius, mass)
        links[-1].parts.append(part)
        here = there

    for index, segment in enumerate(robot.description.segments):
        h = segment.length / pieces
        half = lie.exp(strains[index].ravel() * h / 2)
        stiffness = np.linalg.inv(compliances[index] * h)
        for piece in range(pieces):
            go(half, segment, _mass_per_length(segment) * h / 2)
            name = f"segment{index + 1}_{piece + 1}"
            links.append(_Link(name, here, (stiffness + stiffness.T) / 2))
            here = np.eye(4)
            go(half, segment, _mass_per_length(segment) * h / 2)
        if segment.connector:
            along = np.eye(4)
            along[2, 3] = segment.connector
            go(along, segment)
    return links, here


def _mass_per_length(segment: Segment) -> float:
    return mass_per_length(segment) or _SILICONE * float(SectionGeometry.of(segment).area)


def _slowest_swing(robot: Manipulator, p: Array, pieces: int) -> float:
    """Return the lowest natural frequency, in rad/s, of point masses on the arm's compliance."""
    at, masses, start = [], [], 0.0
    for segment in robot.description.segments:
        h = segment.length / pieces
        at += [start + h * (piece + 0.5) for piece in range(pieces)]
        masses += pieces * [_mass_per_length(segment) * h]
        start += segment.length + segment.connector
    at, masses = [*at, robot.length], [*masses, robot.description.tip_mass]
    n, root = len(at), np.sqrt(masses)
    compliance = robot.compliance_between(p, np.repeat(at, n), np.tile(at, n))[:, :3, :3]
    weighted = np.outer(root, root)[:, None, :, None] * compliance.reshape(n, n, 3, 3).swapaxes(
        1, 2
    )
    return float(np.linalg.eigvalsh(weighted.reshape(3 * n, 3 * n))[-1] ** -0.5)


def _document(robot: Manipulator, links: list[_Link], tip: Array, delay: float) -> str:
    root = ET.Element("mujoco", model=robot.description.name)
    _add(root, "compiler", angle="radian")
    step = min(_LONGEST_STEP, delay)  # with a longer one the fast vibrations might grow
    _add(
        root, "option", gravity=robot.description.gravity, integrator="implicitfast", timestep=step
    )
    # the arm touches what the world has, but not itself
    _add(_add(root, "default"), "geom", contype="2", conaffinity="1", rgba="0.9 0.8 0.7 1")
    body, tendons = _add(root, "worldbody"), ET.Element("tendon")
    order = range(6)
    for link in links:
        body = _add(body, "body", name=link.name, **_pose(link.placed))
        if link.stiffness is not None:
            _add_joint(body, tendons, link.name, link.stiffness, delay, order)
            order = order[::-1]  # rotations do not commute; the error cancels over two joints
        _add_parts(body, link)
    _add(body, "site", name="tip", size=_TIP_RADIUS, **_pose(tip))
    if mass := robot.description.tip_mass:
        ball = _add(body, "body", name="tip_mass", pos=tip[:3, 3])
        inertia = np.full(3, 0.4 * mass * _TIP_RADIUS**2)
        _add(ball, "inertial", pos=np.zeros(3), mass=mass, diaginertia=inertia)
    if len(tendons):
        root.append(tendons)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_joint(
    body: ET.Element,
    tendons: ET.Element,
    name: str,
    stiffness: Array,
    delay: float,
    order: Sequence[int],
) -> None:
    """Add the six axes of a joint, with springs, or with tendons if they are coupled."""
    scale = np.sqrt(np.diag(stiffness))
    between = np.abs(stiffness - np.diag(np.diag(stiffness))) / np.outer(scale, scale)
    coupled = bool((between > _COUPLED).any())
    axes = [f"{name}_{kind}_{axis}" for kind in ("slide", "hinge") for axis in "xyz"]
    for k in order:
        own = {} if coupled else _spring(stiffness[k, k], delay)
        kind = axes[k].split("_")[-2]
        _add(body, "joint", name=axes[k], type=kind, axis=np.eye(3)[k % 3], **own)
    if coupled:
        for k, (value, vector) in enumerate(_eigenvectors(stiffness, scale)):
            tendon = _add(tendons, "fixed", name=f"{name}_{k + 1}", **_spring(value, delay))
            for joint, share in zip(axes, vector, strict=True):
                if share:
                    _add(tendon, "joint", joint=joint, coef=share)


def _eigenvectors(K: Array, scale: Array) -> Iterator[tuple[float, Array]]:
    """Yield stiffnesses k and vectors c with K = sum k c c', with axes in units of their scale."""
    values, vectors = np.linalg.eigh(K / np.outer(scale, scale))
    for value, vector in zip(values, vectors.T, strict=True):
        column = scale * vector
        size = float(np.abs(column).max())
        column = column / size
        yield float(value) * size**2, np.where(np.abs(column) < 1e-12, 0.0, column)


def _spring(stiffness: float, delay: float) -> dict[str, float]:
    return {"stiffness": stiffness, "damping": stiffness * delay}


def _add_parts(body: ET.Element, link: _Link) -> None:
    """Add the shapes of a link for display and contact, and its mass, as that of a cylinder."""
    masses = np.array([part.mass for part in link.parts])
    mass, radius = masses.sum(), link.parts[0].radius
    length = sum(float(np.linalg.norm(part.end - part.start)) for part in link.parts)
    centre = masses @ np.array([part.centroid for part in link.parts]) / mass
    across, along = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    _add(body, "inertial", pos=centre, mass=mass, diaginertia=[across, across, along])
    for part in link.parts:
        _add(body, "geom", type="capsule", fromto=[*part.start, *part.end], size=part.radius)


def _add(parent: ET.Element, tag: str, **values: Any) -> ET.Element:
    """Add an element; numbers and arrays become text."""
    texts = {
        key: value if isinstance(value, str) else " ".join(f"{v:.10g}" for v in np.ravel(value))
        for key, value in values.items()
    }
    return ET.SubElement(parent, tag, texts)


def _pose(T: Array) -> dict[str, Array]:
    return {"pos": T[:3, 3], "quat": lie.quaternion_from_rotation(T[:3, :3])}
