"""Manipulator: the numerical functions of one arm, single and batched, that everyone calls."""

import os
from collections.abc import Callable, Hashable, Sequence
from copy import copy
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt import lie
from stiffopt.errors import InputError, PressureError
from stiffopt.model.actuation import strain_law
from stiffopt.model.compliance import Boundary, Frame, Kind, directional_stiffness
from stiffopt.model.description import RobotDescription, load_description
from stiffopt.model.equilibrium import Equilibrium, Loads, State
from stiffopt.model.kinematics import Actuation
from stiffopt.model.screws import Twist, Wrench
from stiffopt.model.shape import FreeShape, Shape
from stiffopt.model.shooting import Shooting

Vector = NDArray[np.float64]
Method = Literal["equilibrium", "first-order", "elementwise"]
Values = Callable[[Shape], ca.SX | ca.MX]

_ELEMENTS_PER_SEGMENT = 64  # of eq. 19
_CHOICES = {
    "kind": ("translation", "rotation"),
    "boundary": ("free", "guided", "clamped"),
    "frame": ("base", "tip"),
}


class Manipulator:
    """An arm as functions of its channel pressures, in SI units.

    Pressures p are (n,) or, for a batch, (N, n) gauge pressures in Pa, proximal segment first;
    a batch gives results with a leading axis N.  Without gravity and load everything is in
    closed form (eqs 5-17).  With gravity or a tip load every quantity means the loaded arm: its
    static equilibrium reached continuously from rest, and the tangent compliance there.

    Parameters
    ----------
    description : RobotDescription
        What the arm is.
    force, moment : array_like, optional
        Load (3,) at the tip, in N and N m.
    load_frame : {"base", "tip"}
        Whether the load keeps its direction in space, or follows the tip.
    resolution : int
        Multiplies the integration steps of the equilibrium; 1 is exact to about a micrometre.

    Raises
    ------
    PressureError
        If the strain law breaks down within the robot's own pressure limits.  Every method
        raises it too, for pressures that are not finite, of another shape, or beyond the law.
    EquilibriumError
        Raised by every method where the loaded arm buckles or falls over.
    """

    def __init__(
        self,
        description: RobotDescription,
        *,
        force: ArrayLike = (0.0, 0.0, 0.0),
        moment: ArrayLike = (0.0, 0.0, 0.0),
        load_frame: Frame = "base",
        resolution: int = 1,
    ) -> None:
        if isinstance(resolution, bool) or not isinstance(resolution, int) or resolution < 1:
            raise InputError(f"resolution must be a positive integer; got {resolution!r}")
        self.description = description
        self.resolution = resolution
        self._tip_load = _tip_load(force, moment, load_frame)
        self._actuation = Actuation.of(description)
        self._functions: dict[Hashable, ca.Function] = {}
        self._shared: dict[str, Equilibrium] = {}
        self._margin = ca.Function(
            "margin", [self._actuation.pressures], [self._actuation.margin]
        )
        for corner in (self.pressure_min, self.pressure_max, self._farthest_pressures()):
            self._check_margin(corner[np.newaxis], " within the robot's pressure limits")

    # -- what the arm is --------------------------------------------------------------------

    @property
    def n_pressures(self) -> int:
        """Number of channels n."""
        return self.description.n_pressures

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return self.description.n_segments

    @property
    def length(self) -> float:
        """Length at rest, connectors included, in m."""
        return self.description.length

    @property
    def pressure_min(self) -> Vector:
        """Lower limits (n,) in Pa."""
        return np.array(self.description.pressure_min)

    @property
    def pressure_max(self) -> Vector:
        """Upper limits (n,) in Pa."""
        return np.array(self.description.pressure_max)

    @property
    def is_loaded(self) -> bool:
        """Whether gravity or a tip load acts, so that shapes are equilibria."""
        return any(self.description.gravity) or bool(self._tip_load.any())

    def with_load(
        self, force: ArrayLike, moment: ArrayLike = (0.0, 0.0, 0.0), frame: Frame = "base"
    ) -> "Manipulator":
        """The same arm with this load at its tip, instead of any that it carries now."""
        other = copy(self)  # shares what is compiled: loads are arguments of it
        other._tip_load = _tip_load(force, moment, frame)
        return other

    # -- shape ------------------------------------------------------------------------------

    def tip_pose(self, p: ArrayLike) -> Vector:
        """Pose of the tip in the base frame (eq. 7), (4, 4) or (N, 4, 4)."""
        return self._evaluate("pose", lambda tip: tip.transform, p)

    def tip_jacobian(self, p: ArrayLike) -> Vector:
        """Twist of the tip in tip axes per pressure, (6, n): m/Pa above, rad/Pa below."""
        return self._evaluate("jacobian", lambda tip: tip.jacobian, p)

    def tip_jacobian_derivative(self, p: ArrayLike) -> Vector:
        """Derivative of `tip_jacobian` by the pressures, (6, n, n); the last axis is the new.

        With the paper's compensation it does not exist at exactly p = 0 (slip 6 of the model's
        norm law), where the value returned belongs to the rounded cone.
        """
        n = self.n_pressures
        flat = self._evaluate(
            "jacobian derivative", lambda tip: tip.total_jacobian(ca.vec(tip.jacobian)), p
        )
        return np.swapaxes(flat.reshape(*flat.shape[:-2], n, 6, n), -3, -2)

    def backbone(self, p: ArrayLike, n: int = 50) -> Vector:
        """Poses (n, 4, 4) along the arm, equally spaced at rest from the base to the tip."""
        if isinstance(n, bool) or not isinstance(n, int) or n < 2:
            raise InputError(f"backbone needs at least n = 2 poses; got {n!r}")
        batch, single = self._pressures(p)
        stations = np.linspace(0.0, self.length, n)
        shapes = np.stack([self._shape(row, stations) for row in batch])
        return shapes[0] if single else shapes

    def pose(self, p: ArrayLike, at: float) -> Vector:
        """Pose (4, 4) or (N, 4, 4) at arc length `at` (m, at rest, from the base)."""
        at = self._arc_length(at)
        batch, single = self._pressures(p)
        poses = np.stack([self._shape(row, np.array([at]))[0] for row in batch])
        return poses[0] if single else poses

    # -- compliance -------------------------------------------------------------------------

    def tip_compliance(self, p: ArrayLike) -> Vector:
        """Compliance of the tip in tip axes (eq. 17, or tangent), (6, 6), linear first."""
        return self._evaluate("compliance", lambda tip: tip.compliance, p)

    def compliance(self, p: ArrayLike, at: float) -> Vector:
        """Compliance (6, 6) at arc length `at` (m, at rest), in the axes of that point."""
        at = self._arc_length(at)
        return self._evaluate("compliance", lambda point: point.compliance, p, at=at)

    def stiffness(
        self,
        p: ArrayLike,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
        at: float | None = None,
    ) -> Any:
        """Stiffness along a direction (N/m), or about it for `kind` "rotation" (N m/rad).

        Parameters
        ----------
        p : (n,) or (N, n)
            Pressures in Pa.
        direction : (3,)
            Need not be of unit length; in the axes that `frame` names.
        kind : {"translation", "rotation"}
        boundary : {"free", "guided", "clamped"}
            ``1 / (d'C_vv d)``; ``d'C_vv^-1 d``; ``d'(C^-1)_vv d``.
        frame : {"base", "tip"}
        at : float, optional
            Arc length of another point than the tip, in m at rest; "tip" then means its axes.

        Returns
        -------
        float or ndarray (N,)
        """
        measure = _direction(direction), *_choices(kind=kind, boundary=boundary, frame=frame)
        result = self._evaluate(
            ("stiffness", measure), _stiffness_of(measure), p, at=self._station(at)
        )[..., 0, 0]
        return float(result) if result.ndim == 0 else result

    def stiffness_gradient(
        self,
        p: ArrayLike,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
    ) -> Vector:
        """Derivative of `stiffness` at the tip by the pressures, (n,) or (N, n)."""
        measure = _direction(direction), *_choices(kind=kind, boundary=boundary, frame=frame)
        stiffness = _stiffness_of(measure)
        return self._evaluate(
            ("stiffness gradient", measure), lambda tip: tip.total_jacobian(stiffness(tip)), p
        )[..., 0, :]

    # -- screws and loads -------------------------------------------------------------------

    def tip_twist(self, p: ArrayLike, channel: int) -> Twist:
        """Screw of the tip's motion per Pa in one channel (counted from 0), in tip axes."""
        if isinstance(channel, bool) or not 0 <= channel < self.n_pressures:
            raise InputError(
                f"channel must be between 0 and {self.n_pressures - 1}; got {channel!r}"
            )
        return Twist(self.tip_jacobian(self._single(p))[:, channel])

    def deflection(self, p: ArrayLike, wrench: ArrayLike, frame: Frame = "base") -> Twist:
        """Screw of the tip's first-order motion under an added wrench (eq. 17), in tip axes.

        The wrench (6,) acts at the tip; `frame` names the axes of its components.
        """
        p = self._single(p)
        local = self._in_local_axes(wrench, self.tip_pose(p), frame)
        return Twist(self.tip_compliance(p) @ local)

    def internal_wrench(
        self, p: ArrayLike, wrench: ArrayLike, at: float, frame: Frame = "base"
    ) -> Wrench:
        """Wrench that a wrench at the tip causes in the section at `at` (eq. 11), in its axes."""
        p, at = self._single(p), self._arc_length(at, base_too=True)
        T_tip = self.tip_pose(p)
        local = self._in_local_axes(wrench, T_tip, frame)
        T_at = self._shape(p, np.array([at]))[0]
        return Wrench(local).transformed(lie.inverse(T_at) @ T_tip)

    def loaded_tip_pose(
        self,
        p: ArrayLike,
        wrench: ArrayLike,
        at: float | None = None,
        frame: Frame = "base",
        method: Method = "equilibrium",
    ) -> Vector:
        """Pose (4, 4) of the tip with one more load on the arm.

        Parameters
        ----------
        p : (n,)
            Pressures in Pa.
        wrench : (6,)
            Force and moment at the loaded point, in N and N m.
        at : float, optional
            Arc length of the loaded point in m at rest; the tip if absent.
        frame : {"base", "tip"}
            Axes of the wrench: the base's (a dead load) or the loaded point's own (it follows).
        method : {"equilibrium", "first-order", "elementwise"}
            Exact; or as the paper has it, about the shape without this load: eq. 18, the loaded
            point moves by ``exp(C W)`` and all beyond it rigidly; or eq. 19, each element of the
            arm gives way to its own share of the wrench.
        """
        p, at = self._single(p), self._station(at)
        _choices(frame=frame)
        if method == "equilibrium":
            return self._loaded_equilibrium(p, _wrench(wrench), at, frame)
        T_at = self.tip_pose(p) if at is None else self.pose(p, at)
        local = self._in_local_axes(wrench, T_at, frame)
        if method == "first-order":
            C = self.tip_compliance(p) if at is None else self.compliance(p, at)
            return T_at @ lie.exp(C @ local) @ lie.inverse(T_at) @ self.tip_pose(p)
        if method == "elementwise":
            if self.is_loaded:
                raise InputError(
                    "method 'elementwise' (eq. 19) is for the arm without gravity and load: its "
                    "elements know no geometric stiffness; use 'first-order' or 'equilibrium'"
                )
            return self._elementwise(p, local, self.length if at is None else at)
        raise InputError(
            f"unknown method {method!r}; choose 'equilibrium', 'first-order' or 'elementwise'"
        )

    def _loaded_equilibrium(
        self, p: Vector, wrench: Vector, at: float | None, frame: Frame
    ) -> Vector:
        loads = self._loads._replace(station=_two_frame_load(wrench, frame))
        state = self._equilibrium.settle(p, loads, at)
        return self._equilibrium.shape(state, np.array([self.length]), at)[0]

    def _elementwise(self, p: Vector, local: Vector, at: float) -> Vector:
        """Eq. 19 with elements at whose middle wrench and compliance are taken."""
        ends = [0.0]
        soft: list[int | None] = []
        for index, segment in enumerate(self.description.segments):
            start = ends[-1]
            cuts = np.linspace(0.0, segment.length, _ELEMENTS_PER_SEGMENT + 1)[1:]
            ends.extend(start + cuts)
            soft.extend([index] * _ELEMENTS_PER_SEGMENT)
            if segment.connector:
                ends.append(start + segment.length + segment.connector)
                soft.append(None)
        marks = np.array(ends)
        middles = (marks[1:] + marks[:-1]) / 2
        poses = self._shape(p, np.concatenate([marks, middles, [at]]))
        T_end, T_middle, T_at = poses[: len(marks)], poses[len(marks) : -1], poses[-1]
        compliances = [np.asarray(part) for part in self._section_compliances(p)]
        T = np.eye(4)
        for i, segment_index in enumerate(soft):
            near, middle, far = T_end[i], T_middle[i], T_end[i + 1]
            yields = segment_index is not None and middles[i] < at
            wrench = lie.coadjoint(lie.inverse(middle) @ T_at) @ local
            twist = (
                compliances[segment_index] @ wrench * (marks[i + 1] - marks[i])
                if yields and segment_index is not None
                else np.zeros(6)
            )
            T = T @ lie.inverse(near) @ middle @ lie.exp(twist) @ lie.inverse(middle) @ far
        return T

    # -- for the optimiser ------------------------------------------------------------------

    def evaluator(
        self,
        key: Hashable,
        outputs: Callable[[Shape, Any], list[Any]],
        n_parameters: int = 0,
    ) -> "Evaluator":
        """Compile outputs of the tip's shape and of parameters; `key` names them in the cache."""
        full_key = (key, n_parameters, self.is_loaded)
        if full_key not in self._functions:
            tip = self._symbolic(None)
            parameters = type(tip.position).sym("parameters", n_parameters)
            self._functions[full_key] = ca.Function(
                "evaluator", [*tip.inputs, parameters], outputs(tip, parameters)
            )
        return Evaluator(self, self._functions[full_key])

    # -- numerics ---------------------------------------------------------------------------

    @property
    def _loads(self) -> Loads:
        return Loads(np.array(self.description.gravity), self._tip_load, np.zeros(12))

    @property
    def _equilibrium(self) -> Equilibrium:
        if "equilibrium" not in self._shared:
            shooting = Shooting(self.description, self._actuation, self.resolution)
            self._shared["equilibrium"] = Equilibrium(shooting)
        return self._shared["equilibrium"]

    @cached_property
    def _section_parts(self) -> ca.Function:
        sections = self._actuation.sections
        return ca.Function(
            "sections",
            [self._actuation.pressures],
            [section.strain for section in sections]
            + [section.compliance for section in sections],
        )

    def _section_compliances(self, p: Vector) -> Sequence[ca.DM]:
        return self._section_parts(p)[self.n_segments :]  # type: ignore[no-any-return]

    def _symbolic(self, at: float | None) -> Shape:
        """Shape of a station, without or with loads."""
        if self.is_loaded:
            return self._equilibrium.shooting.chain(at)
        return FreeShape.of(self.description, self._actuation, at)

    def _function(
        self, key: Hashable, outputs: Callable[[Shape], list[Any]], at: float | None = None
    ) -> ca.Function:
        full_key = (key, at, self.is_loaded)
        if full_key not in self._functions:
            shape = self._symbolic(at)
            self._functions[full_key] = ca.Function("shape", list(shape.inputs), outputs(shape))
        return self._functions[full_key]

    def _evaluate(
        self, key: Hashable, value: Values, p: ArrayLike, at: float | None = None
    ) -> Vector:
        """Value of a shape for one or many pressures, as (..., rows, columns)."""
        batch, single = self._pressures(p)
        function = self._function(key, lambda shape: [ca.densify(value(shape))], at)
        results = (
            np.stack([function(*self._equilibrium.arguments(self.settle(row))).full() for row in batch])
            if self.is_loaded
            else evaluate_many(function, batch)
        )
        return results[0] if single else results

    def settle(self, p: Vector, nearby: State | None = None) -> State:
        """Equilibrium of the loaded arm at pressures (n,); from a nearby one where that helps.

        Raises
        ------
        EquilibriumError
            If there is none that is stable and reached continuously.
        """
        if nearby is not None:
            state = self._equilibrium.correct(nearby._replace(pressures=p, loads=self._loads))
            if state is not None:
                return state
        return self._equilibrium.settle(p, self._loads)

    def _shape(self, p: Vector, stations: Vector) -> Vector:
        """Poses (k, 4, 4) at arc lengths (k,)."""
        if self.is_loaded:
            return self._equilibrium.shape(self._equilibrium.settle(p, self._loads), stations)
        strains = [part.full()[:, 0] for part in self._section_parts(p)[: self.n_segments]]
        poses = np.empty((len(stations), 4, 4))
        for k, station in enumerate(stations):
            T, left = np.eye(4), station
            for segment, strain in zip(self.description.segments, strains, strict=True):
                soft = min(segment.length, left)
                rigid = min(segment.connector, left - soft)
                left -= soft + rigid
                T = T @ lie.exp(strain * soft) @ lie.transform(np.eye(3), np.array([0, 0, rigid]))
            poses[k] = T
        return poses

    # -- checks -----------------------------------------------------------------------------

    def _pressures(self, p: ArrayLike) -> tuple[Vector, bool]:
        """Checked pressures (N, n), and whether a single set was given."""
        try:
            values = np.asarray(p, dtype=float)
        except (TypeError, ValueError) as error:
            raise PressureError(f"pressures must be numbers in Pa; got {p!r}") from error
        if values.ndim not in (1, 2) or values.shape[-1] != self.n_pressures:
            raise PressureError(
                f"expected pressures of shape ({self.n_pressures},) or (N, {self.n_pressures}) "
                f"for robot '{self.description.name}', proximal segment first; "
                f"got shape {values.shape}"
            )
        batch = np.atleast_2d(values)
        if not np.isfinite(batch).all():
            raise PressureError("pressures must be finite; got NaN or an infinity")
        self._check_margin(batch, "")
        return batch, values.ndim == 1

    def _single(self, p: ArrayLike) -> Vector:
        batch, single = self._pressures(p)
        if not single:
            raise PressureError(f"expected one set of pressures ({self.n_pressures},), not a batch")
        return batch[0]

    def _check_margin(self, batch: Vector, where: str) -> None:
        """Raise where the strain law of a segment breaks down."""
        if not len(batch):
            return
        margins = self._margin(batch.T).full()  # (segments, N)
        if (margins > 0).all():
            return
        segment, row = np.argwhere(~(margins > 0))[0]
        bars = ", ".join(f"{value / 1e5:.4g}" for value in batch[row])
        law = strain_law(self.description.segments[segment])
        raise PressureError(
            f"segment {segment + 1} of robot '{self.description.name}' at ({bars}) bar{where}: "
            f"{law.limit}; lower the pressure or its limit"
        )

    def _farthest_pressures(self) -> Vector:
        low, high = self.pressure_min, self.pressure_max
        return np.where(np.abs(low) > np.abs(high), low, high)

    def _station(self, at: float | None) -> float | None:
        return None if at is None or at == self.length else self._arc_length(at)

    def _arc_length(self, at: float, base_too: bool = False) -> float:
        value = float(at)
        if not (0 <= value <= self.length * (1 + 1e-12)) or (value == 0 and not base_too):
            raise InputError(
                f"arc length {value:g} m is not on the arm: between {'' if base_too else 'above '}"
                f"0 and {self.length:g} m at rest"
            )
        return min(value, self.length)

    @staticmethod
    def _in_local_axes(wrench: ArrayLike, T: Vector, frame: Frame) -> Vector:
        _choices(frame=frame)
        values = _wrench(wrench)
        return values if frame == "tip" else lie.rotate_blocks(T[:3, :3].T) @ values


