"""`PressureSolution`: the answer to a task, judged by the model alone."""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.display import display_units
from stiffopt.errors import DerivativeError
from stiffopt.model.arm import Evaluator
from stiffopt.model.contact.equilibrium import Contact, ContactEquilibrium, Grip
from stiffopt.model.contact.push import ContactLoss
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.notebook import ShownInNotebook
from stiffopt.optimise.brace import kept_clear_of, leant_on
from stiffopt.optimise.functions import functions
from stiffopt.optimise.obstacles import CLEARANCE_OF, Obstacles
from stiffopt.optimise.program import Program
from stiffopt.optimise.settings import ANSWER, OBSTACLES
from stiffopt.optimise.task import Task

Status = Literal["solved", "unreachable", "failed"]

_explaining = threading.RLock()
_NOT_KEPT = ("_derivatives", "equilibrium")  # in copies and pickles


def _protect(owner: object, *names: str) -> None:
    """Replace arrays of a frozen dataclass by read-only copies."""
    for name in names:
        value = getattr(owner, name)
        if value is not None:
            value = np.array(value)
            value.flags.writeable = False
            object.__setattr__(owner, name, value)


@dataclass(frozen=True)
class Confidence:
    """How sure the global search is of its answer."""

    starts: int  # configurations that were brought towards the pose
    reached: int  # converged descents from starts that reached the pose
    # converged descents that ended within 0.1 % of the best; with a brace, of the answer
    agreeing: int
    optima: int  # distinct local optima among them
    # whether the search ended because enough descents in a row found nothing new (see
    # `stiffopt.optimise.search.effort`).  False: it ended before
    complete: bool

    def __str__(self) -> str:
        if not self.reached:
            return f"none of {self.starts} starts came to the pose"
        if self.starts == 1:
            return "local answer from the given guess"
        sure = "search complete"
        if not self.complete:
            sure = f"search not complete after {self.starts} starts"
        optima = "optimum" if self.optima == 1 else "optima"
        return (
            f"{self.agreeing} of {self.reached} descents agree on the best of {self.optima} local "
            f"{optima} ({sure})"
        )


@dataclass(frozen=True)
class Sensitivities:
    """First-order effects of small changes at the solution.

    Attributes
    ----------
    tip_jacobian : (6, n), tip twist in tip axes per Pa.
    stiffness_gradient : (n,), first stiffness of the task per Pa, in N/m/Pa or N m/rad/Pa.
    per_bound : gain from moving each active pressure limit outwards, in `objective_unit` per Pa.
    per_tolerance : gain by name of each term of the target, per m or rad of tolerance or, for an
        inequality, of margin; and per m less clearance of each object, see `per_clearance`.
    per_position_tolerance, per_angle_tolerance : gains for position and angle; None where the
        target has none.
    objective_unit : unit of the gain: "N/m" or "N*m/rad" of the (smallest) stiffness that is
        maximised; "m" or "rad" of the error of an unreachable pose; "bar^2" of mean square pressure
        for a task without a stiffness; "1", the squared relative mismatch, where one is matched.
    """

    tip_jacobian: Array
    stiffness_gradient: Array | None
    per_bound: dict[str, float]
    per_tolerance: dict[str, float]
    objective_unit: str

    def __post_init__(self) -> None:
        _protect(self, "tip_jacobian", "stiffness_gradient")

    @property
    def per_position_tolerance(self) -> float | None:
        """Gain per m of the position's tolerance."""
        return self.per_tolerance.get("position")

    @property
    def per_angle_tolerance(self) -> float | None:
        """Gain per rad of the angle's tolerance."""
        return self.per_tolerance.get("angle")

    @property
    def per_clearance(self) -> dict[str, float]:
        """Gain per m less clearance, by the objects of the scene."""
        return {
            key.removeprefix(CLEARANCE_OF): price
            for key, price in self.per_tolerance.items()
            if key.startswith(CLEARANCE_OF)
        }


class NearestObject(NamedTuple):
    """The object nearest to the body, and its distance in m."""

    distance: float
    name: str


class Preload(NamedTuple):
    """The push at the tip that the contacts of a brace withstand."""

    direction: Array  # of the push (3,), in base axes
    contacts: Grip  # whether they slide without resistance, or stick where there is friction
    loss: ContactLoss  # the push by which the first contact is lost, and how


class Explanation(NamedTuple):
    """The fields of a `PressureSolution` that take longer to compute than the solution itself."""

    message: str
    active_bounds: tuple[str, ...]
    freedom: int
    sensitivities: Sensitivities | None


