"""Find the causes that explain the tip's responses, by Bayesian comparison of hypotheses.

Let (R, t) be the error of the tracker's frame in the base, s and S the errors of the sensor's
position and axes on the tip, and a the uncertain numbers of the arm (`ExpectedSteps`). A tracker
then measures the tip at rest at position p with axes T, and in step k the displacement d_k and the
rotation vector w_k::

    p = R (p_0 + P_0 a + R_0 s) + t          T = R exp(W_0 a) R_0 S
    d_k = R (D_k + D'_k a + L_k s)           w_k = R (W_k + W'_k a)

In a sound set-up all these unknowns are small; their priors are narrow (`Belief`). A *cause* is one
possible large error: it widens the prior in its own directions. A hypothesis combines an
arrangement of the tubes (the wiring) with some causes. Gauss-Newton finds its most probable values,
and Laplace's approximation there gives its evidence. Causes are added one by one as long as the
evidence grows clearly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations

import numpy as np

from stiffopt.arrays import Array
from stiffopt.commissioning.expected import ExpectedSteps, Source, rotation_vectors
from stiffopt.commissioning.responses import Responses
from stiffopt.commissioning.settings import BELIEF, LIMITS

Wiring = tuple[Source, ...]
"""For each command line, the channels whose chambers it fills."""

TURN, MOVE, SENSOR, SENSOR_TURN = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
FORCE, NUMBERS = slice(12, 15), 15  # the force on the tip; the arm's other numbers follow it

_ITERATIONS = 3  # of Gauss-Newton
_MAX_CAUSES = 4
_SHORTLIST = 3  # wirings to which causes are added
_PLAUSIBLE = 30.0  # log evidence that causes may gain for a wiring
_KEPT = 8  # wirings, nearest by displacement, whose evidence is computed
_FEW = 6  # largest number of channels of which all orders are tried
_WIDE = {  # prior standard deviations of a cause, in rad, m, or relative
    "turn": 1.0,
    "turn about z": 2.0,
    "move": 0.05,
    "sensor": 0.02,
    "length": 0.1,
    "response": 0.7,
}


@dataclass(frozen=True, eq=False)
class Cause:
    """One possible large error of the set-up."""

    name: str  # see `causes_of`
    # (k, d), in the space of all unknowns; each column is one prior standard deviation
    directions: Array
    about: int = -1  # index of the segment or channel concerned, from 0; -1 for the whole set-up
    prior: float = 0.0  # logarithm of its prior probability, relative to other causes


@dataclass(frozen=True, eq=False)
class SetupExplanation:
    """A hypothesis with its most probable values and its evidence."""

    # wiring, causes: the hypothesis
    wiring: Wiring
    causes: tuple[Cause, ...]
    evidence: float  # logarithm of its probability, up to a constant that all hypotheses share
    # values, covariance: of the unknowns, (k,) and (k, k); the first three are a rotation vector
    values: Array
    covariance: Array
    missed: Array  # unexplained displacements (n, 3), in m


def causes_of(expected: ExpectedSteps) -> list[Cause]:
    """Return all causes: errors of tracker frame and sensor, a load, and errors of the arm."""
    size = NUMBERS - 3 + len(expected.believed)
    segments, n = expected.description.n_segments, expected.n

    def along(*indices: int, by: float) -> Array:
        return by * np.eye(size)[:, list(indices)]

    lengths = list(range(NUMBERS, NUMBERS + segments))
    moduli = [index + segments for index in lengths]
    gains = NUMBERS + 2 * segments
    owners = np.repeat(range(segments), [s.n_channels for s in expected.description.segments])
    found = [
        Cause("frame turned", along(0, 1, 2, by=_WIDE["turn"])),
        Cause("frame turned", along(2, by=_WIDE["turn about z"])),
        Cause("frame moved", along(3, 4, 5, by=_WIDE["move"])),
        Cause("frame", np.hstack([along(0, 1, 2, by=_WIDE["turn"]), along(3, 4, 5, by=0.2)])),
        Cause("sensor moved", along(6, 7, 8, by=_WIDE["sensor"])),
        Cause("sensor turned", along(9, 10, 11, by=_WIDE["turn"])),
        Cause("load", along(12, 13, 14, by=15 * float(expected.believed[0])), prior=-3.0),
        Cause("length", along(*lengths, by=1.0).sum(axis=1, keepdims=True) * _WIDE["length"]),
        Cause("response", along(*moduli, by=1.0).sum(axis=1, keepdims=True) * _WIDE["response"]),
    ]
    every = along(*range(gains, gains + n), by=1.0).sum(axis=1, keepdims=True)
    found.append(Cause("gain", every * _WIDE["response"]))
    for s in range(segments) if segments > 1 else ():
        found.append(Cause("length", along(lengths[s], by=_WIDE["length"]), s))
        found.append(Cause("response", along(moduli[s], by=_WIDE["response"]), s))
    for k in range(n) if n > segments else ():
        if int((owners == owners[k]).sum()) > 1:
            found.append(Cause("gain", along(gains + k, by=_WIDE["response"]), k))
    return found


class Explainer:
    """Compares hypotheses about the responses to one step of each line."""

    def __init__(self, expected: ExpectedSteps, responses: Responses) -> None:
        self._expected, self._seen = expected, responses
        self.causes = causes_of(expected)
        b = BELIEF
        self._believed = np.array(
            [b.tilt, b.tilt, b.turn, *[b.move] * 3, *[b.sensor] * 3, *[b.sensor_angle] * 3,
             *expected.believed]
        )  # fmt: skip
        size = np.linalg.norm(responses.shift, axis=1)
        floor = max(float(size.max()), 0.3 * expected.farthest)
        self._shift_noise = np.sqrt(
            responses.shift_noise**2 + (b.model_share * size) ** 2 + (b.model_floor * floor) ** 2
        )
        self._turn_noise = np.ones(expected.n)
        if responses.turn is not None:
            angle = np.linalg.norm(responses.turn, axis=1)
            largest = float(np.linalg.norm(expected.turn, axis=1).max())
            floor = max(float(angle.max()), 0.3 * largest)
            self._turn_noise = np.sqrt(
                responses.turn_noise**2
                + (b.model_share * angle) ** 2
                + (b.model_floor * floor) ** 2
            )
        self.ordinary: Wiring = tuple((k,) for k in range(expected.n))

    # -- search ---------------------------------------------------------------------------------

    def best(self) -> SetupExplanation:
        """Return the most probable explanation: a wiring and the causes that are clear."""
        found = sorted(self._arranged, key=lambda each: -each.evidence)
        near = [each for each in found if each.evidence > found[0].evidence - _PLAUSIBLE]
        wirings = list(dict.fromkeys(each.wiring for each in near))[:_SHORTLIST]
        return max(map(self._with_causes, wirings), key=lambda each: each.evidence)

    @cached_property
    def _arranged(self) -> list[SetupExplanation]:
        """Explanations by the wiring alone, or with a turn of the frame."""
        plain = [self.explain(self.ordinary, each) for each in ((), self.causes[1:2])]
        likely = [(self.ordinary, True), *self._likely_wirings()]
        turned = self.causes[:1]
        return plain + [self.explain(wiring, turned if by else ()) for wiring, by in likely]

    def _with_causes(self, wiring: Wiring) -> SetupExplanation:
        best = self.explain(wiring)
        while len(best.causes) < _MAX_CAUSES:
            more = [
                self.explain(best.wiring, (*best.causes, cause))
                for cause in self.causes
                if cause not in best.causes
            ]
            candidate = max(more, key=lambda each: each.evidence)
            if candidate.evidence < best.evidence + LIMITS.clear:
                return best
            best = candidate
        return best

    def rivals(self, best: SetupExplanation, cause: Cause) -> list[tuple[Cause, SetupExplanation]]:
        """Return causes that explain about as much in place of one, which is among them.

        The best comes first.
        """
        others = tuple(each for each in best.causes if each is not cause)
        used = {(each.name, each.about) for each in best.causes}
        found = [
            (each, best if each is cause else self.explain(best.wiring, (*others, each)))
            for each in self.causes
            if each is cause or (each.name, each.about) not in used
        ]
        # without priors: only the measurements may rule out a rival
        threshold = max(
            best.evidence - cause.prior - LIMITS.same,
            self.explain(best.wiring, others).evidence,
        )
        near = [p for p in found if p[0] is cause or p[1].evidence - p[0].prior > threshold]
        return sorted(near, key=lambda pair: -pair[1].evidence)

    def wiring_rivals(self, best: SetupExplanation) -> list[SetupExplanation]:
        """Return the explanations with another wiring that are about as probable as the best."""
        found = list(self._arranged)
        if best.causes:
            found += [self.explain(each, best.causes) for each in {f.wiring for f in found}]
        near = {
            each.wiring: each
            for each in sorted(found, key=lambda each: each.evidence)
            if each.evidence > best.evidence - LIMITS.same and each.wiring != best.wiring
        }
        return sorted(near.values(), key=lambda each: -each.evidence)

    def _likely_wirings(self) -> Iterator[tuple[Wiring, bool]]:
        """Yield wirings that match the displacements best, and whether with a turn of the frame."""
        candidates = [each for each in set(self._wirings()) if each != self.ordinary]
        rows = np.array([[self._expected.row(s) for s in each] for each in candidates])
        expected, seen = self._expected.shift[rows], self._seen.shift  # (M, n, 3), (n, 3)
        weight = 1 / self._shift_noise[:, np.newaxis]
        expected, seen = expected * weight, seen * weight
        for is_turned in (False, True):
            turned = expected
            if is_turned:
                u, _, vt = np.linalg.svd(np.einsum("ki,mkj->mij", seen, expected))
                u[:, :, 2] *= np.linalg.det(u @ vt)[:, np.newaxis]
                turned = np.einsum("mij,mkj->mki", u @ vt, expected)
            scale = np.einsum("mki,ki->m", turned, seen) / np.maximum(
                np.einsum("mki,mki->m", turned, turned), 1e-12
            )
            scale = np.clip(scale, 0.4, 2.0)[:, np.newaxis, np.newaxis]
            misses = np.sum((scale * turned - seen) ** 2, axis=(1, 2))
            for index in np.argsort(misses)[:_KEPT]:
                yield candidates[index], is_turned

    def _wirings(self) -> Iterator[Wiring]:
        """Yield possible wirings: other orders of the tubes, dead lines and shared lines.

        All orders if there are few channels; else two channels or whole segments exchanged.
        """
        n, plain = self._expected.n, self.ordinary
        orders: set[tuple[int, ...]] = set()
        if n <= _FEW:
            orders |= set(permutations(range(n)))
        else:
            counts = [segment.n_channels for segment in self._expected.description.segments]
            ends = np.cumsum([0, *counts]).tolist()
            for i, j in combinations(range(n), 2):
                orders.add(tuple({i: j, j: i}.get(k, k) for k in range(n)))
            for places in permutations(range(len(counts))):
                orders.add(tuple(c for k in places for c in range(ends[k], ends[k + 1])))
        dead = {k for k in range(n) if self._is_dead(k)}
        for order in orders:
            yield tuple(() if k in dead else (c,) for k, c in enumerate(order))
        for k in range(n):
            yield _with(plain, {k: ()})
        for i, j in combinations(range(n), 2):
            for one, other in (((i, j), (i, j)), ((i, j), ()), ((), (i, j))):
                yield _with(plain, {i: one, j: other})

    def _is_dead(self, line: int) -> bool:
        least = float(np.linalg.norm(self._expected.shift[1 : 1 + self._expected.n], axis=1).min())
        return bool(np.linalg.norm(self._seen.shift[line]) < LIMITS.dead * least)

    # -- one hypothesis -------------------------------------------------------------------------

    def explain(self, wiring: Wiring, causes: Sequence[Cause] = ()) -> SetupExplanation:
        """Find the most probable values of the unknowns under a hypothesis, and its evidence."""
        prior = np.diag(self._believed**2)
        for cause in causes:
            prior = prior + cause.directions @ cause.directions.T
        weight: Array = np.linalg.inv(prior).astype(float)
        rows = [self._expected.row(source) for source in wiring]
        values = np.zeros(len(self._believed))
        if any(cause.name.startswith("frame") and cause.name != "frame moved" for cause in causes):
            values[TURN] = self._first_turn(rows)
        for _ in range(_ITERATIONS):
            misses, slopes = self._misses(rows, values)
            precision = slopes.T @ slopes + weight
            step: Array = np.asarray(
                np.linalg.solve(precision, slopes.T @ misses - weight @ values), dtype=float
            )
            turn = _rotation(step[TURN]) @ _rotation(values[TURN])
            values = values + step
            values[TURN] = rotation_vectors(turn)
        misses, slopes = self._misses(rows, values)
        precision = slopes.T @ slopes + weight
        evidence = -0.5 * float(misses @ misses + values @ weight @ values)
        evidence -= 0.5 * float(np.linalg.slogdet(precision @ prior)[1])
        evidence += _log_prior(wiring) + sum(cause.prior for cause in causes)
        missed = misses[: 3 * len(rows)].reshape(-1, 3) * self._shift_noise[:, np.newaxis]
        covariance = np.asarray(np.linalg.inv(precision), dtype=float)
        return SetupExplanation(wiring, tuple(causes), evidence, values, covariance, missed)

    def _first_turn(self, rows: Sequence[int]) -> Array:
        """Return the rotation vector that best turns the expected to the seen displacements."""
        expected, seen = self._expected.shift[rows], self._seen.shift
        if self._seen.turn is not None:  # weight rotations as displacements of a 0.1 m lever
            expected = np.vstack([expected, 0.1 * self._expected.turn[rows]])
            seen = np.vstack([seen, 0.1 * self._seen.turn])
        u, _, vt = np.linalg.svd(seen.T @ expected)
        return rotation_vectors(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)

    def _misses(self, rows: Sequence[int], values: Array) -> tuple[Array, Array]:
        """Return seen minus expected, in deviations, and the expected values' derivatives."""
        e, seen = self._expected, self._seen
        turn, numbers, sensor = _rotation(values[TURN]), values[FORCE.start :], values[SENSOR]
        shift = (e.shift[rows] + e.shift_slope[rows] @ numbers + e.lever[rows] @ sensor) @ turn.T
        place = turn @ (e.rest[:3, 3] + e.rest_slope[:3] @ numbers + e.rest[:3, :3] @ sensor)
        parts = [(seen.shift - shift).ravel() / np.repeat(self._shift_noise, 3)]
        slope = np.zeros((len(rows), 3, len(values)))
        slope[:, :, TURN] = -_hats(shift)
        slope[:, :, SENSOR] = turn @ e.lever[rows]
        slope[:, :, FORCE.start :] = turn @ e.shift_slope[rows]
        slopes = [slope.reshape(-1, len(values)) / np.repeat(self._shift_noise, 3)[:, np.newaxis]]
        rest = np.zeros((3, len(values)))
        rest[:, TURN], rest[:, MOVE] = -_hats(place[np.newaxis])[0], np.eye(3)
        rest[:, SENSOR] = turn @ e.rest[:3, :3]
        rest[:, FORCE.start :] = turn @ e.rest_slope[:3]
        noise = np.hypot(BELIEF.rest_position, seen.rest_noise)
        parts.append((seen.rest_position - place - values[MOVE]) / noise)
        slopes.append(rest / noise)
        if seen.turn is not None and seen.rest_rotation is not None:
            angle = (e.turn[rows] + e.turn_slope[rows] @ numbers) @ turn.T
            noises = np.repeat(self._turn_noise, 3)
            parts.append((seen.turn - angle).ravel() / noises)
            slope = np.zeros((len(rows), 3, len(values)))
            slope[:, :, TURN] = -_hats(angle)
            slope[:, :, FORCE.start :] = turn @ e.turn_slope[rows]
            slopes.append(slope.reshape(-1, len(values)) / noises[:, np.newaxis])
            bent = _rotation(e.rest_slope[3:] @ numbers) @ e.rest[:3, :3]
            axes = turn @ bent @ _rotation(values[SENSOR_TURN])
            off = rotation_vectors(seen.rest_rotation @ axes.T)  # base axes
            rest = np.zeros((3, len(values)))
            rest[:, TURN], rest[:, SENSOR_TURN] = np.eye(3), turn @ bent
            rest[:, FORCE.start :] = turn @ e.rest_slope[3:]
            parts.append(off / BELIEF.rest_angle)
            slopes.append(rest / BELIEF.rest_angle)
        return np.concatenate(parts), np.vstack(slopes)


def _with(wiring: Wiring, changes: dict[int, Source]) -> Wiring:
    return tuple(changes.get(k, source) for k, source in enumerate(wiring))


def _log_prior(wiring: Wiring) -> float:
    """Return the log prior of a wiring."""
    odd = [source for k, source in enumerate(wiring) if source != (k,)]
    lines = [source for source in odd if len(source) != 1]
    moved = len(odd) - len(lines)
    found = LIMITS.lines * len(set(lines))
    return found + (LIMITS.swapped - 1.5 * max(moved - 2, 0) if moved else 0.0)


def _hats(vectors: Array) -> Array:
    """Return the cross-product matrices (N, 3, 3) of vectors (N, 3)."""
    found = np.zeros((len(vectors), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        found[:, i, j], found[:, j, i] = -vectors[:, k], vectors[:, k]
    return found


def _rotation(vector: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
