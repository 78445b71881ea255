"""Call Newton's method for contacts in machine code, see ``native/contact.c``."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.model.compiled import Library
from stiffopt.model.contact.rod import Rod, RodNodes, RodSections, RodShape
from stiffopt.model.contact.surface import ContactSurface, SurfacePoint
from stiffopt.model.contact.system import ContactRow, Contacts

Vector = NDArray[np.float64]

MOST_CONTACTS = 8
"""Largest number of contacts, as in contact.c."""
CONVERGED, LOST, REMESH = range(3)
"""Outcomes, as in contact.c."""

_integer, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Surface(ctypes.Structure):
    """Structure `Surface` of contact.c."""

    _fields_ = [
        ("formula", _pointer),
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
_RESULTS = ("at", "q", "m", "J", "near", "far", "position", "force_far", "moment_far")


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
        *((name, _pointer) for name in _RESULTS),
    ]


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
        self._correct = code.cdll.stiffopt_contact_correct
        self._correct.argtypes, self._correct.restype = [_pointer], _integer
        self._is_stable = code.cdll.stiffopt_contact_is_stable
        self._is_stable.argtypes = [_pointer, _pointer, _pointer]
        self._is_stable.restype = _integer
        self._keep = [*(each.pieces for each in surfaces)]
        self._surfaces = (_Surface * max(1, len(surfaces)))()
        for own, each in zip(self._surfaces, surfaces, strict=False):
            function = getattr(code.cdll, f"surface_{each.key}")
            own.formula = ctypes.cast(function, _pointer).value
            own.pieces, own.size = each.pieces.shape
            own.parameters, own.softness = each.pieces.ctypes.data, each.softness

    def correct(
        self, state: Contacts, sections: RodSections
    ) -> tuple[int, Contacts, RodShape, list[ContactRow], bool]:
        """Return the outcome, the new state, its shape, its contacts, and whether it is stable.

        Stability is valid only for loads that have a potential.
        """
        rod, mesh, condition = self._rod, state.mesh, state.condition
        count = len(mesh.segment)
        longest = np.where(mesh.rigid, np.inf, rod.longest[mesh.segment])
        inputs: dict[str, Any] = {
            "segment": mesh.segment, "rigid": mesh.rigid.astype(np.int64),
            "per_station": np.ascontiguousarray(mesh.per_station), "longest": longest,
            "strain": np.ascontiguousarray(sections.strain), "compliance": sections.compliance,
            "radius": sections.radius, "weight": sections.weight, "centroid": rod.centroid,
            "retreat": condition.retreat,
        }  # fmt: skip
        found: dict[str, Vector] = {
            "at": mesh.at.copy(), "q": state.nodes.quaternion.copy(),
            "m": state.nodes.moment.copy(), "J": np.empty((count, 10, 9)),
            "near": np.empty((count, 3)), "far": np.empty((count, 3)),
            **{name: np.empty((count + 1, 3)) for name in _RESULTS[6:]},
        }  # fmt: skip
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
            **{name: array.ctypes.data for name, array in {**inputs, **found}.items()},
        )  # fmt: skip
        problem.dead[:], problem.follower[:] = condition.dead.tolist(), condition.follower.tolist()
        problem.tip_load[:] = (rod.arm.description.tip_mass * condition.gravity).tolist()
        outcome = self._correct(ctypes.addressof(problem))
        stable = False
        if outcome == CONVERGED:
            memory = np.empty((6 * count + 6) ** 2 + 72 * count)
            starts = memory.ctypes.data + 8 * (6 * count + 6) ** 2
            stable = bool(self._is_stable(ctypes.addressof(problem), memory.ctypes.data, starts))
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
        nodes = RodNodes(found["q"], found["m"])
        mesh = mesh._replace(at=found["at"])
        shape = RodShape()
        shape.mesh, shape.nodes, shape.sections = mesh, nodes, sections
        shape.h, shape.J = mesh.at[:-1] - mesh.at[1:], found["J"].swapaxes(1, 2)
        for name in ("near", "far", "position", "force_far", "moment_far"):
            setattr(shape, name, found[name])
        return outcome, Contacts(condition, mesh, nodes, tuple(moved)), shape, rows, stable
