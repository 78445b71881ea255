"""`Arm`: evaluate functions of an arm's shape, free or in equilibrium under loads.

It checks pressures, finds equilibria and caches compiled functions.
`stiffopt.model.manipulator.Manipulator` adds pose, Jacobian, compliance and stiffness.
"""

from collections.abc import Callable, Hashable
from functools import cached_property
from math import isfinite
from typing import Any, Self, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError, InputError, PressureError, shown
from stiffopt.model.arguments import (
    checked_integer,
    checked_number,
    checked_vector,
    real_numbers,
)
from stiffopt.model.batch import BatchFunction, InterpretedFunction
from stiffopt.model.body import BodyShape
from stiffopt.model.codegen import dense
from stiffopt.model.compiled import checkpoint
from stiffopt.model.compliance import Frame
from stiffopt.model.description import RobotDescription
from stiffopt.model.equilibrium import Equilibrium, EquilibriumState, Loads, dead_and_follower
from stiffopt.model.kinematics import Actuation
from stiffopt.model.laws import strain_law
from stiffopt.model.layout import free_tip_function, layout_of, numbers_of
from stiffopt.model.shape import FreeShape, Shape
from stiffopt.model.shooting import SAME_STATION, Shooting
from stiffopt.model.tip_functions import TipFunctions

Values = Callable[[Shape], Any]
Kept = TypeVar("Kept")


