"""pink with pinocchio and a QP solver: reaching a position with an equivalent rigid chain.

The tip of a constant-curvature segment that bends by theta towards phi, with a chord d between
its ends, has the pose

    Rz(phi) Ry(theta/2) Tz(d) Ry(theta/2) Rz(-phi),

exactly. So a segment is five joints of which two are mimics (the second bend equals the first,
the last turn undoes the first), with three coordinates (phi, theta/2, d) that stand one to one
for its three strains: arc length ``d (theta/2) / sin(theta/2)``, curvature ``theta`` over it.
Joint limits bound theta/2 and d by what the pressure range allows at most; they cannot say
which combinations the chambers can give, so the chain solves a somewhat easier problem.
`pressures` inverts the strain law; where it fails, the chain found a configuration that the arm
cannot take. The straight arm is a singularity of phi, so each segment starts slightly bent, at
mid-extension.
"""

from typing import Any, ClassVar

import numpy as np

from peers import paper
from peers.base import Peer, Vector

TOLERANCE = 1e-4  # m
_MOST_STEPS = 200
_COORDINATES = 3  # per segment: phi, half of theta, chord


class Pink(Peer):
    """One start, full steps of the differential inverse kinematics until within 0.1 mm."""

    name: ClassVar[str] = "pink (pinocchio, DAQP)"
    distributions: ClassVar[tuple[str, ...]] = ("pin-pink", "pin", "daqp")

    def __init__(self, segments: int) -> None:
        super().__init__(segments)
        import pink
        import pinocchio

        self._pink, self._pin = pink, pinocchio
        self._model = _chain(pinocchio, segments)
        self._data = self._model.createData()
        self._task = pink.tasks.FrameTask(
            "tip", position_cost=1.0, orientation_cost=0.0, lm_damping=1e-6
        )
        self._start = np.tile([0.3, 0.2, 1.15 * paper.LENGTH], segments)

    def reach(self, position: Vector) -> tuple[bool, Vector]:
        """Whether the position was reached within 0.1 mm, and the chain's coordinates.

        `pink.solve_ik` is iterated with a time step of 1 s, so that each step is a full one.
        """
        pink = self._pink
        configuration = pink.Configuration(self._model, self._data, self._start)
        self._task.set_target(self._pin.SE3(np.eye(3), position))
        for _ in range(_MOST_STEPS):
            tip = configuration.get_transform_frame_to_world("tip").translation
            if np.linalg.norm(tip - position) <= TOLERANCE:
                return True, configuration.q.copy()
            velocity = pink.solve_ik(
                configuration, [self._task], 1.0, solver="daqp", damping=1e-9, safety_break=False
            )
            configuration.integrate_inplace(velocity, 1.0)
        return False, configuration.q.copy()

    def pressures(self, coordinates: Vector) -> Vector | None:
        """Pressures (n,) in Pa for the coordinates, or None: eqs 8 to 10 inverted by segment."""
        found = []
        for phi, half, chord in coordinates.reshape(-1, _COORDINATES):
            length = chord / np.sinc(half / np.pi)
            towards = 2 * half / length * np.array([-np.sin(phi), np.cos(phi)])
            loads = np.append(towards * paper.INERTIA, (length / paper.LENGTH - 1) * paper.AREA)
            per_modulus = np.linalg.solve(np.vstack([paper.MOMENT, paper.FORCE]), loads)
            norm = np.linalg.norm(per_modulus)
            p = per_modulus * paper.E0 / (1 + paper.SLOPE * paper.BAR * norm)
            if (p < -1e-9).any() or (p > paper.PRESSURE_MAX + 1e-9).any():
                return None
            found.append(p * paper.BAR)
        return np.concatenate(found)


def _chain(pin: Any, segments: int) -> Any:
    """Model of the chain; limits from the extremes of the strain law."""
    extremes = [_strain(np.array(p)) for p in ((1.5, 0, 0), (1.5, 1.5, 0), (1.5, 1.5, 1.5))]
    most_bend = max(theta for theta, _ in extremes) / 2
    longest = max(length for _, length in extremes)
    shortest = paper.LENGTH * np.sinc(most_bend / np.pi)
    model = pin.Model()
    parent, mimics = 0, []
    for i in range(segments):
        for joint, name, low, high in (
            (pin.JointModelRZ(), "turn", -1e3, 1e3),
            (pin.JointModelRY(), "bend", -most_bend, most_bend),
            (pin.JointModelPZ(), "chord", shortest, longest),
            (pin.JointModelRY(), "bend again", -1e3, 1e3),
            (pin.JointModelRZ(), "turn back", -1e3, 1e3),
        ):
            parent = model.addJoint(
                parent, joint, pin.SE3.Identity(), f"{name} {i}",
                np.array([1e3]), np.array([1e3]), np.array([low]), np.array([high]),
            )  # fmt: skip
        mimics += [(f"bend {i}", f"bend again {i}", 1.0), (f"turn {i}", f"turn back {i}", -1.0)]
    tip = pin.Frame("tip", parent, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
    model.addFrame(tip)
    for first, second, ratio in mimics:
        model = pin.transformJointIntoMimic(
            model, model.getJointId(first), model.getJointId(second), ratio, 0.0
        )
    return model


def _strain(p: Vector) -> tuple[float, float]:
    """Bending angle and length of a segment at pressures (3,) in bar."""
    E = paper.E0 - paper.SLOPE * paper.BAR * float(np.linalg.norm(p))
    length = paper.LENGTH * (1 + float(paper.FORCE @ p) / (E * paper.AREA))
    return float(np.linalg.norm(paper.MOMENT @ p)) / (E * paper.INERTIA) * length, length
