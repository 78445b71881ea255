"""Poses, Jacobians, compliances and radii of stations along an arm, free or loaded.

They are computed by machine code (``native/body.h``) if there is any, otherwise by
`stiffopt.model.stations`.

The compliance between two stations is the twist at s per wrench at t, both in base axes.  For a
free arm it is ``X_s A(min(s, t)) X_t'`` with X the adjoint from the base to a station and ``A(m) =
int_0^m Ad_T C Ad_T' du`` (eq. 17, about the base).  For a loaded arm it follows from the rod's
equations, linearised about the equilibrium.  Their solutions are spanned by those propagated from
the tip, for three turns of it and a wrench on it.  A wrench at t is a combination of these from t
towards the base, plus a turn of the tip that keeps the base fixed.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import EquilibriumError
from stiffopt.model.batch import in_parallel
from stiffopt.model.body_functions import free_body_functions, loaded_body_functions, strain_rows
from stiffopt.model.compiled import Library, checkpoint, library
from stiffopt.model.compiler import NATIVE
from stiffopt.model.layout import Layout
from stiffopt.model.loaded_arm import LoadedArm
from stiffopt.model.rod import rod_functions
from stiffopt.model.stations import FreeStations, LoadedStations, Pieces, response

if TYPE_CHECKING:
    from stiffopt.model.arm import Arm


LOOKED_UP_FROM = 8
"""Number of poses of one arm after which machine code is used, if it is in the cache."""

COMPILED_FREE_FROM, COMPILED_LOADED_FROM = 2000, 64
"""Number of poses after which machine code is made; these take about a second in the VM."""

_LOOKED_FOR_AGAIN = 32  # poses between looks at the cache, while code is being made

_CHUNK = 16  # poses that a thread takes at a time
_KEPT = 16  # numbers of stations for which memory is kept
_POSES, _JACOBIANS, _RESPONSES, _LINE = range(4)  # as in body.c

_integer, _pointer = ctypes.c_int64, ctypes.c_void_p


class BodyShape:
    """Poses, Jacobians, compliances and radii of stations along one arm under its own loads.

    Pressures are of shape (N, n), in Pa and finite; arc lengths (k,) from 0 to the arm's length.
    Methods raise `PressureError` beyond a strain law and `EquilibriumError` where the loaded arm
    has no stable equilibrium that is reached from rest.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._pieces = Pieces(arm)
        self._stations = LoadedStations(arm) if arm.is_loaded else FreeStations(arm, self._pieces)
        self._native: NativeBody | None = None
        self._count, self._next_look = 0, LOOKED_UP_FROM
        self._lock = threading.Lock()

    def poses(self, p: Array, at: Array) -> Array:
        """Return poses (N, k, 4, 4) in the base frame."""
        return self._evaluate(_POSES, p, at).reshape(len(p), len(at), 4, 4)

    def jacobians(self, p: Array, at: Array) -> Array:
        """Return twists per Pa (N, k, 6, n), each in the axes of its station."""
        return self._evaluate(_JACOBIANS, p, at).reshape(len(p), len(at), 6, p.shape[1])

    def line(self, p: Array, at: Array) -> Array:
        """Return positions, unit tangents of the centre line and outer radii, (N, k, 7)."""
        return self._evaluate(_LINE, p, at).reshape(len(p), len(at), 7)

    def compliances(self, p: Array, s: Array, t: Array) -> Array:
        """Return twists at s (k,) per wrench at t (k,), (N, k, 6, 6), in base axes."""
        at, place = np.unique(np.concatenate([[0.0], s, t]), return_inverse=True)
        first, second = place[1 : 1 + len(s)], place[1 + len(s) :]
        if isinstance(self._stations, FreeStations):
            self._arm._check_margin(p, "")
            native = self.machine_code(len(p))
            function = native.code.function if native else self._stations.interpreted
            return self._stations.compliances(function, p, at, first, second)
        found = self._evaluate(_RESPONSES, p, at)
        carried = found[:, :-27].reshape(len(p), len(at), 3, 3, 9)
        return response(carried, found[:, -27:].reshape(-1, 9, 3).swapaxes(1, 2), first, second)

    def radii(self, p: Array, at: Array) -> Array:
        """Return outer radii (N, k) of the free sections, in m."""
        self._arm._check_margin(p, "")
        return self._radii(p, at)

    def _radii(self, p: Array, at: Array) -> Array:
        piece, _ = self._pieces.find(at)
        return self._stations.radii(p)[:, self._pieces.section[piece]]

    def _evaluate(self, what: int, p: Array, at: Array) -> Array:
        """Return numbers (N, ...) of stations, by machine code if there is any."""
        checkpoint()
        native = self.machine_code(len(p))
        if native is None:
            return self._interpreted(what, p, at)
        found, outcome = native.stations(what, p, at)
        if outcome.any():
            self._arm._check_margin(p, "")
            for row in np.flatnonzero(outcome):  # raises an error, or succeeds where C failed
                found[row] = self._interpreted(what, p[row : row + 1], at).ravel()
        return found

    def _interpreted(self, what: int, p: Array, at: Array) -> Array:
        self._arm._check_margin(p, "")
        if what == _POSES:
            return self._stations.poses(p, at)
        if what == _JACOBIANS:
            return self._stations.jacobians(p, at)
        if what == _LINE:
            return np.concatenate([self._stations.line(p, at), self._radii(p, at)[..., None]], -1)
        assert isinstance(self._stations, LoadedStations)
        return self._stations.responses(p, at)

    def machine_code(self, rows: int) -> NativeBody | None:
        """Return machine code, counting further rows; None without it, or not yet."""
        if self._native is not None:
            return self._native
        with self._lock:
            self._count += rows
            if self._count >= self._next_look:
                wanted_from = COMPILED_LOADED_FROM if self._arm.is_loaded else COMPILED_FREE_FROM
                self._next_look = max(wanted_from, self._count + _LOOKED_FOR_AGAIN)
                missing = self._count >= wanted_from
                self._native = native_body(self._arm, build_missing=missing)
        return self._native


