"""Stations along an arm in the CasADi VM, for rows of pressures; see `stiffopt.model.body`.

The functions are those of the machine code, called in blocks, with NumPy instead of loops in C.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.model.batch import BatchFunction, InterpretedFunction
from stiffopt.model.body_functions import DENSE, free_body_functions, loaded_body_functions
from stiffopt.model.codegen import dense
from stiffopt.model.layout import Layout

if TYPE_CHECKING:
    from stiffopt.model.arm import Arm

Places = NDArray[np.intp]
Functions = Callable[[str], BatchFunction]


class Pieces:
    """The segments and connectors of an arm, from the base.

    Attributes
    ----------
    ends : arc lengths (k,) at rest.
    section : (k,) index of the segment whose section a piece has; for a connector the one before.
    piece_of : (n,) index of the piece that each pressure strains.
    """

    def __init__(self, arm: Arm) -> None:
        lengths: list[float] = []
        section: list[int] = []
        piece_of: list[int] = []
        for segment in arm.description.segments:
            own = len(lengths)
            piece_of += [own] * segment.n_channels
            for length in (segment.length, segment.connector):
                if length > 0:
                    lengths.append(length)
                    section.append(own)
        self.ends = np.cumsum(lengths)
        self.section = np.array(section, dtype=np.int64)
        self.piece_of = np.array(piece_of, dtype=np.int64)

    def find(self, at: Array) -> tuple[Places, Array]:
        """Return the pieces (k,) of stations, and arc lengths from the pieces' starts."""
        piece = np.minimum(np.searchsorted(self.ends, at), len(self.ends) - 1)
        return piece, at - np.concatenate([[0.0], self.ends])[piece]


class FreeStations:
    """Stations of an arm without loads, in closed form."""

    def __init__(self, arm: Arm, pieces: Pieces) -> None:
        self._numbers, self._pieces = arm.numbers, pieces
        self.interpreted: Functions = _free_functions(arm.layout).__getitem__

    def poses(self, p: Array, at: Array) -> Array:
        """See `stiffopt.model.body.BodyShape`, also for the other methods."""
        _, strains, starts, _ = self.interpreted("frames").many(p, self._numbers)
        pose = self._along(self.interpreted("along"), strains, starts, at)[0]
        return _transforms(pose[..., 3:12], pose[..., :3])

    def line(self, p: Array, at: Array) -> Array:
        """Return positions and tangents (N, k, 6)."""
        _, strains, starts, _ = self.interpreted("frames").many(p, self._numbers)
        pose = self._along(self.interpreted("along"), strains, starts, at)[0]
        return np.concatenate([pose[..., :3], pose[..., 12:]], -1)

    def jacobians(self, p: Array, at: Array) -> Array:
        """Return the Jacobians; twists grow along a pressure's piece and are constant beyond it."""
        _, strains, starts, _, slopes, twists, _ = self.interpreted("moving_frames").many(
            p, self._numbers
        )
        pose, moves = self._along(self.interpreted("moving_along"), strains, starts, at)
        own = moves @ slopes[:, None]  # (N, k, 6, n)
        v, w = np.broadcast_arrays(twists[:, None, :3], twists[:, None, 3:])
        beyond = np.concatenate(
            np.broadcast_arrays(v + np.cross(w, pose[..., :3, None], axis=-2), w), -2
        )
        piece = self._pieces.find(at)[0][:, None, None]
        of = self._pieces.piece_of
        return in_axes(pose[..., 3:12], np.where(of < piece, beyond, np.where(of == piece, own, 0)))

    def compliances(self, function: Functions, p: Array, at: Array, s: Places, t: Places) -> Array:
        """Return ``X_s A(min(s, t)) X_t'``; s and t are indices (k,) into the ascending `at`."""
        count = len(p)
        _, strains, starts, _ = function("frames").many(p, self._numbers)
        sections, before = function("gathering").many(p, self._numbers)
        piece, local = self._pieces.find(at)
        own = function("gathered").many(
            _at_pieces(starts, piece),
            _at_pieces(strains, piece),
            _at_pieces(sections, piece).reshape(-1, 6, 6),
            np.tile(local, count)[:, np.newaxis],
        )[0]
        A = (own + _at_pieces(before, piece).reshape(-1, 6, 6)).reshape(count, len(at), 6, 6)
        X = np.tile(np.eye(6), (count, len(at), 1, 1))
        X[..., :3, 3:] = -_hat(self._along(function("along"), strains, starts, at)[0][..., :3])
        return X[:, s] @ A[:, np.minimum(s, t)] @ np.swapaxes(X[:, t], -1, -2)

    def radii(self, p: Array) -> Array:
        """Return the radius of each piece, (N, pieces)."""
        return self.interpreted("frames").many(p, self._numbers)[3][..., 0]

    def _along(
        self, function: BatchFunction, strains: Array, starts: Array, at: Array
    ) -> list[Array]:
        """Return poses (N, k, 15), and for ``moving_along`` twists per strain (N, k, 6, m)."""
        count = len(strains)
        piece, local = self._pieces.find(at)
        lengths = np.tile(local, count)[:, np.newaxis]
        found = function.many(_at_pieces(starts, piece), _at_pieces(strains, piece), lengths)
        pose, *moves = (each.reshape(count, len(at), *each.shape[1:]) for each in found)
        return [pose[..., 0], *moves]