@dataclass(frozen=True, eq=False, repr=False)
class PressureSolution(ShownInNotebook):
    """Answer to a task.  Errors and stiffness are computed from the model at `pressures`.

    Attributes
    ----------
    status : {"solved", "unreachable", "failed"}
        "unreachable": no pressures meet the whole task; the closest are given.  "failed": there is
        no answer, and all other fields are None or empty.
    message : str
        One or two sentences for people.
    pressures : ndarray (n,) or None
        In Pa.
    tip_pose : ndarray (4, 4) or None
    position_error : float or None
        Over the target's axes that are not free, in m; None without a position.
    angle_error : float or None
        Between axes or of the rotation, in rad; None without an angular target.
    compliance : ndarray (6, 6) or None
        Of the tip, in tip axes, linear first.
    stiffness : float or None
        The first stiffness that the task names (a matched one too), in `stiffness_unit`.
    stiffness_unit : str or None
    stiffnesses : tuple of float
        All stiffnesses that the task names: maximised or matched ones first, then floors.
    matrix_distance : float or None
        Relative Frobenius distance from the stiffness matrix to match.
    active_bounds : tuple of str
        Pressure limits at which the solution lies.
    freedom : int
        Number of independent pressure changes that keep the pose.
    confidence : Confidence or None
    sensitivities : Sensitivities or None
    counts : dict of str to int
        Work done: starts, descents, iterations, evaluations of the pose and of everything with
        gradients, quadratic programs.
    timings : dict of str to float
        Seconds: ``total`` and, where machine code was made first, the further ``compilation``.
    errors : dict of str to float
        By name of each term of the target: the length of its residual or, for an inequality, its
        margin, in the term's unit.
    robot : Manipulator or None
        The arm, which carries the task's load.
    contacts : tuple of Contact
        For a task with a brace: where the arm leans; empty if keeping clear is better.  If there
        are contacts, pose, errors, compliance and stiffness are those of the equilibrium in
        contact.
    free : PressureSolution or None
        For a task with a brace: the best answer that keeps clear of all objects.
    preloads : tuple of Preload
        What the contacts withstand, both ways along each direction that is maximised.
    limited_by : tuple of str
        For a braced answer: names of what keeps it from being stiffer.
    """

    status: Status
    message: str
    task: Task
    pressures: Array | None = None
    tip_pose: Array | None = None
    position_error: float | None = None
    angle_error: float | None = None
    compliance: Array | None = None
    stiffness: float | None = None
    stiffness_unit: str | None = None
    stiffnesses: tuple[float, ...] = ()
    matrix_distance: float | None = None
    active_bounds: tuple[str, ...] = field(default_factory=tuple)
    freedom: int = field(default_factory=int)
    confidence: Confidence | None = None
    sensitivities: Sensitivities | None = field(default_factory=lambda: None)
    counts: dict[str, int] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    robot: Manipulator | None = None
    contacts: tuple[Contact, ...] = ()
    free: Self | None = None
    preloads: tuple[Preload, ...] = ()
    limited_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _protect(self, "pressures", "tip_pose", "compliance")

    @classmethod
    def explained_later(cls, explain: Callable[[], "Explanation"], fields: dict[str, Any]) -> Self:
        """Return a solution whose `Explanation` is computed when first needed."""
        solution = cls.__new__(cls)
        solution.__dict__.update(fields, _explain=explain)
        for name in ("pressures", "tip_pose", "compliance"):
            fields[name].flags.writeable = False
        return solution

    def __getattr__(self, name: str) -> Any:  # only called for names that are not in __dict__
        if name in Explanation._fields:
            with _explaining:  # several threads may ask at once
                own = self.__dict__
                if name not in own and "_explain" in own:
                    explained = own["_explain"]()._asdict()
                    own.update({key: explained[key] for key in explained if key not in own})
                    del own["_explain"]
                if name in own:
                    return own[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        """Support pickling and copying: compute the explanation now."""
        _ = self.sensitivities
        return {key: value for key, value in self.__dict__.items() if key not in _NOT_KEPT}

    def __repr__(self) -> str:
        if self.pressures is None or self.tip_position is None:
            return f"PressureSolution({self.status}: {self.message})"
        units = display_units()
        pressure, length = units.pressure, units.length
        parts = [
            f"{self.status}: ({', '.join(pressure.number(p, '.3g') for p in self.pressures)}) "
            f"{pressure}",
            f"tip at ({', '.join(map(length.number, self.tip_position))}) {length}",
        ]
        if self.position_error is not None:
            parts.append(f"{length.text(self.position_error, '.3g')} off")
        if self.stiffness is not None:
            parts.append(units.of_si(self.stiffness_unit).text(self.stiffness))
        for each in self.contacts:
            force = units.force.text(float(np.linalg.norm(each.force)), ".3g")
            parts.append(f"leaning on '{each.object}' with {force}")
        return f"PressureSolution({', '.join(parts)})"

    def gradient(
        self,
        of: Literal["stiffness", "pressures"],
        by: Literal["target", "direction", "limits", "clearance"],
    ) -> Array:
        """Return the derivative of the optimum at this answer with respect to the task's data.

        Parameters
        ----------
        of : {"stiffness", "pressures"}
            The stiffness that is maximised (the smallest of several), in N/m or N m/rad, or the
            pressures (n,) in Pa.
        by : {"target", "direction", "limits", "clearance"}
            What varies, the rest held:

            - the target, in base axes: (3,), per m; with a pointing or an orientation (6,), the
              last three per rad of turning it about the axes;
            - the direction that is maximised (3,), zero along itself; for m directions (m, 3);
            - the pressure limits (2, n), lower and upper, per Pa: zero for inactive ones;
            - the clearance that the scene asks for (), per m.

        Returns
        -------
        ndarray
            Of the shape of `by`; for pressures, with a leading axis n.

        Raises
        ------
        DerivativeError
            If the answer is not an isolated optimum, or an object's distance has an edge there.
        InputError
            If the task maximises no directional stiffness, or has no scene, where that is needed.

        Notes
        -----
        Where `weakly_active` names a constraint, the derivative holds on one side only.
        """
        return self._derivatives.gradient(of, by)

    @property
    def weakly_active(self) -> tuple[str, ...]:
        """Constraints that are about to become active or inactive.

        `gradient` then holds only on the side on which the active constraints stay the same.
        """
        return self._derivatives.weak

    @cached_property
    def _derivatives(self) -> Any:
        from stiffopt.optimise.derivatives import AnswerDerivatives  # avoid a circular import

        if self.robot is None or self.pressures is None or not self.found:
            raise DerivativeError("only a solution that was found has derivatives")
        if self.contacts:
            raise DerivativeError("derivatives of an answer that leans on objects are not known")
        return AnswerDerivatives(self.robot, self.task, self.pressures)

    @property
    def clearance(self) -> float | None:
        """Least distance between the body and the objects of the task's scene, in m.

        For an answer that leans on objects, those that its brace names are left out.
        """
        near = self._clearances
        return None if near is None else near.distance

    @property
    def nearest_object(self) -> str | None:
        """Name of the scene's object nearest to the body."""
        near = self._clearances
        return None if near is None else near.name

    @property
    def mesh_error(self) -> float | None:
        """How much too small the clearance may be, in m, if the nearest object is a mesh.

        None without a mesh, or where it is less than a tenth of the clearance asked for.
        """
        from stiffopt.optimise.diagnosis import mesh_error  # avoid a circular import

        if self.robot is None or self.task.scene is None:
            return None
        return mesh_error(self.robot, self.task.scene, self.nearest_object)

    @cached_property
    def _clearances(self) -> NearestObject | None:
        if self.robot is None or self.pressures is None or self.task.scene is None:
            return None
        if self.equilibrium is not None:
            return self._clearances_in_contact(self.equilibrium, self.robot, self.task.scene)
        found = self.robot.clearances(self.pressures, self.task.scene)
        return NearestObject(float(found.distances.min()), found.nearest)

    def _clearances_in_contact(
        self, eq: ContactEquilibrium, robot: Manipulator, scene: Scene
    ) -> NearestObject | None:
        """Return the nearest of the objects that the arm may not lean on."""
        assert self.task.brace is not None
        others = kept_clear_of(scene, self.task.brace)
        if others is None:
            return None
        obstacles = Obstacles(others, robot.description)
        rows = zip(obstacles.exactly_nearest(eq.line), obstacles.row_objects, strict=True)
        distance, index = min((near.distance, index) for near, index in rows)
        return NearestObject(distance, others.objects[index].name)

    @property
    def stiffness_free(self) -> float | None:
        """The task's first stiffness, for the answer that keeps clear of all objects.

        None for a task without a brace, or where the target needs leaning.
        """
        return None if self.free is None or not self.free.found else self.free.stiffness

    @cached_property
    def equilibrium(self) -> ContactEquilibrium | None:
        """For a braced answer, the equilibrium in contact, reached from rest; otherwise None."""
        brace, scene = self.task.brace, self.task.scene
        p, robot = self.pressures, self.robot
        if not self.contacts or brace is None or scene is None or robot is None or p is None:
            return None
        return robot.contact_equilibrium(p, leant_on(scene, brace), approach=brace.approach)

    @property
    def found(self) -> bool:
        """Whether every tolerance, limit, clearance and demand of the task holds."""
        return self.status == "solved"

    @property
    def tip_position(self) -> Array | None:
        """Tip position (3,) in the base frame, in m."""
        return None if self.tip_pose is None else self.tip_pose[:3, 3]

    @property
    def tip_quaternion(self) -> Array | None:
        """Tip orientation (w, x, y, z), w >= 0."""
        if self.tip_pose is None:
            return None
        return lie.quaternion_from_rotation(self.tip_pose[:3, :3])


class Judgement(NamedTuple):
    """A task's quantities at given pressures, from the model alone."""

    tip_pose: Array
    errors: dict[str, float]
    compliance: Array
    stiffnesses: tuple[float, ...]
    matrix_distance: float | None
    pose_holds: bool
    limits_hold: bool
    shortfalls: tuple[str, ...]
    intruders: dict[str, float]
    touched: list[str]

    @property
    def holds(self) -> bool:
        """Whether the task is met in every respect."""
        return self.is_clear and self.pose_holds and self.limits_hold and not self.shortfalls

    @property
    def is_clear(self) -> bool:
        """Whether the body keeps the clearance of the scene."""
        return all(missing <= OBSTACLES.allowed for missing in self.intruders.values())

    @classmethod
    def of(
        cls,
        program: Program,
        numbers: tuple[list[float], Array, Array, list[float]],
        within: bool,
    ) -> "Judgement":
        """Return the judgement from the outputs of `Program.judge`.

        Parameters
        ----------
        program : of the task
        numbers : residuals (m,), tip pose (4, 4), compliance (6, 6), values of the measures (k,).
        within : whether the pressures are within their limits.
        """
        residuals, tip_pose, compliance, values = numbers
        errors = program.errors(residuals)
        stiffnesses, shortfalls, distance = [], [], None
        for measure, number in zip(program.measures, values, strict=True):
            if measure.is_stiffness:
                value = math.exp(number)
                stiffnesses.append(value)
            else:
                value = math.sqrt(number)
                distance = value if distance is None else distance
            if not measure.holds(value):
                shortfalls.append(measure.shortfall(value))
        return cls(
            tip_pose=tip_pose,
            errors=errors,
            compliance=compliance,
            stiffnesses=tuple(stiffnesses),
            matrix_distance=distance,
            pose_holds=all(term.holds(errors[term.name]) for term in program.terms),
            limits_hold=within,
            shortfalls=tuple(shortfalls),
            intruders=program.intruders(residuals),
            touched=program.touched(residuals),
        )


def are_within(pressures: Array, lower: Array, upper: Array) -> bool:
    """Return whether all pressures (n,) are within their limits."""
    limits = zip(lower.tolist(), pressures.tolist(), upper.tolist(), strict=True)
    return all(low <= p <= high for low, p, high in limits)


def judge(robot: Manipulator, task: Task, pressures: Array) -> Judgement:
    """Judge pressures (n,) by the model of the arm (which carries the task's load).

    Raises `EquilibriumError` if no equilibrium at these pressures is reached from rest.
    """
    program = Program.of(task, robot.description)
    found = Evaluator(robot, functions(robot, program)["judge"])
    residuals, pose, compliance, values = found(pressures, robot.parameters(program.parameters))
    lower, upper = task.pressure_bounds(robot.description)
    within = are_within(pressures, lower, upper)
    rows = residuals.ravel().tolist()
    if program.obstacles is not None:
        rows += program.obstacles.exact_rows(robot, pressures)
    numbers = (rows, pose.T, compliance.T, values.ravel().tolist())
    return Judgement.of(program, numbers, within)


def active_bounds(robot: Manipulator, task: Task, pressures: Array) -> dict[str, tuple[int, int]]:
    """Return the names of active limits, with channel and side (-1: lower, 1: upper)."""
    lower, upper = task.pressure_bounds(robot.description)
    found = {}
    for index in range(robot.n_pressures):
        name = robot.description.channel_name(index)
        if pressures[index] >= upper[index] - ANSWER.at_limit:
            found[f"{name} max"] = (index, 1)
        elif pressures[index] <= lower[index] + ANSWER.at_limit:
            found[f"{name} min"] = (index, -1)
    return found