class Arm:
    """Functions of the shape of one arm; see `Manipulator` for the arguments."""

    def __init__(
        self,
        description: RobotDescription,
        *,
        force: ArrayLike = (0.0, 0.0, 0.0),
        moment: ArrayLike = (0.0, 0.0, 0.0),
        load_frame: Frame = "base",
        resolution: int = 1,
    ) -> None:
        if not isinstance(description, RobotDescription):
            raise InputError(f"expected a RobotDescription, not {shown(description)}")
        self.description, self._n = description, description.n_pressures
        self.resolution = checked_integer("resolution", resolution, 1)
        self._tip_load = _tip_load(force, moment, load_frame)
        self._kept: dict[Hashable, Any] = {}
        self.layout, self.numbers = layout_of(description), numbers_of(description)
        self._tip = TipFunctions(self.layout, self.numbers)
        low, high = self.pressure_min, self.pressure_max
        for corner in (low, high, np.where(np.abs(low) > np.abs(high), low, high)):
            self._check_margin(corner[np.newaxis], " within the robot's pressure limits")

    # -- properties -------------------------------------------------------------------------

    @property
    def n_pressures(self) -> int:
        """Number of channels n."""
        return self._n

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return self.description.n_segments

    @property
    def length(self) -> float:
        """Length at rest, connectors included, in m."""
        return self.description.length

    @property
    def pressure_min(self) -> Array:
        """Lower limits (n,) in Pa."""
        return np.array(self.description.pressure_min)

    @property
    def pressure_max(self) -> Array:
        """Upper limits (n,) in Pa."""
        return np.array(self.description.pressure_max)

    @property
    def is_loaded(self) -> bool:
        """Whether gravity or a tip load acts, so that shapes are equilibria."""
        return any(self.description.gravity) or bool(self._tip_load.any())

    @property
    def tip_load(self) -> tuple[float, ...]:
        """Dead wrench in base axes (6), then follower wrench in tip axes (6), at the tip."""
        return tuple(self._tip_load.tolist())

    def with_load(
        self, force: ArrayLike, moment: ArrayLike = (0.0, 0.0, 0.0), frame: Frame = "base"
    ) -> Self:
        """Return the same arm with this load at its tip, in place of its present load."""
        other = self.__copy__()
        other._tip_load = _tip_load(force, moment, frame)
        other.__dict__.pop("_body", None)
        return other

    def __copy__(self) -> Self:
        """Return a copy that shares compiled functions; loads are arguments of these."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def __repr__(self) -> str:
        loaded = ", loaded" if self.is_loaded else ""
        count = self.n_segments
        return (
            f"{type(self).__name__}({self.description.name}: {count} segment{'s' * (count > 1)}, "
            f"{self.n_pressures} channels, {1e3 * self.length:.4g} mm{loaded})"
        )

    def __reduce__(self) -> tuple[object, ...]:
        """Support pickling: compiled functions are not stored."""
        dead, follower = self._tip_load[:6], self._tip_load[6:]
        frame = "tip" if follower.any() else "base"
        wrench = tuple((follower if follower.any() else dead).tolist())
        return _rebuild, (type(self), self.description, wrench, frame, self.resolution)

    # -- for the optimiser ------------------------------------------------------------------

    def tip_function(
        self, name: str, outputs: Callable[[Shape, Any], list[Any]], n_parameters: int = 0
    ) -> ca.Function:
        """Return a dense symbolic function of the inputs of the tip's shape and of parameters.

        The parameters are those of `parameters`: the arm's numbers, then the caller's own.
        """
        if not self.is_loaded:
            return free_tip_function(self.layout, name, outputs, n_parameters)
        tip = self._symbolic(None)
        parameters = ca.MX.sym("parameters", len(self.numbers) + n_parameters)
        own = parameters[len(self.numbers) :]
        found = [ca.densify(output) for output in outputs(tip, own)]
        return dense(ca.Function(name, [*tip.inputs, parameters], found))

    def parameters(self, own: ArrayLike = ()) -> Array:
        """Return the parameters of a `tip_function`: the arm's numbers, then the caller's own."""
        return np.concatenate([self.numbers, np.asarray(own, dtype=float)])

    def evaluator(
        self,
        key: Hashable,
        outputs: Callable[[Shape, Any], list[Any]],
        n_parameters: int = 0,
    ) -> "Evaluator":
        """Return an evaluator of outputs of the tip's shape and `parameters`, cached by `key`."""
        return Evaluator(
            self,
            self.kept(
                ("evaluator", key, n_parameters, self.is_loaded),
                lambda: InterpretedFunction(self.tip_function("evaluator", outputs, n_parameters)),
            ),
        )

    def kept(self, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """Return the cached item of this key, or make it; the cache is shared by all loads."""
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]

    # -- numerics ---------------------------------------------------------------------------

    @cached_property
    def _actuation(self) -> Actuation:
        return Actuation.of(self.description)

    @property
    def _loads(self) -> Loads:
        return Loads(np.array(self.description.gravity), self._tip_load, np.zeros(12))

    def _equilibrium(self, at: float | None = None) -> Equilibrium:
        """Return the equilibria with an additional load at a station."""
        shooting = self.kept(
            "shooting", lambda: Shooting(self.description, self._actuation, self.resolution)
        )
        return self.kept(("equilibrium", at), lambda: Equilibrium(shooting, at))

    @cached_property
    def _section_parts(self) -> ca.Function:
        sections = self._actuation.sections
        return ca.Function(
            "sections",
            [self._actuation.pressures],
            [section.strain for section in sections] + [section.compliance for section in sections],
        )

    def _symbolic(self, at: float | None) -> Shape:
        """Return the shape of a station, without or with loads."""
        if self.is_loaded:
            return self._equilibrium().shooting.chain(at)
        return FreeShape.of(self.description, self._actuation, at)

    def _function(
        self, key: Hashable, outputs: Callable[[Shape], list[Any]], at: float | None = None
    ) -> InterpretedFunction:
        def make() -> InterpretedFunction:
            shape = self._symbolic(at)
            return InterpretedFunction(
                dense(ca.Function("shape", list(shape.inputs), outputs(shape)))
            )

        return self.kept((key, at, self.is_loaded), make)

    def _evaluate(
        self, key: Hashable, value: Values, p: ArrayLike, at: float | None = None
    ) -> Array:
        """Evaluate a value of a shape for one or many pressures, as (..., rows, columns)."""
        batch, single = self._pressures(p)
        function = self._function(key, lambda shape: [value(shape)], at)
        if not self.is_loaded:
            results = function.many(batch)[0]
        else:
            arguments = self._equilibrium().arguments
            rows = [function(*arguments(self.settle(row)))[0] for row in batch]
            results = _stacked(rows, function.signature.outputs[0])
        return results[0] if single else results

    def _checked_tip(self, evaluate: Callable[[Array], list[Array]], p: ArrayLike) -> Array:
        """Evaluate a quantity (..., rows, columns) of the arm without loads, and check margins.

        `evaluate` returns the quantity and the margins of the strain laws.
        """
        values = self._checked(p)
        result, margins = evaluate(values)
        allowed = (
            all(margin > 0 for margin in margins[:, 0].tolist())
            if values.ndim == 1
            else (margins > 0).all()
        )
        if not allowed:
            self._check_margin(np.atleast_2d(values), "")
        return result

    def settle(self, p: Array, nearby: EquilibriumState | None = None) -> EquilibriumState:
        """Find the equilibrium of the loaded arm at pressures (n,), from rest or from a nearby one.

        Stability is not checked when starting from a nearby one.

        Raises `EquilibriumError` if none is reached continuously (and, from rest, stable).
        """
        if nearby is None:
            return self._equilibrium().settle(p, self._loads)
        end = nearby._replace(pressures=p, loads=self._loads)
        path = self._equilibrium().follow(nearby, end, shortest=0.1, stable=False)
        if path.share < 1.0:
            raise EquilibriumError("no equilibrium was found on the way from the nearby one")
        return path.state

    @cached_property
    def _body(self) -> BodyShape:
        return BodyShape(self)

    def _at_stations(
        self, of_body: Callable[[Array, Array], Array], p: ArrayLike, at: Array
    ) -> Array:
        """Evaluate a quantity at arc lengths () or (k,), for one or many pressures.

        Results have leading axes for pressures (N,) and stations (k,) if there are several.
        """
        values = self._checked(p)
        single = values.ndim == 1
        found = of_body(values[np.newaxis] if single else values, np.atleast_1d(at))
        if at.ndim == 0:
            found = found[:, 0]
        return found[0] if single else found

    # -- checks -----------------------------------------------------------------------------

    def _pressures(self, p: ArrayLike) -> tuple[Array, bool]:
        """Return checked pressures (N, n), and whether a single set was given."""
        values = self._checked(p)
        batch = np.atleast_2d(values)
        self._check_margin(batch, "")
        return batch, values.ndim == 1

    def _checked(self, p: ArrayLike) -> Array:
        """Return finite pressures (n,) or (N, n); the strain law's limits are not checked.

        An array of the right kind is returned as it is.
        """
        if type(p) is np.ndarray and p.dtype == np.float64:
            values = p
        else:
            try:
                values = real_numbers(p)
            except ValueError as error:
                raise PressureError(f"pressures must be numbers in Pa; got {p!r}") from error
        if values.ndim not in (1, 2) or values.shape[-1] != self.n_pressures:
            raise PressureError(
                f"expected pressures of shape ({self.n_pressures},) or (N, {self.n_pressures}) "
                f"for robot '{self.description.name}', proximal segment first; "
                f"got shape {values.shape}"
            )
        # a loop over a few numbers is several times as fast as NumPy
        finite = (
            all(map(isfinite, values.tolist()))
            if values.ndim == 1
            else bool(np.isfinite(values).all())
        )
        if not finite:
            raise PressureError("pressures must be finite; got NaN or an infinity")
        return values

    def checked_pressures(self, p: ArrayLike) -> Array:
        """Return one set of finite pressures (n,); the strain law's limits are not checked.

        Raises `PressureError` if they are anything else.
        """
        values = self._checked(p)
        if values.ndim != 1:
            raise PressureError(f"expected one set of pressures ({self.n_pressures},), not a batch")
        return values

    def _single(self, p: ArrayLike) -> Array:
        values = self.checked_pressures(p)
        self._check_margin(values[np.newaxis], "")
        return values

    def _check_margin(self, batch: Array, where: str) -> None:
        """Raise where the strain law of a segment breaks down."""
        if not len(batch):
            return
        (margins,) = self._tip.interpreted("margin").many(batch, self.numbers)
        margins = margins[..., 0]  # (N, segments)
        if (margins > 0).all():
            return
        segment, row = np.argwhere(~(margins.T > 0))[0]
        bars = ", ".join(f"{value / 1e5:.4g}" for value in batch[row])
        law = strain_law(self.description.segments[segment])
        raise PressureError(
            f"segment {segment + 1} of robot '{self.description.name}' at ({bars}) bar{where}: "
            f"{law.limit}; lower the pressure or its limit"
        )

    def _station(self, at: float | None) -> float | None:
        if at is None:
            return None
        value = self._arc_length(at)
        return None if value == self.length else value

    def _arc_lengths(self, at: ArrayLike, base_too: bool = False) -> Array:
        """Return arc lengths (), or (k,) of several stations."""
        try:
            values = real_numbers(at)
        except ValueError:
            return np.array(self._arc_length(at, base_too))  # raises the error
        if values.ndim > 1:
            raise InputError(f"arc lengths must be a number or (k,) numbers; got {shown(at)}")
        slack = SAME_STATION * self.length
        good = (values >= (0 if base_too else slack)) & (values <= self.length + slack)
        if not good.all():
            self._arc_length(values.flat[int(good.argmin())], base_too)
        return np.minimum(values, self.length)

    def _arc_length(self, at: ArrayLike, base_too: bool = False) -> float:
        value = checked_number("arc length", at)
        slack = SAME_STATION * self.length
        if not (0 if base_too else slack) <= value <= self.length + slack:
            raise InputError(
                f"arc length {value:g} m is not on the arm: between {'' if base_too else 'above '}"
                f"0 and {self.length:g} m at rest"
            )
        return self.length if value > self.length - slack else value


