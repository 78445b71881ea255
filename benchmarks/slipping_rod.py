"""The push at which a contact slips, by the independent rod with Coulomb friction.

It does not import stiffopt. From an equilibrium without tangential forces, a push at the tip grows
in steps. During a step the point of the body at each contact is held along the surface by a stiff
spring. After it, the spring's force is carried on, and the point that is then at the contact is
held: so the body rolls without slipping, by any distance. A contact slips where its tangential
force reaches the coefficient of friction times the normal force. A contact that the push adds may
slide without being lost: from there on it is taken as frictionless, as the model does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pressed_rod import MANY, Anchors, Pressed, distance, exponential, minimum, numbers, read

Array = Any
_HOLD = 1e6  # N/m
_FIRST_STEP, _STEPS = 2e-3, 12  # N; and steps up to the push that the first step foretells
_NEW_CONTACT = 0.01  # longest step in which a contact begins, over the push
_LEAST_FORCE = 1e-6  # N


class Slip(NamedTuple):
    """The push in N, the index of the object that slips, and how far the tip has moved, in m."""

    push: float
    object: int | None
    moved: float


_normal = jax.jit(jax.grad(lambda x, kind, numbers: distance(kind, numbers, x[None])[0], argnums=0))


def slip(
    state: Pressed, objects: Sequence[tuple[int, Sequence[float]]], direction: Array,
    friction: Array, limit: float,
) -> Slip:  # fmt: skip
    """The first contact that slips as a push along a unit direction grows to a limit.

    Each object must be touched at one station at most.
    """
    known, begun, start, push = numbers(objects), state.rod.force, state.tip, 0.0
    friction = np.full(len(state.forces), friction)
    carried, step, left = np.zeros((3, 3)), _FIRST_STEP, friction * state.forces
    longest, is_new = _FIRST_STEP, state.forces <= _LEAST_FORCE
    while push < limit:
        step = min(step, limit - push)
        rod = _anchored(state, known, carried, friction > 0)
        rod = rod._replace(force=begun + (push + step) * np.asarray(direction))
        y = minimum(state.strains, rod, known, MANY)
        after = read(y, rod, known, len(objects))
        begins = ((after.forces > _LEAST_FORCE) & (state.forces <= _LEAST_FORCE)).any()
        if begins and step > _NEW_CONTACT * (push + step):
            step /= 4
            continue
        forces, count = _held_forces(rod, y), len(objects)
        size = np.linalg.norm(forces[:count], axis=1)
        now = friction * after.forces - size
        slides = is_new & (after.forces > _LEAST_FORCE) & (now < 0)
        if slides.any():
            friction[slides], left[slides], carried[:count][slides] = 0.0, 0.0, 0.0
            continue
        state = after
        lost = int(np.argmin(np.where(left > 0, now, np.inf)))
        if now[lost] <= 0:
            share = left[lost] / (left[lost] - now[lost])
            moved = float(np.linalg.norm(state.tip - start))
            return Slip(push + share * step, lost, moved)
        if push == 0:  # long steps only where nothing slips soon
            rates = np.where(left > now, (left - now) / step, 1e-12)
            longest = float(np.clip((now / rates)[left > 0].min() / _STEPS, _FIRST_STEP / 4, 0.03))
        push, step = push + step, longest
        carried, left = forces, now  # contacts that are new stick from here on
    return Slip(np.inf, None, float(np.linalg.norm(state.tip - start)))


def _places(rod: Any, y: Array) -> tuple[Array, Array, Array]:
    """Axes (k, 3, 3) and places (k, 3) of the elements' starts, and strains (k, 6)."""
    strains = np.asarray(rod.free + np.einsum("kij,kj->ki", rod.root, y.reshape(-1, 6)))
    R, r, axes, places = np.eye(3), np.zeros(3), [], []
    for xi, h, connector in zip(strains, rod.h, rod.connector, strict=True):
        axes.append(R)
        places.append(r)
        turn, way = (np.asarray(each) for each in exponential(xi[:3] * h, xi[3:] * h))
        R, r = R @ turn, r + R @ way + connector * (R @ turn)[:, 2]
    return np.array(axes), np.array(places), strains


def _anchored(state: Pressed, objects: Array, carried: Array, sticks: Array) -> Any:
    """The rod with an anchor at each contact that sticks, which carries forces (3, 3) already."""
    rod = state.rod
    axes, places, strains = _places(rod, state.strains)
    ends = np.cumsum(rod.h + rod.connector) - rod.connector
    hold = np.zeros((len(rod.h), 3))
    share, (lever, at, normal, force) = np.zeros(3), np.zeros((4, 3, 3))
    for j, s in enumerate(state.at):
        if not (sticks[j] and state.forces[j] > _LEAST_FORCE):
            continue
        e = int(min(np.searchsorted(ends, s - 1e-12), len(ends) - 1))
        share[j] = np.clip((s - ends[e]) / rod.h[e] + 1, 0, 1)
        length = share[j] * rod.h[e]
        turn, way = (
            np.asarray(x) for x in exponential(strains[e, :3] * length, strains[e, 3:] * length)
        )
        section, centre = axes[e] @ turn, places[e] + axes[e] @ way
        n = np.asarray(_normal(jnp.array(centre), objects[0][j], objects[1][j]))
        hold[e, j], normal[j] = _HOLD, n
        lever[j] = -rod.radius[e] * section.T @ n
        at[j] = centre - rod.radius[e] * n
        along = carried[j] - n * (n @ carried[j])
        size = np.linalg.norm(carried[j])
        force[j] = along * (size / np.linalg.norm(along) if size else 0.0)
    return rod._replace(hold=hold, anchors=Anchors(share, lever, at, normal, force))


def _held_forces(rod: Any, y: Array) -> Array:
    """Forces (3, 3) of the anchors on the body."""
    axes, places, strains = _places(rod, y)
    found = np.zeros((3, 3))
    a = rod.anchors
    for e, j in zip(*np.nonzero(rod.hold), strict=True):
        length = a.share[j] * rod.h[e]
        turn, way = (
            np.asarray(x) for x in exponential(strains[e, :3] * length, strains[e, 3:] * length)
        )
        moved = places[e] + axes[e] @ (way + turn @ a.lever[j]) - a.at[j]
        found[j] = a.carried[j] - _HOLD * (moved - a.normal[j] * (a.normal[j] @ moved))
    return found
