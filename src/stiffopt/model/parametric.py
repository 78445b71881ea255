"""`ParametricArm`: poses and stiffnesses of an arm, with derivatives by its parameters."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.arguments import DirectionalMeasure
from stiffopt.model.batch import InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.description import RobotDescription
from stiffopt.model.equilibrium import Equilibrium, EquilibriumState, Loads
from stiffopt.model.kinematics import body_jacobian
from stiffopt.model.parameters import Parameter, parametric
from stiffopt.model.shape import FreeShape, Shape, stiffness_along
from stiffopt.model.shooting import Chain, Shooting


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a point of the arm and their derivatives, as body twists, linear part first.

    Attributes
    ----------
    transforms : (N, 4, 4), in the base frame.
    per_pressure : twists (N, 6, n) per Pa.
    per_coordinate : twists (N, 6, k) per unit of a parameter's coordinate.
    per_gravity : twists (N, 6, 3) per m/s^2, in base axes; zero for an arm without load.
    """

    transforms: Array
    per_pressure: Array
    per_coordinate: Array
    per_gravity: Array


class ParametricArm:
    """A robot with variable parameters.

    Parameters
    ----------
    description : the robot at coordinate zero of all parameters.
    parameters : k variable parameters; those of histories have no effect here.
    tip_load : dead and follower wrench (12,) on the tip, see `stiffopt.model.equilibrium.Loads`.
    """

    def __init__(
        self,
        description: RobotDescription,
        parameters: Sequence[Parameter],
        tip_load: Sequence[float] = (0.0,) * 12,
    ) -> None:
        self.description = description
        actuation, coordinates = parametric(description, parameters)
        # append the parameters to the pressures: derivatives are taken by both
        variables = ca.vertcat(actuation.pressures, coordinates)
        self._actuation = replace(actuation, pressures=variables)
        self._functions: dict[Hashable, InterpretedFunction] = {}
        self._near: dict[int, list[EquilibriumState]] = {}
        self._loads = Loads(np.array(description.gravity), np.array(tip_load), np.zeros(12))
        self._equilibrium: Equilibrium | None = None
        if any(description.gravity) or any(tip_load):
            self._equilibrium = Equilibrium(Shooting(description, self._actuation))

    def set_tip_load(self, tip_load: Sequence[float]) -> None:
        """Replace the load (12,) on the tip; the arm must have gravity or a load already."""
        self._loads = self._loads._replace(tip=np.array(tip_load))

    def set_gravity(self, gravity: Array) -> None:
        """Replace gravity (3,), in base axes, in m/s^2; the arm must have some already."""
        self._loads = self._loads._replace(gravity=gravity)

    def poses(self, pressures: Array, coordinates: Array, at: float | None = None) -> Poses:
        """Return poses at pressures (N, n), coordinates (k,), of the tip or at an arc length in m.

        Raises `EquilibriumError`: a loaded arm buckles or falls over.
        """

        def outputs(shape: Shape) -> list[ca.SX | ca.MX]:
            if isinstance(shape, Chain):
                return [shape.transform, shape.jacobian, shape.per_gravity]
            twists = body_jacobian(shape.transform, shape.pressures)
            return [shape.transform, twists, ca.SX(6, 3)]

        found = self._evaluate("pose", outputs, pressures, coordinates, at)
        transforms, twists, per_gravity = found
        n = self.description.n_pressures
        return Poses(transforms, twists[..., :n], twists[..., n:], per_gravity)

    def stiffnesses(
        self, pressures: Array, coordinates: Array, measure: DirectionalMeasure
    ) -> tuple[Array, Array, Array, Array]:
        """Return tip stiffness (N,) and its slopes.

        They are (N, n) by pressures, (N, k) by coordinates and (N, 3) by gravity.
        """
        direction, kind, boundary, frame = measure

        def outputs(shape: Shape) -> list[ca.SX | ca.MX]:
            k = stiffness_along(shape, ca.DM(direction), frame, kind, boundary)
            by_gravity = shape.gravity_jacobian(k) if isinstance(shape, Chain) else ca.SX(1, 3)
            return [k, shape.total_jacobian(k), by_gravity]

        key = ("stiffness", measure)
        found = self._evaluate(key, outputs, pressures, coordinates, None)
        values, gradient, by_gravity = (each[:, 0] for each in found)
        n = self.description.n_pressures
        return values[:, 0], gradient[:, :n], gradient[:, n:], by_gravity

    def _evaluate(
        self,
        key: Hashable,
        outputs: Callable[[Shape], list[ca.SX | ca.MX]],
        pressures: Array,
        coordinates: Array,
        at: float | None,
    ) -> list[Array]:
        if (key, at) not in self._functions:
            shape = self._shape(at)
            found = [ca.densify(value) for value in outputs(shape)]
            if isinstance(shape, FreeShape):
                found = ca.cse(found)
            function = ca.Function("parametric", list(shape.inputs), found)
            if isinstance(shape, Chain):
                function = function.expand()  # evaluated in half the time
            self._functions[key, at] = InterpretedFunction(dense(function))
        evaluate = self._functions[key, at]
        repeated = np.broadcast_to(coordinates, (len(pressures), len(coordinates)))
        variables = np.hstack([pressures, repeated])
        if self._equilibrium is None:
            return evaluate.many(variables)
        arguments = map(self._equilibrium.arguments, self._states(self._equilibrium, variables))
        rows = [evaluate(*each) for each in arguments]
        return [np.array(column) for column in zip(*rows, strict=True)]

    def _shape(self, at: float | None) -> Shape:
        if self._equilibrium is not None:
            return self._equilibrium.shooting.chain(at)
        return FreeShape.of(self.description, self._actuation, at)

    def _states(self, equilibrium: Equilibrium, variables: Array) -> list[EquilibriumState]:
        """Return equilibria (N,), each found from a known one whose pressures are near.

        That is the last one of the same row, or that of the row before.
        """
        n = self.description.n_pressures
        near = self._near.get(len(variables), [])
        states: list[EquilibriumState] = []
        for row, own in enumerate(variables):
            known = [*near[row : row + 1], *states[-1:]]
            state = None
            if known:
                far = [np.abs(each.pressures[:n] - own[:n]).sum() for each in known]
                start = known[int(np.argmin(far))]
                end = start._replace(pressures=own, loads=self._loads)
                path = equilibrium.follow(start, end, shortest=0.1, stable=False)
                state = path.state if path.share == 1.0 else None
            states.append(state or equilibrium.settle(own, self._loads))
        self._near[len(variables)] = states
        return states