class Carried(NamedTuple):
    """States at stations, and their changes along directions, propagated from the tip."""

    axes: Array  # (k, 9) by columns
    # positions, tangents: (k, 3)
    positions: Array
    tangents: Array
    changes: Array  # (k, 3, 3, d) of rotation, moment and vector to the tip, in base axes
    force: Array  # (3, d) change of the force, the same along the whole arm


class LoadedStations:
    """Stations of an arm in equilibrium, interpolated between integration steps.

    Directions are three turns of the tip, the pressures and a wrench at the tip, see `Chain`.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._functions = _loaded_functions(arm.layout)

    def poses(self, p: Array, at: Array) -> Array:
        """See `stiffopt.model.body.BodyShape`, also for the other methods."""
        rows = [self._carried(row, at, moving=False) for row in p]
        found = [_transforms(row.axes, row.positions) for row in rows]
        return np.array(found).reshape(len(p), len(at), 4, 4)

    def line(self, p: Array, at: Array) -> Array:
        """Return positions and tangents (N, k, 6)."""
        rows = [self._carried(row, at, moving=False) for row in p]
        found = [np.hstack([row.positions, row.tangents]) for row in rows]
        return np.array(found).reshape(len(p), len(at), 6)

    def jacobians(self, p: Array, at: Array) -> Array:
        """Return the Jacobians, with the turn of the tip for which the base does not rotate."""
        n = self._arm.n_pressures
        found = []
        for row in p:
            carried = self._carried(row, at, moving=True)
            base, here = carried.changes[0], carried.changes[1:]
            turn = np.linalg.solve(base[0, :, :3], base[0, :, 3 : 3 + n])
            gain = np.vstack([-turn, np.eye(n)])
            turned, way = here[:, 0, :, : 3 + n] @ gain, here[:, 2, :, : 3 + n] @ gain
            moved = base[2, :, : 3 + n] @ gain - way
            found.append(in_axes(carried.axes, np.concatenate([moved, turned], 1)))
        return np.array(found).reshape(len(p), len(at), 6, n)

    def responses(self, p: Array, at: Array) -> Array:
        """Return the changes along turns and wrenches in the layout of the machine code."""
        first = np.r_[:3, -6:0]
        found = []
        for row in p:
            carried = self._carried(row, at, moving=True)
            changes, force = carried.changes[1:, ..., first], carried.force[:, first]
            found.append(np.concatenate([changes.ravel(), force.T.ravel()]))
        return np.array(found).reshape(len(p), 81 * len(at) + 27)

    def radii(self, p: Array) -> Array:
        """Return the radius of each piece, (N, pieces)."""
        return self._functions["radii"].many(p, self._arm.numbers)[0][..., 0]

    def _carried(self, p: Array, at: Array, *, moving: bool) -> Carried:
        """Evaluate the equilibrium from rest; if `moving`, changes begin with those at the base."""
        function, distal = self._notes(moving)
        notes, *changes = function(*self._arm._equilibrium().arguments(self._arm.settle(p)))
        at = np.concatenate([[0.0], at])
        proximal = np.append(distal[1:], 0.0)
        stretch = np.minimum(np.searchsorted(-proximal, -at, side="right"), len(distal) - 1)
        share = np.maximum(distal[stretch] - at, 0) / (distal - proximal)[stretch]
        powers = np.vander(share, 6, increasing=True)
        weights = np.hstack([np.ones((len(at), 1)), powers @ DENSE.T])
        notes = notes.reshape(10, -1, 6)[:, stretch]
        state = np.einsum("kb,ikb->ki", weights, notes)
        slope = powers[1:, :-1] @ (DENSE[:, 1:] * np.arange(1, 6)).T
        tangents = -np.einsum("kb,ikb->ki", slope, notes[4:7, 1:, 1:])
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        axes, turning = self._functions["axes"].many(state[:, :4])
        places = (axes[1:, :, 0], state[1:, 4:7] - state[0, 4:7], tangents)
        if not moving:
            return Carried(*places, np.zeros(0), np.zeros(0))
        change, force = changes
        change = change.reshape(len(distal), 6, 10, -1)[stretch]
        change = np.einsum("kb,kbid->kid", weights, change)
        carried = np.stack([turning @ change[:, :4], change[:, 7:], -change[:, 4:7]], 1)
        return Carried(*places, carried, force)

    def _notes(self, moving: bool) -> tuple[InterpretedFunction, Array]:
        """Return the function of notes (10, 6 stretches) and their changes; starts of stretches."""
        arm = self._arm

        def make() -> tuple[InterpretedFunction, Array]:
            chain = arm._equilibrium().shooting.chain()
            notes = ca.horzcat(*(stretch.notes for stretch in chain.stretches))
            outputs = [notes]
            if moving:
                outputs += [ca.jacobian(notes, chain.x), ca.jacobian(chain.force, chain.x)]
            function = dense(ca.Function("notes", list(chain.inputs), outputs))
            distal = np.array([stretch.distal for stretch in chain.stretches])
            return InterpretedFunction(function), distal

        return arm.kept(("notes", moving), make)


@lru_cache(maxsize=64)
def _free_functions(layout: Layout) -> dict[str, InterpretedFunction]:
    return {f.name(): InterpretedFunction(f) for f in free_body_functions(layout)}


@lru_cache(maxsize=64)
def _loaded_functions(layout: Layout) -> dict[str, InterpretedFunction]:
    return {f.name(): InterpretedFunction(f) for f in loaded_body_functions(layout)}


def response(carried: Array, force: Array, s: Places, t: Places) -> Array:
    """Return twists at s per wrench at t of a loaded arm, (N, k, 6, 6), in base axes.

    Parameters
    ----------
    carried : (N, stations, 3, 3, 9), changes of rotation, moment and vector to the tip along turns
        of the tip and wrenches there; the first station is the base, and the others ascend.
    force : (N, 3, 9), changes of the force.
    s, t : (k,), indices of the stations.
    """
    here, there, base = carried[:, s], carried[:, t], carried[:, :1]
    forces = np.broadcast_to(force[:, None], there[:, :, 0].shape)
    # combination of the propagated solutions with a jump of force and moment at t, no rotation
    jump = np.linalg.inv(np.concatenate([there[:, :, 0], there[:, :, 1], forces], -2))
    jump = jump[..., [6, 7, 8, 3, 4, 5]]
    turn = -np.linalg.solve(np.broadcast_to(base[:, :, 0, :, :3], (*jump.shape[:2], 3, 3)),
                            base[:, :, 0] @ jump)  # fmt: skip
    below = (s <= t)[:, None, None] * jump
    tip = base[:, :, 2, :, :3] @ turn + (base[:, :, 2] - there[:, :, 2]) @ jump
    moved = tip - here[:, :, 2, :, :3] @ turn - (here[:, :, 2] - there[:, :, 2]) @ below
    turned = here[:, :, 0, :, :3] @ turn + here[:, :, 0] @ below
    return np.concatenate([moved, turned], -2)


def in_axes(axes: Array, twists: Array) -> Array:
    """Transform twists (..., 6, n) from base axes to axes given by columns (..., 9)."""
    rows = axes.reshape(*axes.shape[:-1], 3, 3)  # R'
    return np.concatenate([rows @ twists[..., :3, :], rows @ twists[..., 3:, :]], -2)


def _transforms(axes: Array, positions: Array) -> Array:
    T = np.zeros((*positions.shape[:-1], 4, 4))
    T[..., :3, :3] = np.swapaxes(axes.reshape(*axes.shape[:-1], 3, 3), -1, -2)
    T[..., :3, 3] = positions
    T[..., 3, 3] = 1
    return T


def _at_pieces(values: Array, piece: Places) -> Array:
    """Return columns (N k, r) of values (N, r, pieces)."""
    return np.swapaxes(values[:, :, piece], 1, 2).reshape(-1, values.shape[1])


def _hat(v: Array) -> Array:
    """Return skew matrices (..., 3, 3) of vectors (..., 3)."""
    return np.cross(v[..., None, :], np.eye(3), axisa=-1, axisb=-1, axisc=-1).swapaxes(-1, -2)
