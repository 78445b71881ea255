"""Call Newton's method for contacts in machine code, see ``native/contact.c``."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import Any

import numpy as np

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.compiled import Library
from stiffopt.model.contact.rod import Rod, RodNodes, RodSections, RodShape
from stiffopt.model.contact.surface import ContactSurface, SurfacePoint
from stiffopt.model.contact.system import ContactRow, Contacts

MOST_CONTACTS = 24
"""Largest number of contacts, as in contact.c."""
CONVERGED, LOST, REMESH = range(3)
"""Outcomes, as in contact.c."""

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Surface(ctypes.Structure):
    """Structure `Surface` of contact.c."""

    _fields_ = [
        *((name, _pointer) for name in ("distance", "formula")),
        ("pieces", _integer),
        ("size", _integer),
        ("parameters", _pointer),
        ("softness", _double),
    ]


class _Touch(ctypes.Structure):
    """Structure `Touch` of contact.c."""

    _fields_ = [
        *((name, _integer) for name in ("surface", "pinned", "segment", "rigid", "node")),
        *((name, _double) for name in ("start", "end", "station")),
        ("force", _double * 3),
        *((name, _double) for name in ("normal_force", "distance")),
        ("normal", _double * 3),
        ("curvature", _double * 9),
        ("gap", _double),
        ("mean", _double * 3),
        ("slope", _double),
    ]


_ARRAYS = (
    *("segment", "rigid", "per_station", "longest", "strain", "compliance", "radius", "weight"),
    *("centroid", "retreat"),
)
_RESULTS = {"at": 1, "q": 4, "m": 3, "position": 3, "force_far": 3, "moment_far": 3}
_RESULTS_OF_STEPS = {"J": 90, "near": 3, "far": 3}


class _Problem(ctypes.Structure):
    """Structure `Problem` of contact.c."""

    _fields_ = [
        ("steps", _integer),
        ("contacts", _integer),
        *((name, _pointer) for name in _ARRAYS),
        ("length", _double),
        ("dead", _double * 6),
        ("follower", _double * 6),
        ("tip_load", _double * 3),
        ("surfaces", _pointer),
        ("touches", _pointer),
        *((name, _pointer) for name in (*_RESULTS, *_RESULTS_OF_STEPS)),
    ]


_FUNCTIONS = {
    "stiffopt_contact_correct": (_integer, [_pointer]),
    "stiffopt_contact_is_stable": (_integer, [_pointer] * 3),
    "stiffopt_contact_tangent": (_integer, [_pointer] * 2),
    "stiffopt_contact_body": (None, [_pointer, _integer, *[_pointer] * 3]),
    "stiffopt_contact_between": (
        None,
        [_pointer, _pointer, _integer, _pointer, _integer, _pointer, _pointer],
    ),
    "stiffopt_contact_distances": (None, [_pointer, _integer, *[_pointer] * 2]),
}


class NativeContacts:
    """Newton's method for one arm among surfaces, in machine code.

    Attributes
    ----------
    code : with the functions of `stiffopt.model.contact.steps`.
    """

    def __init__(self, code: Library, rod: Rod, surfaces: tuple[ContactSurface, ...]) -> None:
        self._rod, self.code = rod, code
        size = code.cdll.stiffopt_contact_sizes
        size.argtypes, size.restype = [_integer], _integer
        for which, kind in enumerate((_Surface, _Touch, _Problem)):
            if size(which) != ctypes.sizeof(kind):
                raise RuntimeError("native/contact.c and this file disagree on their interface")
        self._cdll = code.cdll
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(code.cdll, name)
            function.argtypes, function.restype = arguments, result
        self._keep = [*(each.pieces for each in surfaces)]
        self._surfaces = (_Surface * max(1, len(surfaces)))()
        for own, each in zip(self._surfaces, surfaces, strict=False):
            for name, function in (("distance", "surface_distance"), ("formula", "surface")):
                address = ctypes.cast(getattr(code.cdll, f"{function}_{each.key}"), _pointer)
                setattr(own, name, address.value)
            own.pieces, own.size = each.pieces.shape
            own.parameters, own.softness = each.pieces.ctypes.data, each.softness

    def correct(
        self, state: Contacts, sections: RodSections
    ) -> tuple[int, Contacts, NativeShape, list[ContactRow]]:
        """Return the outcome, the new state, its shape, and its contacts."""
        rod, mesh, condition = self._rod, state.mesh, state.condition
        count = len(mesh.segment)
        inputs = (
            mesh.segment, mesh.rigid, mesh.per_station, rod.longest, sections.strain,
            sections.compliance, sections.radius, sections.weight, rod.centroid, condition.retreat,
        )  # fmt: skip
        memory = np.empty((count + 1) * 17 + count * 96)
        results, place, address = {}, 0, memory.ctypes.data
        touches = (_Touch * max(1, len(state.touches)))()
        for own, touch, node in zip(touches, state.touches, mesh.node.tolist(), strict=False):
            here = rod.ranges[touch.range]
            own.surface, own.pinned, own.node = touch.surface, touch.pinned, node
            own.segment, own.rigid, own.start, own.end = (
                here.segment, here.rigid, here.start, here.end,
            )  # fmt: skip
            own.station, own.normal_force = touch.station, touch.normal_force
            own.force[:] = touch.force.tolist()
        problem = _Problem(
            steps=count, contacts=len(state.touches), length=rod.arm.length,
            surfaces=ctypes.addressof(self._surfaces), touches=ctypes.addressof(touches),
        )  # fmt: skip
        for name, array in zip(_ARRAYS, inputs, strict=True):
            setattr(problem, name, array.ctypes.data)
        for length, sizes in ((count + 1, _RESULTS), (count, _RESULTS_OF_STEPS)):
            for name, size in sizes.items():
                setattr(problem, name, address + 8 * place)
                results[name] = memory[place : place + length * size].reshape(length, size)
                place += length * size
        at = results["at"][:, 0]
        at[:], results["q"][:], results["m"][:] = mesh.at, *state.nodes
        problem.dead[:], problem.follower[:] = condition.dead.tolist(), condition.follower.tolist()
        problem.tip_load[:] = (rod.arm.description.tip_mass * condition.gravity).tolist()
        outcome = self._cdll.stiffopt_contact_correct(ctypes.addressof(problem))
        moved = [
            replace(old, force=np.array(new.force), normal_force=new.normal_force,
                    station=new.station)
            for old, new in zip(state.touches, touches, strict=False)
        ]  # fmt: skip
        rows = [
            ContactRow(
                SurfacePoint(
                    new.distance, np.array(new.normal), np.array(new.curvature).reshape(3, 3)
                ),
                float(sections.radius[new.segment]), new.gap, np.array(new.mean), new.slope,
            )
            for new in touches[: len(moved)]
        ]  # fmt: skip
        shape = NativeShape(self._cdll, problem, (*inputs, touches, self._surfaces))
        shape.mesh, shape.sections = mesh._replace(at=at), sections
        shape.nodes = RodNodes(results["q"], results["m"])
        shape.h = at[:-1] - at[1:]
        shape.J = results["J"].reshape(count, 10, 9).swapaxes(1, 2)
        for name in ("near", "far", "position", "force_far", "moment_far"):
            setattr(shape, name, results[name])
        return outcome, Contacts(condition, shape.mesh, shape.nodes, tuple(moved)), shape, rows

    def distances(self, surface: int, points: Array) -> Array:
        """Return the distances (k,) of points (k, 3) from a surface, in m."""
        points, found = np.ascontiguousarray(points), np.empty(len(points))
        address = ctypes.addressof(self._surfaces[surface])
        self._cdll.stiffopt_contact_distances(
            address, len(points), points.ctypes.data, found.ctypes.data
        )
        return found


class NativeShape(RodShape):
    """A shape whose numbers are in the memory of a problem of contact.c."""

    is_native = True

    def __init__(self, cdll: Any, problem: _Problem, keep: tuple[Any, ...]) -> None:
        self._cdll, self._problem, self._keep = cdll, problem, keep

    def body(self, at: Array) -> tuple[Array, Array]:
        """See `RodShape.body`."""
        at, points, radii = np.ascontiguousarray(at), np.empty((len(at), 3)), np.empty(len(at))
        self._cdll.stiffopt_contact_body(
            ctypes.addressof(self._problem), len(at), *(x.ctypes.data for x in (at, points, radii))
        )
        return points, radii

    def between(self, other: RodShape, shares: Array, at: Array) -> Array:
        """See `RodShape.between`; turns and ways from node to node change evenly."""
        if not isinstance(other, NativeShape):
            return super().between(other, shares, at)
        found = np.empty((len(shares), len(at), 3))
        self._cdll.stiffopt_contact_between(
            ctypes.addressof(self._problem), ctypes.addressof(other._problem),
            len(shares), shares.ctypes.data, len(at), at.ctypes.data, found.ctypes.data,
        )  # fmt: skip
        return found

    def is_stable(self) -> bool:
        """See `RodShape.is_stable`."""
        count = len(self.h)
        memory = np.empty((6 * count + 6) ** 2 + 72 * count)
        starts = memory.ctypes.data + 8 * (6 * count + 6) ** 2
        return bool(
            self._cdll.stiffopt_contact_is_stable(
                ctypes.addressof(self._problem), memory.ctypes.data, starts
            )
        )

    def tangent(self) -> Array:
        """See `RodShape.tangent`."""
        found = np.empty((6 + self._problem.contacts, 6))
        address = ctypes.addressof(self._problem)
        if not self._cdll.stiffopt_contact_tangent(address, found.ctypes.data):
            raise EquilibriumError("the tip moves freely there")
        return found
