"""Predict the tip's response to small steps from rest, and its sensitivity to model parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.settings import BELIEF, PROCEDURE
from stiffopt.errors import InputError
from stiffopt.model.actuation import SectionGeometry
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import Memory
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.parameters import Parameter
from stiffopt.model.parametric import ParametricArm
from stiffopt.rig.interface import PressureLimits

Source = tuple[int, ...]
"""Channels (from 0) whose chambers one line fills: one, none, or two that share it."""

_CANTILEVER = 3 / 8  # share of a beam's weight that, at its end, bends it as far as the whole


@dataclass(frozen=True, eq=False)
class ExpectedSteps:
    """Predicted poses of the tip at rest, and after steps of each channel and pair of channels.

    All in the base's axes and in SI. The k uncertain numbers of the arm are, in this order, the
    force on the tip (3), the lengths and the moduli of the segments, and the gains of the channels;
    all but the force as coordinates (see `Parameter`).
    """

    description: RobotDescription  # the robot
    size: float  # of the steps, in Pa
    rest: Array  # pose of the tip (4, 4)
    rest_slope: Array  # twist (6, k) of the tip at rest per number, in the base's axes
    sources: tuple[Source, ...]  # the channels of each of the N steps; the first has none
    # shift, turn: displacement and rotation vector (N, 3) of the tip from rest
    shift: Array
    turn: Array
    # shift_slope, turn_slope: derivatives (N, 3, k) of these by the numbers
    shift_slope: Array
    turn_slope: Array
    # (N, 3, 3), change of the tip's axes; times the sensor's offset on the tip, it is the
    # displacement that this offset adds
    lever: Array
    # lateral force on the tip that bends the arm as far as a tilt of the base by 1 rad
    tilt_force: float
    compliance: float  # displacement of the tip per lateral force
    believed: Array  # prior standard deviations (k,) of the numbers

    @property
    def n(self) -> int:
        """Number of channels."""
        return self.description.n_pressures

    @property
    def farthest(self) -> float:
        """Largest displacement of the tip in a step of one or two channels, in m."""
        return float(np.linalg.norm(self.shift, axis=1).max())

    def row(self, source: Source) -> int:
        """Return the row of the step of these channels."""
        return self.sources.index(source)


def expected_steps(description: RobotDescription, limits: PressureLimits) -> ExpectedSteps:
    """Choose the size of the steps and predict their effect.

    Raises `InputError`: the limits leave no pressure for steps.
    """
    n, segments = description.n_pressures, range(description.n_segments)
    parameters = [
        *(Parameter(f"segments[{s}].length") for s in segments),
        *(Parameter(f"segments[{s}].material.youngs_modulus") for s in segments),
        *(
            Parameter(f"segments[{s}].corrections.gain[{c}]")
            for s in segments
            for c in range(description.segments[s].n_channels)
        ),
    ]
    arm = ParametricArm(description, parameters)
    zero = np.clip(0.0, limits.low, limits.high)
    as_drawn = np.zeros(len(parameters))
    size = _size(arm, as_drawn, zero, limits)
    sources = [(), *((k,) for k in range(n)), *combinations(range(n), 2)]
    acting = size * _acting_share(description)
    pressures = zero + np.array([[acting[k] * (k in each) for k in range(n)] for each in sources])
    found = arm.poses(pressures, as_drawn)
    poses, rotation = found.transforms, found.transforms[:, :3, :3]
    per_number = np.concatenate(
        [rotation @ found.per_coordinate[:, :3], rotation @ found.per_coordinate[:, 3:]], axis=1
    )
    body = Manipulator(description).tip_compliance(zero)
    turned = np.kron(np.eye(2), rotation[0])
    per_force = turned @ body[:, :3] @ rotation[0].T  # (6, 3), base axes
    relative = rotation @ rotation[0].T
    weight, compliance = _tip_weight(description), float(np.trace(per_force[:2, :2])) / 2
    still = np.zeros((len(poses), 3, 3))  # neglects the effect of a force on the steps
    return ExpectedSteps(
        description=description,
        size=size,
        rest=poses[0],
        rest_slope=np.hstack([per_force, per_number[0]]),
        sources=tuple(sources),
        shift=poses[:, :3, 3] - poses[0, :3, 3],
        turn=rotation_vectors(relative),
        shift_slope=np.concatenate([still, (per_number - per_number[0])[:, :3]], axis=2),
        turn_slope=np.concatenate([still, (per_number - per_number[0])[:, 3:]], axis=2),
        lever=rotation - rotation[0],
        tilt_force=weight,
        compliance=compliance,
        believed=np.concatenate(
            [
                np.full(3, BELIEF.base_tilt * weight + BELIEF.sag / compliance),
                _believed(description, parameters),
            ]
        ),
    )


def _size(arm: ParametricArm, as_drawn: Array, zero: Array, limits: PressureLimits) -> float:
    """Return the step, in Pa, at which the most effective channel moves the tip far enough."""
    room = float((limits.high - zero).min())
    largest = PROCEDURE.share * room
    if not largest > 0:
        raise InputError("the limits leave no pressure for a step; raise safety.max_pressure")
    tried = zero + np.vstack([np.zeros_like(zero), largest * np.eye(len(zero))])
    tips = arm.poses(tried, as_drawn).transforms[:, :3, 3]
    farthest = float(np.linalg.norm(tips[1:] - tips[0], axis=1).max())
    return float(min(largest, largest * PROCEDURE.motion / max(farthest, 1e-9)))


def _acting_share(description: RobotDescription) -> Array:
    """Return the share (n,) of a step that is effective at its end, after play and creep."""
    places = [(s, c) for s in description.segments for c in range(s.n_channels)]
    if not any(segment.history for segment, _ in places):
        return np.ones(len(places))
    memory = Memory([segment.history for segment, _ in places], [c for _, c in places])
    time, unit = PROCEDURE.first_hold + PROCEDURE.up, 1e4
    return np.asarray(memory.run(0.1, np.full((round(time / 0.1), len(places)), unit))[-1] / unit)


def _tip_weight(description: RobotDescription) -> float:
    """Return the weight at the tip, in N, that under a tilt moves it as far as the arm's weight."""
    mass = description.tip_mass
    for segment in description.segments:
        density = segment.material.density or 0.0
        mass += _CANTILEVER * density * SectionGeometry.of(segment).area * segment.length
    return mass * float(np.linalg.norm(description.gravity))


def _believed(description: RobotDescription, parameters: Sequence[Parameter]) -> Array:
    """Return prior standard deviations of the parameters; smaller ones after a calibration."""
    usual = {"length": BELIEF.length, "youngs_modulus": BELIEF.modulus, "gain": BELIEF.gain}
    fitted = {} if description.calibration is None else {
        each.key: each.deviation for each in description.calibration.parameters
    }  # fmt: skip
    found = []
    for parameter in parameters:
        general = usual[str(parameter.number.tolerance)]
        found.append(min(general, max(general / 3, fitted.get(parameter.key, general))))
    return np.array(found)


def rotation_vectors(rotations: Array) -> Array:
    """Return rotation vectors (..., 3) of rotations (..., 3, 3) by less than a half turn."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())
