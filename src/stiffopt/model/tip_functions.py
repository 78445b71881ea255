"""Functions of an unloaded arm's tip, in machine code where that pays.

Their arguments are the arm's numbers (see `stiffopt.model.layout`) and what varies
from call to call (direction, kind and boundary of a stiffness), so one library serves all
arms of a layout.  Every function also returns the margins of the strain laws, so no
second pass over a batch is needed to check them.
"""

import threading
from collections.abc import Callable
from functools import cached_property, lru_cache, partial

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.arguments import DirectionalMeasure
from stiffopt.model.batch import BatchFunction, InterpretedFunction
from stiffopt.model.codegen import dense
from stiffopt.model.compiled import Library, library
from stiffopt.model.compliance import held_stiffness
from stiffopt.model.layout import Layout, symbolic_arm

LOOKED_UP_FROM = 64
"""Number of rows of a batch from which compiled code is used, if it is in the cache."""

COMPILED_FROM = 50_000
"""Number of rows of all batches after which code is compiled: compiling takes about a second, as
long as these rows take in the VM."""

_BLOCK = 65_536  # rows

_Call = Callable[..., list[Array]]
_Ends = tuple[list[ca.SX], list[ca.SX]]  # symbols and expressions


class TipFunctions:
    """Functions of an arm's tip by name (see the methods of `TipFormulas`).

    Values from machine code and from the VM are equal to the last bit.
    """

    def __init__(self, layout: Layout, numbers: Array) -> None:
        self._layout, self._numbers = layout, numbers
        self.interpreted = tip_formulas(layout).interpreted
        self._library: Library | None = None
        self._looked_up = False
        self._rows = 0
        self._lock = threading.Lock()

    def evaluate(self, name: str, p: Array, *parameters: Array) -> list[Array]:
        """Return value (..., r, c) and margins (..., segments, 1) at pressures (n,) or (N, n)."""
        return self._in_blocks(lambda call, q: call(name, q, self._numbers, *parameters), p)

    def stiffness(self, p: Array, measure: DirectionalMeasure) -> list[Array]:
        """Return a directional stiffness (..., 1, 1), and margins (..., segments, 1)."""
        if measure.boundary == "free":
            return self.evaluate("stiffness", p, _load(measure))
        return self._in_blocks(lambda call, q: self._held(call, q, measure), p)

    def stiffness_gradient(self, p: Array, measure: DirectionalMeasure) -> list[Array]:
        """Return its derivative (..., 1, n) by the pressures, and margins (..., segments, 1)."""
        if measure.boundary == "free":
            return self.evaluate("stiffness_gradient", p, _load(measure), np.ones(1))
        return self._in_blocks(lambda call, q: self._held_gradient(call, q, measure), p)

    def _held(self, call: _Call, p: Array, measure: DirectionalMeasure) -> list[Array]:
        compliance, margins = call("tip_compliance", p, self._numbers)
        pose, _ = call("tip_pose", p, self._numbers)
        value, _ = call("held_stiffness", compliance, pose, _held(measure))
        return [value, margins]

    def _held_gradient(self, call: _Call, p: Array, measure: DirectionalMeasure) -> list[Array]:
        """Return the gradient of ``k = D' C_held^-1 D``.

        With the wrench ``W`` that moves the held tip by ``D``: ``dk = -W' dC W + 2 W' dD``, where
        the first part is that of a flexibility.
        """
        held = _held(measure)
        compliance, margins = call("tip_compliance", p, self._numbers)
        pose, _ = call("tip_pose", p, self._numbers)
        jacobian, _ = call("tip_jacobian", p, self._numbers)
        _, load = call("held_stiffness", compliance, pose, held)
        slope, _ = call("stiffness_gradient", p, self._numbers, load[..., 0], np.zeros(1))
        (gradient,) = call("held_stiffness_gradient", slope, jacobian, pose, load[..., 0], held)
        return [gradient, margins]

    def _in_blocks(self, formula: Callable[[_Call, Array], list[Array]], p: Array) -> list[Array]:
        """Evaluate a formula of several functions, for pressures (n,) or blocks of rows (N, n).

        Blocks need little memory for intermediate results, and machine code that becomes ready
        in the background is used from the next block on.
        """
        if p.ndim == 1:
            return formula(self._one, p)
        starts = range(0, max(len(p), 1), _BLOCK)
        blocks = [formula(self._many, p[start : start + _BLOCK]) for start in starts]
        if len(blocks) == 1:
            return blocks[0]
        return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]

    def _one(self, name: str, *arguments: Array) -> list[Array]:
        if self._library is not None:
            return self._library.function(name)(*arguments)
        return self.interpreted(name)(*arguments)

    def _many(self, name: str, *arguments: Array) -> list[Array]:
        return self._best(name, len(arguments[0])).many(*arguments)

    def _best(self, name: str, rows: int) -> BatchFunction:
        if rows < LOOKED_UP_FROM:
            return self.interpreted(name)
        with self._lock:
            self._rows += rows
            missing = self._rows >= COMPILED_FROM
            if self._library is None and (missing or not self._looked_up):
                self._looked_up = True
                self._library = library(
                    ("tip", self._layout.skeleton),
                    partial(_tip_functions, self._layout),
                    build_missing=missing,
                )
            if self._library is not None:
                return self._library.function(name)
        return self.interpreted(name)


@lru_cache(maxsize=256)
def _load(measure: DirectionalMeasure) -> Array:
    """Return a unit load (12,): a wrench in base axes and one in tip axes; one of them is zero."""
    start = (0 if measure.frame == "base" else 6) + (0 if measure.kind == "translation" else 3)
    load = np.zeros(12)
    load[start : start + 3] = measure.direction
    load.flags.writeable = False
    return load


