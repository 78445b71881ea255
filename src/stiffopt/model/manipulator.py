"""`Manipulator`: pose, Jacobian, compliance and stiffness of an arm, single and batched."""

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, TypeGuard, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from stiffopt import lie
from stiffopt.arrays import Array
from stiffopt.errors import InputError, shown
from stiffopt.model.arguments import (
    DirectionalMeasure,
    check_choice,
    checked_integer,
    checked_measure,
)
from stiffopt.model.arm import Arm, Values
from stiffopt.model.arm_clearance import ArmClearance, Clearances
from stiffopt.model.body_symbols import Along, body_function
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.contact.equilibrium import (
    Approach,
    ContactEquilibrium,
    contact_equilibrium,
)
from stiffopt.model.description import RobotDescription
from stiffopt.model.equilibrium import dead_and_follower
from stiffopt.model.history import NO_HISTORY
from stiffopt.model.robot_files import load_description
from stiffopt.model.scene import Scene
from stiffopt.model.screws import Twist, Wrench, checked_wrench
from stiffopt.model.segment import Compensation
from stiffopt.model.shape import stiffness_along
from stiffopt.model.uncertainty import TipUncertainty, Uncertainty
from stiffopt.notebook import ShownInNotebook

Method = Literal["equilibrium", "first-order", "elementwise"]

_ELEMENTS_PER_SEGMENT = 64  # of eq. 19