class Evaluator:
    """A compiled function of the tip's shape that stays close to where it was last asked.

    With loads the equilibrium at new pressures is found from the previous one; `restart`
    forgets it, and the next is found from rest.
    """

    def __init__(self, robot: Manipulator, function: ca.Function) -> None:
        self._robot = robot
        self._function = function
        self._state: State | None = None

    def restart(self, state: State | None = None) -> None:
        """Forget the previous equilibrium, or continue from the given one."""
        self._state = state

    @property
    def state(self) -> State | None:
        """Equilibrium at the last evaluation; None for an arm without loads."""
        return self._state

    def __call__(self, p: Vector, *parameters: Vector) -> list[Vector]:
        """Outputs at checked pressures (n,) and parameters, as 2-D arrays."""
        parameters = parameters or (np.zeros(0),)
        if self._robot.is_loaded:
            self._state = self._robot.settle(p, self._state)
            inputs = self._robot._equilibrium.arguments(self._state)
        else:
            inputs = (p,)
        return [value.full() for value in self._function.call([*inputs, *parameters])]


def evaluate_many(function: ca.Function, batch: Vector) -> Vector:
    """Evaluate a function of (n,) with one output (r, c) on (N, n): (N, r, c)."""
    rows, columns = function.size1_out(0), function.size2_out(0)
    if not len(batch):
        return np.empty((0, rows, columns))
    wide = function(batch.T).full()  # (r, N c)
    return np.ascontiguousarray(wide.reshape(rows, len(batch), columns).swapaxes(0, 1))