@lru_cache(maxsize=256)
def _held(measure: DirectionalMeasure) -> Array:
    """Return a unit direction (3,) in base or tip axes, the other zero, and two conditions."""
    own, none = measure.direction, (0.0, 0.0, 0.0)
    axes = (*own, *none) if measure.frame == "base" else (*none, *own)
    conditions = (measure.kind == "rotation", measure.boundary == "clamped")
    held = np.array([*axes, *conditions], dtype=float)
    held.flags.writeable = False
    return held


def _tip_functions(layout: Layout) -> list[ca.Function]:
    formulas = tip_formulas(layout)
    return [formulas.function(name) for name in TipFormulas.NAMES]


@lru_cache(maxsize=64)
def tip_formulas(layout: Layout) -> "TipFormulas":
    """Return the functions of the tip of all arms of a layout; cached."""
    return TipFormulas(layout)


class TipFormulas:
    """Symbolic functions of the tip, each named like its method.

    Functions of the pressures take the arm's numbers next, and end with the margins of the strain
    laws.
    """

    NAMES = (
        "tip_pose",
        "tip_jacobian",
        "tip_compliance",
        "stiffness",
        "stiffness_gradient",
        "held_stiffness",
        "held_stiffness_gradient",
    )

    def __init__(self, layout: Layout) -> None:
        self._arm = symbolic_arm(layout)
        self._tip = self._arm.tip
        self._lock = threading.Lock()
        self._interpreted: dict[str, InterpretedFunction] = {}

    def interpreted(self, name: str) -> InterpretedFunction:
        """Return one of them in the CasADi VM, shared by all arms of the layout."""
        found = self._interpreted.get(name)
        if found is None:
            with self._lock:
                if name not in self._interpreted:
                    self._interpreted[name] = InterpretedFunction(self.function(name))
                found = self._interpreted[name]
        return found

    def function(self, name: str) -> ca.Function:
        """Return one of them as a dense CasADi function."""
        formula: Callable[[], _Ends] = getattr(self, name)
        inputs, outputs = formula()
        return dense(ca.Function(name, inputs, ca.cse([ca.densify(part) for part in outputs])))

    def tip_pose(self) -> _Ends:
        """Return the pose (4, 4)."""
        return self._of_pressures(self._tip.transform)

    def tip_jacobian(self) -> _Ends:
        """Return the body twist (6, n) per pressure."""
        return self._of_pressures(self._tip.jacobian)

    def tip_compliance(self) -> _Ends:
        """Return the compliance (6, 6) in tip axes."""
        return self._of_pressures(self._tip.compliance)

    def tip_at(self) -> _Ends:
        """Return pose, Jacobian, compliance and the smallest margin."""
        tip, inputs = self._tip, [self._tip.pressures, self._arm.numbers]
        least = ca.mmin(self._arm.actuation.margin)
        return inputs, [tip.transform, tip.jacobian, tip.compliance, least]

    def margin(self) -> _Ends:
        """Return the margins of the strain laws, one per segment."""
        return [self._tip.pressures, self._arm.numbers], [self._arm.actuation.margin]

    def stiffness(self) -> _Ends:
        """Return the stiffness of the free tip along a load (12,), see `_load`."""
        load, flexibility = self._flexibility
        return self._of_pressures(1 / flexibility, load)

    def stiffness_gradient(self) -> _Ends:
        """Return its gradient, or that of minus the flexibility if the last argument is 0."""
        load, flexibility = self._flexibility
        inverted = ca.SX.sym("inverted")
        factor = ca.if_else(inverted, 1 / flexibility**2, 1)
        gradient = self._tip.total_jacobian(flexibility)
        return self._of_pressures(-factor * gradient, load, inverted)

    def held_stiffness(self) -> _Ends:
        """Return stiffness and load from the compliance, pose and arguments of `_held`."""
        compliance, pose, held = ca.SX.sym("C", 6, 6), ca.SX.sym("T", 4, 4), ca.SX.sym("held", 8)
        direction = pose[:3, :3].T @ held[:3] + held[3:6]
        value, wrench = held_stiffness(compliance, direction, held[6], held[7])
        return [compliance, pose, held], [value, ca.vertcat(ca.SX.zeros(6), wrench)]

    def held_stiffness_gradient(self) -> _Ends:
        """Return its gradient from minus that of the flexibility, and the turn of the axes."""
        n = self._tip.pressures.numel()
        slope, jacobian, pose = ca.SX.sym("g", 1, n), ca.SX.sym("J", 6, n), ca.SX.sym("T", 4, 4)
        load, held = ca.SX.sym("load", 12), ca.SX.sym("held", 8)
        own = ca.if_else(held[6], load[9:], load[6:9])
        turned = ca.cross(own, pose[:3, :3].T @ held[:3])  # dD = D x omega in tip axes
        gradient = slope + 2 * turned.T @ jacobian[3:, :]
        return [slope, jacobian, pose, load, held], [gradient]

    @cached_property
    def _flexibility(self) -> tuple[ca.SX, ca.SX]:
        load = ca.SX.sym("load", 12)
        turned = self._tip.rotation.T @ ca.horzcat(load[:3], load[3:6])
        return load, self._tip.flexibility(ca.vec(turned) + load[6:])

    def _of_pressures(self, value: ca.SX, *parameters: ca.SX) -> _Ends:
        inputs = [self._tip.pressures, self._arm.numbers, *parameters]
        return inputs, [value, self._arm.actuation.margin]