class Manipulator(Arm, ShownInNotebook):
    """An arm as functions of its channel pressures, in SI units.

    Pressures p are (n,) or, for a batch, (N, n) gauge pressures in Pa, proximal segment first; a
    batch gives results with a leading axis N.  Without gravity and load everything is in closed
    form (eqs 5-17).  With gravity or a tip load every quantity is that of the loaded arm: its
    static equilibrium reached continuously from rest, and the tangent compliance there.

    Parameters
    ----------
    description : RobotDescription
        The arm.
    force, moment : array_like, optional
        Load (3,) at the tip, in N and N m.
    load_frame : {"base", "tip"}
        Whether the load keeps its direction in space, or follows the tip.
    resolution : int
        Multiplies the integration steps of the equilibrium; 1 is exact to a few micrometres.

    Raises
    ------
    PressureError
        If the strain law breaks down within the robot's own pressure limits.  Every method
        raises it too, for pressures that are not finite, of another shape, or beyond the law.
    EquilibriumError
        Raised by every method where the loaded arm buckles or falls over.
    """

    # -- shape ------------------------------------------------------------------------------

    def tip_pose(self, p: ArrayLike) -> Array:
        """Return the pose of the tip in the base frame (eq. 7), (4, 4) or (N, 4, 4)."""
        if not self.is_loaded:
            return self._checked_tip(lambda q: self._tip.evaluate("tip_pose", q), p)
        return self._evaluate("pose", lambda tip: tip.transform, p)

    def tip_jacobian(self, p: ArrayLike) -> Array:
        """Return the tip's twist in tip axes per pressure, (6, n): in m/Pa, then in rad/Pa."""
        if not self.is_loaded:
            return self._checked_tip(lambda q: self._tip.evaluate("tip_jacobian", q), p)
        return self._evaluate("jacobian", lambda tip: tip.jacobian, p)

    def tip_jacobian_derivative(self, p: ArrayLike) -> Array:
        """Return the derivative of `tip_jacobian` by the pressures, (6, n, n), on the last axis.

        With the paper's compensation it does not exist at exactly p = 0, where the norm of the
        pressures has a kink; there the value is that of the rounded norm.
        """
        n = self.n_pressures
        flat = self._evaluate(
            "jacobian derivative", lambda tip: tip.total_jacobian(ca.vec(tip.jacobian)), p
        )
        return np.swapaxes(flat.reshape(*flat.shape[:-2], n, 6, n), -3, -2)

    def backbone(self, p: ArrayLike, n: int = 50) -> Array:
        """Return poses (n, 4, 4) along the arm, equally spaced at rest from base to tip."""
        n = checked_integer("n, the number of poses of a backbone,", n, 2)
        stations = self.kept(("backbone", n), lambda: np.linspace(0.0, self.length, n))
        return self._at_stations(self._body.poses, p, stations)

    def pose(self, p: ArrayLike, at: ArrayLike) -> Array:
        """Return the pose (4, 4) or (N, 4, 4) at arc length `at` (m, at rest), above 0.

        Several arc lengths (k,) give poses (k, 4, 4) or (N, k, 4, 4).
        """
        return self._at_stations(self._body.poses, p, self._arc_lengths(at))

    def body_jacobian(self, p: ArrayLike, at: ArrayLike) -> Array:
        """Return the twist of a station in its own axes per pressure, (6, n) or (N, 6, n).

        Linear first: three rows in m/Pa, then three in rad/Pa.  `at` is an arc length in m at rest,
        from 0 at the base; several (k,) give (k, 6, n) or (N, k, 6, n).  Under loads it is that of
        the equilibrium.
        """
        return self._at_stations(self._body.jacobians, p, self._arc_lengths(at, base_too=True))

    def body_radius(self, p: ArrayLike, at: ArrayLike) -> Any:
        """Return the outer radius in m of the pressurised section at arc length `at` (m, at rest).

        The strain laws `neo-hookean` and `fibres` have ``r lambda^-1/2`` (see `NeoHookeanLaw`), the
        linear ones the radius at rest; a rigid connector is as wide as the segment before it.  The
        effect of loads on the section is neglected.

        Returns
        -------
        float or ndarray (N,), and with arc lengths (k,) (k,) or (N, k)
        """
        found = self._at_stations(self._body.radii, p, self._arc_lengths(at, base_too=True))
        return float(found) if found.ndim == 0 else found

    # -- clearance --------------------------------------------------------------------------

    def clearance(self, p: ArrayLike, scene: Scene) -> Any:
        """Return the least distance in m between the body and a scene's objects; negative inside.

        The body is the union of spheres of the outer radius about the centre line, from base to
        tip; the least distance along it is exact to 0.004 mm.

        Returns
        -------
        float or ndarray (N,)
        """
        values = self._checked(p)
        found = ArmClearance(self, _checked_scene(scene)).least(np.atleast_2d(values))
        return float(found[0]) if values.ndim == 1 else found

    def clearances(self, p: ArrayLike, scene: Scene) -> Clearances:
        """Return each object's least distance, its place, and its slopes by the pressures."""
        values = self._checked(p)
        found = ArmClearance(self, _checked_scene(scene)).each(np.atleast_2d(values))
        return found.only() if values.ndim == 1 else found

    # -- contact ----------------------------------------------------------------------------

    def contact_equilibrium(
        self,
        p: ArrayLike,
        scene: Scene,
        load: ArrayLike | Wrench | None = None,
        approach: Approach = "pressures",
        nearby: ContactEquilibrium | None = None,
    ) -> ContactEquilibrium:
        """Return the equilibrium of the arm in contact with the objects that allow it.

        Surfaces only push, along their normals; the body is that of `clearance`. Objects that allow
        no contact are ignored: see `clearances`.

        Parameters
        ----------
        p : (n,)
            Pressures in Pa.
        scene : Scene
        load : (6,), optional
            A further dead force and moment at the tip, in base axes, in N and N m.
        approach : {"pressures", "objects"}
            How the equilibrium is reached from rest, which selects one if there are several.
            "pressures": pressures and loads grow together with the objects in place.  "objects":
            the objects come, each along its normals, to the arm under full pressure and load.
        nearby : ContactEquilibrium, optional
            Equilibrium of the same arm and scene from which to start instead, along the straight
            line.

        Raises
        ------
        EquilibriumError
            If none is reached continuously: the arm slips off an object, snaps or buckles on the
            way. The message says where.
        """
        return contact_equilibrium(self, p, _checked_scene(scene), load, approach, nearby)

    # -- compliance -------------------------------------------------------------------------

    def tip_compliance(self, p: ArrayLike) -> Array:
        """Return the tip's compliance in tip axes (eq. 17, or tangent), (6, 6), linear first."""
        return self._compliance(p, None)

    def _compliance(self, p: ArrayLike, at: float | None) -> Array:
        if not self.is_loaded and at is None:
            return self._checked_tip(lambda q: self._tip.evaluate("tip_compliance", q), p)
        C = self._evaluate("compliance", lambda point: point.compliance, p, at=at)
        if self.is_loaded and self._loads.are_conservative:
            # symmetric up to the integrator's error of about 1e-6
            C = (C + np.swapaxes(C, -1, -2)) / 2
        return C

    def compliance(self, p: ArrayLike, at: float) -> Array:
        """Return the compliance (6, 6) at arc length `at` (m, at rest), in that point's axes."""
        return self._compliance(p, self._station(self._arc_length(at)))

    def compliance_between(self, p: ArrayLike, s: ArrayLike, t: ArrayLike) -> Array:
        """Return the twist at s per wrench at t, (6, 6) or (N, 6, 6), in base axes.

        The twist is the motion of the centre of the section at s, and its rotation; the wrench is a
        dead force on the centre of the section at t and a dead moment.  Arc lengths are in m at
        rest, from 0 at the base; arrays (k,) give (k, 6, 6) or (N, k, 6, 6).  Free arms: eq. 17,
        between two points.  Under loads: the tangent about the equilibrium, with the geometric
        stiffness of the loads; ``C(s, t) = C(t, s)'`` if all loads are dead forces.
        """
        first, second = self._arc_lengths(s, True), self._arc_lengths(t, True)
        try:
            first, second = np.broadcast_arrays(first, second)
        except ValueError:
            raise InputError(
                f"s and t must be single arc lengths or equally many; got {len(first)} and "
                f"{len(second)}"
            ) from None
        ends = np.atleast_1d(second)
        return self._at_stations(lambda q, at: self._body.compliances(q, at, ends), p, first)

    def body_function(self, name: Along, *at: float) -> ca.Function:
        """Return a CasADi function of one or two stations, for a user's own optimisation.

        Parameters
        ----------
        name : {"pose", "body_jacobian", "compliance_between"}
            The method whose result the function returns, as a matrix.
        at : float
            Arc length in m at rest, above 0; for "compliance_between" two, s and t.

        Returns
        -------
        casadi.Function
            Of the pressures p (n,) in Pa.  With gravity or a load it is a function of p and the
            tip's quaternion q (4,), w first, and has a second output, `residual` (3,), which is
            zero only in equilibrium.  Treat q as another variable (of any length but 0; start at
            the quaternion of `tip_pose`) and ``residual == 0`` as a constraint.  All outputs can be
            differentiated; Jacobians and compliances are valid where the residual is zero.
        """
        check_choice("name", name, get_args(Along))
        wanted = 2 if name == "compliance_between" else 1
        if len(at) != wanted:
            raise InputError(f"{name} takes {wanted} arc length{'s'[: wanted - 1]}; got {len(at)}")
        return body_function(self, name, tuple(self._arc_length(each) for each in at))

    def stiffness(
        self,
        p: ArrayLike,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
        at: float | None = None,
        quick: bool = False,
    ) -> Any:
        """Return the stiffness along a direction (N/m), or for a rotation about it (N m/rad).

        Parameters
        ----------
        p : (n,) or (N, n)
            Pressures in Pa.
        direction : (3,) or (k, 3)
            Need not be of unit length; in the axes that `frame` names.
        kind : {"translation", "rotation"}
        boundary : {"free", "guided", "clamped"}
            ``1 / (d'C_vv d)``; ``d'C_vv^-1 d``; ``d'(C^-1)_vv d``.
        frame : {"base", "tip"}
        at : float, optional
            Arc length of another point than the tip, in m at rest; "tip" then means its axes.
        quick : bool
            Stiffness against a push, such as a probe's, that is too quick for the arm's creep and
            too small for its hysteresis, so that both resist it (`History.quick_share`).  Only
            without gravity and load.

        Returns
        -------
        float or ndarray (N,), and with k directions (k,) or (N, k)
        """
        if quick:
            return self._quick().stiffness(p, direction, kind, boundary, frame, at)
        at = self._station(at)
        if _is_table(direction):
            each = [self.stiffness(p, row, kind, boundary, frame, at) for row in direction]
            return np.stack(each, axis=-1)
        measure = _measure(direction, kind, boundary, frame)
        if self.is_loaded or at is not None:
            values = self._evaluate(("stiffness", measure), _stiffness_of(measure), p, at=at)
        else:
            values = self._checked_tip(lambda q: self._tip.stiffness(q, measure), p)
        result = values[..., 0, 0]
        return float(result) if result.ndim == 0 else result

    def _quick(self) -> "Manipulator":
        """Return the free arm with the additional stiffness of its history."""
        if self.is_loaded:
            raise InputError(
                "the stiffness against quick pushes is for an arm without gravity and load"
            )
        return self.kept("quick", lambda: Manipulator(quick_description(self.description)))

    def stiffness_gradient(
        self,
        p: ArrayLike,
        direction: ArrayLike,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
    ) -> Array:
        """Return the derivative of `stiffness` at the tip by the pressures, (n,) or (N, n)."""
        measure = _measure(direction, kind, boundary, frame)
        if not self.is_loaded:
            gradient = self._checked_tip(lambda q: self._tip.stiffness_gradient(q, measure), p)
            return gradient[..., 0, :]
        stiffness = _stiffness_of(measure)
        return self._evaluate(
            ("stiffness gradient", measure), lambda tip: tip.total_jacobian(stiffness(tip)), p
        )[..., 0, :]

    def tip_uncertainty(
        self, p: ArrayLike, *, moving: bool = False, held: float | None = None
    ) -> TipUncertainty:
        """Return the uncertainty of the tip and its stiffness after a calibration.

        Parameters
        ----------
        p : commanded pressures (n,) in Pa; earlier commands are unknown.
        moving : whether the pressures change, as in the recordings, or are held.
        held : for how long they have been held, in s, if known: where the model has creep, the tip
            comes nearer to the equilibrium with time.

        Raises
        ------
        InputError
            The robot was not calibrated, or `held` is not a time of held pressures.
        """
        p = self._single(p)
        known = self.kept(
            ("uncertainty", self.tip_load), lambda: Uncertainty(self.description, self.tip_load)
        )
        return known.at(p, moving=moving, held=held)

    # -- screws and loads -------------------------------------------------------------------

    def tip_twist(self, p: ArrayLike, channel: int) -> Twist:
        """Return the screw of the tip per Pa in a channel (counted from 0), in tip axes."""
        channel = checked_integer("channel", channel, 0)
        if channel >= self.n_pressures:
            raise InputError(
                f"channel must be between 0 and {self.n_pressures - 1}; got {channel!r}"
            )
        return Twist(self.tip_jacobian(self._single(p))[:, channel])

    def deflection(self, p: ArrayLike, wrench: ArrayLike | Wrench, frame: Frame = "base") -> Twist:
        """Return the screw of the tip's first-order motion under a wrench (eq. 17), in tip axes.

        The wrench (6,) acts at the tip; `frame` names the axes of its components.
        """
        p = self._single(p)
        local = _in_local_axes(wrench, self.tip_pose(p), frame)
        return Twist(self.tip_compliance(p) @ local)

    def internal_wrench(
        self, p: ArrayLike, wrench: ArrayLike | Wrench, at: float, frame: Frame = "base"
    ) -> Wrench:
        """Return the wrench in the section at `at` due to one at the tip (eq. 11), in its axes."""
        p, at = self._single(p), self._arc_length(at, base_too=True)
        T_tip = self.tip_pose(p)
        local = _in_local_axes(wrench, T_tip, frame)
        T_at = self._body.poses(p[np.newaxis], np.array([at]))[0, 0]
        return Wrench(local).transformed(lie.inverse(T_at) @ T_tip)

    def loaded_tip_pose(
        self,
        p: ArrayLike,
        wrench: ArrayLike | Wrench,
        at: float | None = None,
        frame: Frame = "base",
        method: Method = "equilibrium",
    ) -> Array:
        """Return the pose (4, 4) of the tip with one more load on the arm.

        Parameters
        ----------
        p : (n,)
            Pressures in Pa.
        wrench : (6,)
            Force and moment at the loaded point, in N and N m.
        at : float, optional
            Arc length of the loaded point in m at rest; default: the tip.
        frame : {"base", "tip"}
            Axes of the wrench: the base's (a dead load) or the loaded point's own (a follower
            load).
        method : {"equilibrium", "first-order", "elementwise"}
            "equilibrium" is exact.  The others are the paper's, about the shape without this load.
            "first-order" (eq. 18): the loaded point moves by ``exp(C W)`` and everything beyond it
            rigidly.  "elementwise" (eq. 19): each element of the arm deforms under its own share of
            the wrench.
        """
        p, at = self._single(p), self._station(at)
        check_choice("frame", frame, get_args(Frame))
        if method == "equilibrium":
            return self._loaded_equilibrium(p, checked_wrench(wrench), at, frame)
        T_at = self.tip_pose(p) if at is None else self.pose(p, at)
        local = _in_local_axes(wrench, T_at, frame)
        if method == "first-order":
            C = self.tip_compliance(p) if at is None else self.compliance(p, at)
            return T_at @ lie.exp(C @ local) @ lie.inverse(T_at) @ self.tip_pose(p)
        if method == "elementwise":
            if self.is_loaded:
                raise InputError(
                    "method 'elementwise' (eq. 19) is for the arm without gravity and load: its "
                    "elements have no geometric stiffness; use 'first-order' or 'equilibrium'"
                )
            return self._elementwise(p, local, self.length if at is None else at)
        raise InputError(
            f"unknown method {method!r}; choose 'equilibrium', 'first-order' or 'elementwise'"
        )

    def _loaded_equilibrium(self, p: Array, wrench: Array, at: float | None, frame: Frame) -> Array:
        loads = self._loads._replace(station=dead_and_follower(wrench, frame))
        equilibrium = self._equilibrium(at)
        (tip,) = equilibrium.shape(equilibrium.settle(p, loads), np.array([self.length]))
        return np.asarray(tip)

    def _elementwise(self, p: Array, local: Array, at: float) -> Array:
        """Evaluate eq. 19, with wrench and compliance taken at the middle of each element."""
        ends = [0.0]
        soft: list[int | None] = []
        for index, segment in enumerate(self.description.segments):
            start = ends[-1]
            cuts = start + np.linspace(0.0, segment.length, _ELEMENTS_PER_SEGMENT + 1)[1:]
            if start < at < cuts[-1]:
                cuts = np.union1d(cuts, at)  # no element spans the load
            ends.extend(cuts)
            soft.extend([index] * len(cuts))
            if segment.connector:
                ends.append(start + segment.length + segment.connector)
                soft.append(None)
        marks = np.array(ends)
        middles = (marks[1:] + marks[:-1]) / 2
        poses = self._body.poses(p[np.newaxis], np.concatenate([marks, middles, [at]]))[0]
        T_end, T_middle, T_at = poses[: len(marks)], poses[len(marks) : -1], poses[-1]
        compliances = [part.full() for part in self._section_parts(p)[self.n_segments :]]
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