def load_robot(
    name_or_path: str | os.PathLike[str] | RobotDescription, *, resolution: int = 1
) -> Manipulator:
    """Manipulator of a built-in robot (``"stiff-flop-2"``), a robot file or a description."""
    if isinstance(name_or_path, RobotDescription):
        return Manipulator(name_or_path, resolution=resolution)
    return Manipulator(load_description(name_or_path), resolution=resolution)


Measure = tuple[tuple[float, ...], str, str, str]


def _stiffness_of(measure: Measure) -> Values:
    direction, kind, boundary, frame = measure

    def value(shape: Shape) -> Any:
        return directional_stiffness(
            shape.compliance,
            shape.rotation,
            ca.DM(direction),
            frame=frame,  # type: ignore[arg-type]
            kind=kind,  # type: ignore[arg-type]
            boundary=boundary,  # type: ignore[arg-type]
        )

    return value


def _choices(**given: str) -> tuple[str, ...]:
    for name, value in given.items():
        if value not in _CHOICES[name]:
            raise InputError(f"unknown {name} {value!r}; choose one of {', '.join(_CHOICES[name])}")
    return tuple(given.values())


def _vector(name: str, value: ArrayLike, size: int = 3) -> Vector:
    try:
        vector = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be {size} numbers; got {value!r}") from error
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise InputError(f"{name} must be {size} finite numbers; got {value!r}")
    return vector


def _wrench(value: ArrayLike) -> Vector:
    return _vector("wrench", value.coordinates if isinstance(value, Wrench) else value, 6)


def _direction(value: ArrayLike) -> tuple[float, ...]:
    vector = _vector("direction", value)
    length = np.linalg.norm(vector)
    if not length > 0:
        raise InputError("direction must not be zero")
    return tuple((vector / length).tolist())


def _tip_load(force: ArrayLike, moment: ArrayLike, frame: Frame) -> Vector:
    return _two_frame_load(
        np.concatenate([_vector("force", force), _vector("moment", moment)]), frame
    )


def _two_frame_load(wrench: Vector, frame: Frame) -> Vector:
    """Dead over follower wrench (12,) of `Loads`."""
    _choices(frame=frame)
    none = np.zeros(6)
    return np.concatenate([wrench, none] if frame == "base" else [none, wrench])
