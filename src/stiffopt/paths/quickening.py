"""Change the pressures of a path together so that it can be followed faster.

The largest share t of the allowed steps is minimised by sequential programming over cones::

    minimise    t
    subject to  |x_{i+1} + d_{i+1} - x_i - d_i| <= t steps_i,  lower <= x_i + d_i <= upper
                |r_i + J_i d_i| <= tolerance_i                 r: residuals of position and angle

A trust region shrinks where a step d leaves a tolerance in spite of corrections for curvature, or
the clearance of the scene, or does not reduce the share.
"""

from collections.abc import Collection

import clarabel
import numpy as np
from scipy import sparse

from stiffopt.arrays import Array
from stiffopt.model.stopping import checkpoint
from stiffopt.paths.cones import minimised
from stiffopt.paths.points import PathCandidate, PathTasks, Slopes
from stiffopt.paths.settings import QUICKENING, REFINEMENT


def share_of(steps: Array, pressures: Array) -> float:
    """Return the largest share of steps (N - 1, n) that pressures (N, n) use."""
    return float((np.abs(np.diff(pressures, axis=0)) / steps).max())


def quickened(
    tasks: PathTasks,
    found: list[PathCandidate],
    steps: Array,
    fixed: Collection[int],
    is_closed: bool = False,
) -> list[PathCandidate]:
    """Return candidates at all points that use a smaller share of steps (N - 1, n), in Pa.

    The share is at most that of the given ones, and need not be less than one; `fixed` points do
    not change. The last point of a closed path stays where the first one is.
    """
    free = np.ones(len(found), dtype=bool)
    free[list(fixed)] = False
    every = range(len(found))
    pressures = np.array([each.pressures for each in found])
    slopes = tasks.slopes(every, pressures)
    share, radius = share_of(steps, pressures), QUICKENING.radius
    for _ in range(QUICKENING.iterations):
        if slopes is None or share <= QUICKENING.enough or radius < QUICKENING.last_radius:
            break
        checkpoint()
        program = _Program(tasks, slopes, pressures, steps, radius * free, is_closed)
        trial = program.solved()
        there = None if trial is None else tasks.slopes(every, trial)
        for _ in range(QUICKENING.corrections):
            if trial is None or there is None or tasks.hold(there):
                break
            trial = program.solved(trial, there)
            there = None if trial is None else tasks.slopes(every, trial)
        if (
            trial is not None
            and there is not None
            and share_of(steps, trial) < share - QUICKENING.last_gain
            and tasks.hold(there)
            and (tasks.body is None or tasks.body.motion(trial).clear)
        ):
            pressures, slopes, share = trial, there, share_of(steps, trial)
            radius *= 2
        else:
            radius *= 0.3
    judgements = enumerate(zip(pressures, tasks.judged(pressures), strict=True))
    new = [tasks.accepted(index, *each) for index, each in judgements]
    return found if None in new else [each for each in new if each is not None]


class _Program:
    """The linearised program at pressures (N, n) in Pa; `move` (N,) are the greatest changes."""

    def __init__(
        self,
        tasks: PathTasks,
        slopes: Slopes,
        pressures: Array,
        steps: Array,
        move: Array,
        is_closed: bool,
    ) -> None:
        self._tasks, self._slopes, self._pressures = tasks, slopes, pressures
        self._is_fixed, self._is_closed = move == 0, is_closed
        unit = tasks.unit
        x = pressures / unit
        high = np.clip(tasks.upper / unit - x, 0, move[:, np.newaxis]).ravel()
        low = np.clip(tasks.lower / unit - x, -move[:, np.newaxis], 0).ravel()
        apart = np.diff(x, axis=0).ravel()
        same = sparse.identity(x.size, format="csr")
        ahead = same[x.shape[1] :] - same[: -x.shape[1]]
        t = -(steps / unit).reshape(-1, 1)
        still = sparse.csc_matrix((x.size, 1))
        self._rows = [
            sparse.hstack([same, still]), sparse.hstack([-same, still]),
            sparse.hstack([ahead, t]), sparse.hstack([-ahead, t]),
        ]  # fmt: skip
        self._bounds = [high, -low, -apart, apart]
        self._cones: list[object] = [clarabel.NonnegativeConeT(sum(map(len, self._bounds)))]
        if is_closed:
            n = x.shape[1]
            self._rows.append(sparse.hstack([same[-n:] - same[:n], still[:n]]))
            self._bounds.append(np.zeros(n))
            self._cones.append(clarabel.ZeroConeT(n))
        for c in tasks.own_constraints:
            rows = slopes.jacobians[:, c.first : c.end] / c.scale
            if not c.one_sided:  # |r| <= radius: the first row of a cone is the radius
                rows = np.concatenate([np.zeros_like(rows[:, :1]), -rows], axis=1)
            count = rows.shape[0] * rows.shape[1]
            self._rows.append(
                sparse.hstack([sparse.block_diag(list(rows)), sparse.csc_matrix((count, 1))])
            )
            if c.one_sided:
                self._cones.append(clarabel.NonnegativeConeT(count))
            else:
                self._cones += [clarabel.SecondOrderConeT(rows.shape[1])] * len(rows)

    def solved(self, at: Array | None = None, there: Slopes | None = None) -> Array | None:
        """Return better pressures (N, n); None if the program fails.

        Linear constraints are exact at pressures `at`, whose residuals are those of `there`; by
        default at the program's own.
        """
        tasks = self._tasks
        residuals = own = self._slopes.residuals
        if at is not None and there is not None:
            d = (at - self._pressures) / tasks.unit
            residuals = there.residuals - np.einsum("kmn,kn->km", self._slopes.jacobians, d)
        bounds = list(self._bounds)
        for c, radii in zip(tasks.own_constraints, tasks.radii.T, strict=True):
            r, here = (each[:, c.first : c.end] / c.scale for each in (residuals, own))
            sizes = here[:, 0] if c.one_sided else np.linalg.norm(here, axis=1)
            # points at the border of a tolerance may stay there
            within = np.maximum(REFINEMENT.of_tolerance * radii / c.scale, sizes)
            if c.one_sided:
                bounds.append(within - r[:, 0])
            else:
                bounds.append(np.column_stack([within, r]).ravel())
        size = self._pressures.size + 1
        P = sparse.diags(np.append(np.full(size - 1, QUICKENING.damping), 0.0), format="csc")
        q = np.append(np.zeros(size - 1), 1.0)
        A = sparse.csc_matrix(sparse.vstack(self._rows))
        solution = minimised(P, q, A, np.concatenate(bounds), self._cones)
        if solution is None:
            return None
        d = solution[0][:-1].reshape(self._pressures.shape)
        found = np.clip(self._pressures + d * tasks.unit, tasks.lower, tasks.upper)
        found[self._is_fixed] = self._pressures[self._is_fixed]
        if self._is_closed:
            found[-1] = found[0]
        return found