class Evaluator:
    """A function of the tip's shape that finds each equilibrium from the previous one.

    After `restart` the next equilibrium is found from rest.
    """

    def __init__(self, arm: Arm, function: BatchFunction) -> None:
        self._arm = arm
        self._function = function
        # equilibrium at the last evaluation; None for an arm without loads
        self.state: EquilibriumState | None = None

    def restart(self, state: EquilibriumState | None = None) -> None:
        """Forget the previous equilibrium, or continue from the given one."""
        self.state = state

    def many(self, batch: Array, *parameters: Array) -> list[Array]:
        """Return outputs at checked pressures (N, n), without loads, each (N, rows, columns)."""
        return self._function.many(batch, *(parameters or (self._arm.numbers,)))

    def __call__(self, p: Array, *parameters: Array) -> list[Array]:
        """Return outputs at checked pressures (n,) and parameters, as 2-D arrays."""
        checkpoint()
        parameters = parameters or (self._arm.numbers,)
        if self._arm.is_loaded:
            self.state = self._arm.settle(p, self.state)
            inputs = self._arm._equilibrium().arguments(self.state)
        else:
            inputs = (p,)
        return self._function(*inputs, *parameters)


def _stacked(results: list[Array], shape: tuple[int, ...]) -> Array:
    """Stack results of this shape into one array (N, ...); N may be 0."""
    return np.array(results).reshape(len(results), *shape)


def _tip_load(force: ArrayLike, moment: ArrayLike, frame: Frame) -> Array:
    wrench = [checked_vector("force", force), checked_vector("moment", moment)]
    return dead_and_follower(np.concatenate(wrench), frame)


def _rebuild(
    kind: type[Arm],
    description: RobotDescription,
    wrench: tuple[float, ...],
    frame: Frame,
    resolution: int,
) -> Arm:
    """Unpickle an arm."""
    force, moment = wrench[:3], wrench[3:]
    return kind(description, force=force, moment=moment, load_frame=frame, resolution=resolution)