def quick_description(description: RobotDescription) -> RobotDescription:
    """Return a robot with the stiffness against a quick small push, and the same free shapes."""
    segments = []
    for segment, most in zip(description.segments, description.highest_norms, strict=True):
        history, given = segment.history or NO_HISTORY, segment.compensation or Compensation()
        update = {
            "stiffness": given.stiffness / history.quick_share,
            "softening": history.quick_softening(given.softening, most),
        }
        stiffer = given.model_copy(update=update)
        segments.append(segment.model_copy(update={"compensation": stiffer, "history": None}))
    return description.model_copy(update={"segments": tuple(segments)})


def load_robot(
    name_or_path: str | os.PathLike[str] | RobotDescription, *, resolution: int = 1
) -> Manipulator:
    """Load a built-in robot (``"stiff-flop-2"``), a robot file or a description."""
    if isinstance(name_or_path, RobotDescription):
        return Manipulator(name_or_path, resolution=resolution)
    return Manipulator(load_description(name_or_path), resolution=resolution)


def _checked_scene(scene: Scene) -> Scene:
    if not isinstance(scene, Scene):
        raise InputError(f"expected a Scene, as load_scene returns it, not {shown(scene)}")
    return scene


def _is_table(direction: ArrayLike) -> TypeGuard[Sequence[ArrayLike]]:
    """Return whether several directions are given, at least one."""
    if isinstance(direction, list | tuple) and direction and isinstance(direction[0], float | int):
        return False  # shortcut for the usual case
    try:
        shape = np.shape(direction)
    except ValueError:  # rows of different lengths
        return False
    return len(shape) == 2 and shape[0] > 0


def _measure(
    direction: ArrayLike, kind: Kind, boundary: Boundary, frame: Frame
) -> DirectionalMeasure:
    """Check a directional stiffness; checked ones are cached."""
    values = direction.tolist() if isinstance(direction, np.ndarray) else direction
    if isinstance(values, list | tuple) and all(type(value) in (float, int) for value in values):
        try:
            return _cached_measure(tuple(values), kind, boundary, frame)
        except TypeError:  # an invalid argument that cannot be hashed
            pass
    return checked_measure(direction, kind, boundary, frame)


_cached_measure = lru_cache(maxsize=256)(checked_measure)


def _stiffness_of(measure: DirectionalMeasure) -> Values:
    direction, kind, boundary, frame = measure
    return lambda shape: stiffness_along(shape, ca.DM(direction), frame, kind, boundary)


def _in_local_axes(wrench: "ArrayLike | Wrench", T: Array, frame: Frame) -> Array:
    """Return a wrench (6,) in the axes of the pose T at which it acts."""
    check_choice("frame", frame, get_args(Frame))
    values = checked_wrench(wrench)
    return values if frame == "tip" else np.asarray(lie.rotate_blocks(T[:3, :3].T) @ values)
