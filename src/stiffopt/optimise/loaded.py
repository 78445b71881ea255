"""Terms and measures of an arm under gravity or loads, as functions of its tip.

The compiled solver finds the tip by the integrator in C, see `stiffopt.model.loaded_arm`.
"""

import casadi as ca

from stiffopt import lie
from stiffopt.model.codegen import function_of
from stiffopt.model.layout import Layout, symbolic_arm
from stiffopt.model.shape import PointOfArm
from stiffopt.optimise.program import Program


class Tip:
    """A tip as independent symbols; implements `Shape`."""

    def __init__(self, n_pressures: int) -> None:
        self.position = ca.SX.sym("r", 3)
        self.rotation = ca.SX.sym("R", 3, 3)
        self.base_compliance = ca.SX.sym("C", 6, 6)
        self.pressures = ca.SX.sym("p", n_pressures)

    @property
    def inputs(self) -> tuple[ca.SX, ...]:
        """Position, rotation, compliance (6, 6) in base axes, pressures."""
        return self.position, self.rotation, self.base_compliance, self.pressures

    @property
    def transform(self) -> ca.SX:
        """Pose (4, 4)."""
        return lie.transform(self.rotation, self.position)

    @property
    def jacobian(self) -> ca.SX:
        """Not available: the tip's symbols do not depend on the pressures."""
        raise NotImplementedError

    @property
    def compliance(self) -> ca.SX:
        """Compliance (6, 6) in the tip's axes."""
        X = ca.diagcat(self.rotation, self.rotation)
        return X.T @ self.base_compliance @ X

    def station(self, at: float) -> PointOfArm:
        """Not available: only the tip is known."""
        raise NotImplementedError

    def flexibility(self, wrench: ca.SX) -> ca.SX:
        """Return ``w' C w`` of a wrench (6,) in the tip's axes."""
        moved = ca.vertcat(self.rotation @ wrench[:3], self.rotation @ wrench[3:])
        return moved.T @ self.base_compliance @ moved

    def total_jacobian(self, values: ca.SX) -> ca.SX:
        """Return zeros (k, n): the tip's symbols do not depend on the pressures."""
        return ca.SX.zeros(values.numel(), self.pressures.numel())

    def by_twist(self, values: ca.SX) -> ca.SX:
        """Return the derivative (k, 6) of values by a twist of the tip in its own axes."""
        by_turn = [
            ca.jtimes(values, ca.vec(self.rotation), ca.vec(self.rotation @ lie.hat(axis)))
            for axis in ca.DM.eye(3).full()
        ]
        return ca.horzcat(ca.jacobian(values, self.position) @ self.rotation, *by_turn)


def tip_functions(program: Program, layout: Layout) -> list[ca.Function]:
    """Return functions of a tip (see `Tip`) and parameters: the arm's, then the program's.

    ``residuals``: values (m,) and derivative by a twist (m, 6); ``terms``: terms and floors
    (k,), derivatives by a twist (k, 6), by the compliance (k, 36) and by pressures (k, n);
    ``judge``: as `Program.judge`.
    """
    arm = symbolic_arm(layout)
    tip = Tip(arm.tip.pressures.numel())
    parameters = ca.SX.sym("parameters", program.n_parameters)
    inputs = [*tip.inputs, ca.vertcat(arm.numbers, parameters)]
    residuals, _, terms, _, floors, _ = program.point(tip, parameters)
    terms = ca.vertcat(*terms.elements(), *(floors.elements() if program.n_floors else ()))

    return [
        function_of("residuals", inputs, [residuals, tip.by_twist(residuals)]),
        function_of(
            "terms",
            inputs,
            [
                terms, tip.by_twist(terms),
                ca.jacobian(terms, ca.vec(tip.base_compliance)), ca.jacobian(terms, tip.pressures),
            ],
        ),
        function_of("judge", inputs, program.judge(tip, parameters)),
    ]  # fmt: skip