def native_body(arm: Arm, build_missing: bool = True) -> NativeBody | None:
    """Return machine code of an arm's body; None without it."""
    kind, make, source = "body", free_body_functions, "clearance.c"
    if arm.is_loaded:
        if rod_functions(arm.layout) is None:
            return None
        kind, make, source = "loaded body", _loaded_functions, "loaded_clearance.c"
    code = library(
        (kind, arm.layout.skeleton), partial(make, arm.layout), (str(NATIVE / source),),
        build_missing=build_missing,
    )  # fmt: skip
    if code is None:
        return None
    try:
        return NativeBody(code, arm)
    except EquilibriumError:  # the VM will raise an error with more detail
        return None


def _loaded_functions(layout: Layout) -> list[ca.Function]:
    equations = rod_functions(layout)
    assert equations is not None  # checked in `native_body`
    used = [each for each in equations.functions if "adjoint" not in each.name()]
    return [*used, *loaded_body_functions(layout)]


class BodyModel(ctypes.Structure):
    """Structure `BodyModel` of native/body.h."""

    _fields_ = [
        *((name, _integer) for name in ("n", "pieces", "strains")),
        *((name, _pointer) for name in ("piece_of", "section", "ends", "numbers", "rod")),
    ]


class ModelInC:
    """An arm's `BodyModel`; this object owns the memory."""

    def __init__(self, arm: Arm, rod: LoadedArm | None) -> None:
        pieces, numbers = Pieces(arm), arm.numbers
        self._keep = (pieces, numbers, rod)
        self._model = BodyModel(
            n=arm.n_pressures,
            pieces=len(pieces.ends),
            strains=len(strain_rows(arm.layout)),
            piece_of=pieces.piece_of.ctypes.data,
            section=pieces.section.ctypes.data,
            ends=pieces.ends.ctypes.data,
            numbers=numbers.ctypes.data,
            rod=rod.address if rod else None,
        )
        self.address = ctypes.addressof(self._model)


class NativeBody:
    """The body of an arm in machine code.

    Raises `EquilibriumError` if the unpressurised arm falls over.

    Parameters
    ----------
    code : library of the functions of `stiffopt.model.body_functions` with clearance.c.

    Attributes
    ----------
    address : of the `BodyModel`.
    code : the library, with the functions of clearance.c.
    """

    def __init__(self, code: Library, arm: Arm) -> None:
        self._n = arm.n_pressures
        self.code = code
        size = code.cdll.stiffopt_body_model_size
        size.restype = _integer
        if size() != ctypes.sizeof(BodyModel):
            raise RuntimeError("native/body.h and this file disagree on their interface")
        self._model = ModelInC(arm, LoadedArm(code, arm) if arm.is_loaded else None)
        self.address = self._model.address
        self._stations = code.cdll.stiffopt_stations
        self._stations.argtypes = [_pointer, _integer, _pointer, _pointer, _integer,
                                   _pointer, _pointer, _integer, _integer]  # fmt: skip
        self._one_at_a_time = threading.Lock()
        self._kept: dict[tuple[int, int], Any] = {}

    def stations(self, what: int, p: Array, at: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return numbers (N, ...) of stations (k,) at (N, n), and outcomes (N,): 0 is good."""
        if len(p) == 1:
            with self._one_at_a_time:
                return self._of_one(what, p, at)
        p, at = np.ascontiguousarray(p), np.ascontiguousarray(at)
        found, outcome = self._results(what, len(p), len(at))
        call = self._call(what, p, at, found, outcome)

        def work(starts: Iterator[int]) -> None:
            for start in starts:
                self._run(call, start, min(start + _CHUNK, len(p)))

        in_parallel(work, range(0, len(p), _CHUNK))
        return found, outcome

    def _of_one(self, what: int, p: Array, at: Array) -> tuple[Array, NDArray[np.int64]]:
        """Do the same for one row, in reused memory."""
        kept = self._kept.get((what, len(at)))
        if kept is None:
            own = (np.empty((1, self._n)), np.empty(len(at)), *self._results(what, 1, len(at)))
            while len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            kept = self._kept[what, len(at)] = (own, self._call(what, *own))
        (pressures, stations, found, outcome), call = kept
        pressures[:], stations[:] = p, at
        self._run(call, 0, 1)
        return found.copy(), outcome.copy()

    def _results(self, what: int, rows: int, count: int) -> tuple[Array, NDArray[np.int64]]:
        width = count * (16, 6 * self._n, 81, 7)[what] + (27 if what == _RESPONSES else 0)
        return np.empty((rows, width)), np.empty(rows, dtype=np.int64)

    def _call(self, what: int, *arrays: NDArray[Any]) -> tuple[int, ...]:
        p, at, found, outcome = (array.ctypes.data for array in arrays)
        return self.address, what, p, at, len(arrays[1]), found, outcome

    def _run(self, call: tuple[int, ...], begin: int, end: int) -> None:
        if self._stations(*call, begin, end):
            raise MemoryError("no memory is left for the stations of the arm")
