"""An independent model of an arm pressed on objects: a discrete rod with penalty contact.

It does not import stiffopt. The rod has elements of constant strain. Many stiff springs between its
body and the surfaces model contact. JAX differentiates the energy; Newton's method minimises it
while pressures and load grow from rest in small steps.

Then elements are made short near the contacts, and springs stiff. Both matter for the tip's
stiffness: an element of constant strain that is longer than the length on which a force is spread
resists the contact's motion along it, and springs that yield by micrometres add to the compliance
of a tip that is held by contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from independent.arms import Arm
from independent.sections import rod_section

jax.config.update("jax_enable_x64", True)

Array = Any
_FEW, MANY = 8, 24
"""Springs along an element: on the way from rest, and then."""
_SPRING, _STIFFER = 6.4e6, (2e7, 2.5e8, 3e9)
"""Their stiffness in N/m per m along the arm: on the way from rest, and then one after another."""
_ELEMENTS = 80  # in the end
_SHORTEST, _LONGEST = 1.5e-4, 4e-3  # m, about the lengths of elements in contact and far from it
_GROWTH = 0.35  # of their lengths, per distance
_OF_TIP = 3e-4  # m along the arm, that the spring of the hemisphere at the tip stands for
_ENERGY_LEFT, _STUCK = 1e-17, 1e-11  # J, of a step: at a minimum; too much where none succeeds
_FAR = (1, [0.0, 0.0, -10.0, 0.0, 0.0, 1.0, 0.0])


class Anchors(NamedTuple):
    """Points of the body that stick to a surface each, three of them; see `slipping_rod.py`."""

    share: Array  # of their element
    lever: Array  # from the centre line there, in the axes of the section
    at: Array  # where they were
    normal: Array  # of the surface
    carried: Array  # force on the body there


class Rod(NamedTuple):
    """Elements (k, ...) of an arm at some pressures under some load."""

    h: Array
    free: Array
    root: Array  # of an element's compliance
    weight: Array
    centroid: Array
    connector: Array
    radius: Array
    force: Array
    spring: Array
    hold: Array  # (k, 3), stiffness of the anchors in N/m along their surfaces
    anchors: Anchors


@dataclass(frozen=True)
class Pressed:
    """An equilibrium: tip (3,), its rotation (3, 3), and force and mean station of each object."""

    tip: Array
    rotation: Array
    forces: Array
    at: Array
    strains: Array
    rod: Rod


def make_rod(arm: Arm, p: Array, n: int, force: Array) -> Rod:
    """N elements for each segment."""
    gravity = np.asarray(arm.gravity)
    laws = [rod_section(t, own, gravity) for t, own in zip(arm.tubes, arm.split(p), strict=True)]
    h = np.repeat([tube.length / n for tube in arm.tubes], n)
    connector = np.zeros(n * len(arm.tubes))
    connector[n - 1 :: n] = [tube.connector for tube in arm.tubes]
    root = np.repeat([np.linalg.cholesky(law.compliance) for law in laws], n, axis=0)
    return Rod(
        h=h,
        free=np.repeat([law.strain for law in laws], n, axis=0),
        root=root / np.sqrt(h)[:, None, None],
        weight=np.repeat([law.weight for law in laws], n, axis=0),
        centroid=np.repeat([law.centroid for law in laws], n, axis=0),
        connector=connector,
        radius=np.repeat([tube.outer_radius for tube in arm.tubes], n),
        force=np.asarray(force, float) + arm.tip_mass * gravity,
        spring=np.float64(_SPRING),
        hold=np.zeros((len(h), 3)),
        anchors=Anchors(np.zeros(3), *np.zeros((4, 3, 3))),
    )


def exponential(v: Array, w: Array) -> tuple[Array, Array]:
    """Rotation and way of a small twist, by power series."""
    x, zero = w @ w, 0.0 * w[0]
    first = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72)))
    second = (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90)))) / 2
    third = (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110)))) / 6
    W = jnp.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])
    W2 = W @ W
    return jnp.eye(3) + first * W + second * W2, v + second * (W @ v) + third * (W2 @ v)


def distance(kind: Array, numbers: Array, x: Array) -> Array:
    """Of points (k, 3) from a capsule (kind 0), half-space (1), inside of a tube (2), ring (3)."""
    a, b, radius, c = numbers[:3], numbers[3:6], numbers[6], numbers[7:]
    height = (x - a) @ b
    across = _length(x - a - height[:, None] * b) - radius
    inside = radius - jnp.minimum(_from_line(a, b, x), _from_line(b, c, x))
    ring = jnp.sqrt(height**2 + across**2 + 1e-24)
    kinds = [kind == 0, kind == 1, kind == 2]
    return jnp.select(kinds, [_from_line(a, b, x) - radius, height, inside], ring)


def _from_line(a: Array, b: Array, x: Array) -> Array:
    way = b - a
    share = jnp.clip(((x - a) @ way) / jnp.maximum(way @ way, 1e-12), 0, 1)
    return _length(x - a - share[:, None] * way)


def _length(x: Array) -> Array:
    return jnp.sqrt((x**2).sum(-1) + 1e-24)


def _held(R: Array, r: Array, xi: Array, h: Array, hold: Array, anchors: Anchors) -> Array:
    """Energy of an element's anchors."""

    def one(share: Array, lever: Array, at: Array, normal: Array, carried: Array) -> Array:
        turn, way = exponential(xi[:3] * h * share, xi[3:] * h * share)
        moved = r + R @ (way + turn @ lever) - at
        across = moved - normal * (normal @ moved)
        return across @ across / 2, -carried @ moved

    elastic, carried = jax.vmap(one)(*anchors)
    return (hold * elastic + (hold > 0) * carried).sum()


def _chain(rod: Rod, y: Array, samples: int) -> tuple[Array, Array, Array, Array]:
    """Places of samples (k, samples, 3), tip, its rotation, and the energy without springs."""
    strains = rod.free + jnp.einsum("kij,kj->ki", rod.root, y)
    shares = (jnp.arange(samples) + 0.5) / samples

    def along(carry: Array, item: Array) -> tuple[Array, Array]:
        R, r, energy = carry
        xi, h, f, c, connector, hold = item
        places = jax.vmap(
            lambda s: r + R @ exponential(xi[:3] * h * s, xi[3:] * h * s)[1]
        )(shares)  # fmt: skip
        R_half, half = exponential(xi[:3] * h / 2, xi[3:] * h / 2)
        R_whole, whole = exponential(xi[:3] * h, xi[3:] * h)
        middle = r + R @ (half + R_half @ c)
        R_next = R @ R_whole
        energy = energy - h * middle @ f + _held(R, r, xi, h, hold, rod.anchors)
        return (R_next, r + R @ whole + connector * R_next[:, 2], energy), places

    start = (jnp.eye(3), jnp.zeros(3), 0.0)
    items = (strains, rod.h, rod.weight, rod.centroid, rod.connector, rod.hold)
    (R, tip, energy), places = jax.lax.scan(along, start, items)
    return places, tip, R, energy + 0.5 * (y**2).sum() - tip @ rod.force


def _springs(rod: Rod, y: Array, objects: Array, samples: int) -> tuple[Array, ...]:
    places, tip, R, energy = _chain(rod, y, samples)
    points = jnp.concatenate([places.reshape(-1, 3), tip[None]])
    radii = jnp.concatenate([jnp.repeat(rod.radius, samples), rod.radius[-1:]])
    depths = jax.vmap(lambda kind, numbers: radii - distance(kind, numbers, points))(*objects)
    own = jnp.concatenate([jnp.repeat(rod.h / samples, samples), jnp.array([_OF_TIP])]) * rod.spring
    return own * jnp.maximum(depths, 0), jnp.maximum(depths, 0), tip, R, energy


def _energy(y: Array, rod: Rod, objects: Array, samples: int) -> Array:
    forces, depths, _, _, energy = _springs(rod, y.reshape(-1, 6), objects, samples)
    return energy + 0.5 * (forces * depths).sum()


_value = jax.jit(_energy, static_argnums=3)
_seen = jax.jit(_springs, static_argnums=3)


def _near(R: Array, r: Array) -> Array:
    """Twist of a small motion, to second order."""
    W = (R - R.T) / 2
    return jnp.concatenate([r - W @ r / 2, jnp.array([W[2, 1], W[0, 2], W[1, 0]])])


def _part(
    twist: Array,
    y: Array,
    item: Array,
    beyond: tuple[Array, Array],
    objects: Array,
    rod: Rod,
    samples: int,
) -> tuple[Array, Array]:
    """Energy of an element and, to second order, of all beyond; and the twist of its end.

    Twists are in base axes about the base, that of the start is given. What is beyond exerts a
    wrench (6,) on the end at its present pose, with a stiffness (6, 6).
    """
    R, r, R_end, r_end, free, root, h, weight, centroid, connector, radius, hold = item
    turn, way = exponential(twist[:3], twist[3:])
    R, r = turn @ R, turn @ r + way
    xi = free + root @ y
    shares = (jnp.arange(samples) + 0.5) / samples
    places = jax.vmap(lambda s: r + R @ exponential(xi[:3] * h * s, xi[3:] * h * s)[1])(shares)
    depths = jax.vmap(lambda kind, numbers: radius - distance(kind, numbers, places))(*objects)
    R_half, half = exponential(xi[:3] * h / 2, xi[3:] * h / 2)
    energy = 0.5 * y @ y - h * (r + R @ (half + R_half @ centroid)) @ weight
    energy += 0.5 * h / samples * rod.spring * (jnp.maximum(depths, 0) ** 2).sum()
    energy += _held(R, r, xi, h, hold, rod.anchors)
    R_whole, whole = exponential(xi[:3] * h, xi[3:] * h)
    R_next = R @ R_whole
    change = R_next @ R_end.T
    moved = _near(change, r + R @ whole + connector * R_next[:, 2] - change @ r_end)
    wrench, K = beyond
    return energy + moved @ wrench + 0.5 * moved @ K @ moved, moved


def _tip_part(
    twist: Array, r: Array, force: Array, radius: Array, objects: Array, k: Array
) -> Array:
    turn, way = exponential(twist[:3], twist[3:])
    x = (turn @ r + way)[None]
    depths = jax.vmap(lambda kind, numbers: radius - distance(kind, numbers, x))(*objects)
    return 0.5 * k * (jnp.maximum(depths, 0) ** 2).sum() - x[0] @ force


@partial(jax.jit, static_argnums=3)
def _derivatives(y: Array, rod: Rod, objects: Array, samples: int) -> tuple[Array, ...]:
    """Energy, gradient and Hessian; moving an element's end moves all beyond rigidly."""
    y = y.reshape(-1, 6)
    strains = rod.free + jnp.einsum("kij,kj->ki", rod.root, y)

    def along(pose: Array, item: Array) -> tuple[Array, Array]:
        (R, r), (xi, h, connector) = pose, item
        turn, way = exponential(xi[:3] * h, xi[3:] * h)
        end = R @ turn, r + R @ way + connector * (R @ turn)[:, 2]
        return end, (R, r, *end)

    (_, tip), poses = jax.lax.scan(
        along, (jnp.eye(3), jnp.zeros(3)), (strains, rod.h, rod.connector)
    )
    own_items = (rod.free, rod.root, rod.h, rod.weight, rod.centroid, rod.connector, rod.radius)
    items = (*poses, *own_items, rod.hold)
    zero, none = jnp.zeros(6), (jnp.zeros(6), jnp.zeros((6, 6)))

    def own(twist: Array, y: Array, item: Array) -> Array:
        return _part(twist, y, item, none, objects, rod, samples)[0]

    def last(twist: Array) -> Array:
        return _tip_part(twist, tip, rod.force, rod.radius[-1], objects, _OF_TIP * rod.spring)

    wrenches = jax.vmap(lambda y, item: jax.grad(own)(zero, y, item))(y, items)
    stiffnesses = jax.vmap(lambda y, item: jax.hessian(own)(zero, y, item))(y, items)
    beyond = tuple(
        jnp.cumsum(jnp.concatenate([end[None], each[:0:-1]]), axis=0)[::-1]
        for each, end in ((wrenches, jax.grad(last)(zero)), (stiffnesses, jax.hessian(last)(zero)))
    )

    def second(y: Array, item: Array, after: tuple[Array, Array]) -> tuple[Array, ...]:
        def both(y: Array) -> tuple[Array, Array]:
            return jax.grad(lambda *x: _part(*x, item, after, objects, rod, samples)[0], (0, 1))(
                zero, y
            )

        S = jax.jacfwd(lambda y: _part(zero, y, item, after, objects, rod, samples)[1])(y)
        return (*jax.jacfwd(both)(y), both(y)[1], S)

    coupled, D, g, S = jax.vmap(second)(y, items, beyond)
    count = len(y)
    H = jnp.einsum("iab,jac->ibjc", S, coupled)
    H = H * (jnp.arange(count)[:, None] < jnp.arange(count))[:, None, :, None]
    H = H.reshape(6 * count, -1)
    own_blocks = jnp.einsum("ij,iab->iajb", jnp.eye(count), D).reshape(6 * count, -1)
    return _energy(y.ravel(), rod, objects, samples), g.ravel(), H + H.T + own_blocks


def minimum(y: Array, rod: Rod, objects: Array, samples: int) -> Array:
    """Strains (6 k,) of the nearest minimum of the energy.

    Newton's method with a line search, shifted where the energy is not convex.
    """
    for _ in range(300):
        f, g, H = (np.asarray(each) for each in _derivatives(y, rod, objects, samples))
        shift = 0.0
        while True:
            try:
                L = np.linalg.cholesky(H + shift * np.eye(len(g)))
                break
            except np.linalg.LinAlgError:
                shift = max(10 * shift, 1e-3)
        step = -np.linalg.solve(L.T, np.linalg.solve(L, g))
        slope = float(step @ g)
        if -slope < _ENERGY_LEFT and shift == 0:
            return y
        size = min(1.0, 0.02 / float(np.linalg.norm(step)))
        while _value(y + size * step, rod, objects, samples) > f + 1e-4 * size * slope + 1e-18:
            size /= 2
            if size < 1e-6:
                if -slope > _STUCK:
                    raise ArithmeticError("the energy does not fall along Newton's direction")
                return y
        y = y + size * step
    raise ArithmeticError("no minimum was found")


def _stations(rod: Rod, samples: int) -> Array:
    """Arc lengths of the springs along the elements and of that at the tip."""
    ends = np.cumsum(rod.h + rod.connector)
    shares = (np.arange(samples) + 0.5) / samples
    at = ((ends - rod.h - rod.connector)[:, None] + rod.h[:, None] * shares).ravel()
    return np.append(at, ends[-1])


def read(y: Array, rod: Rod, objects: Array, count: int) -> Pressed:
    """What is seen of strains (6 k,) among so many objects."""
    seen = _seen(rod, y.reshape(-1, 6), objects, MANY)
    loads, _, tip, R, _ = (np.asarray(each) for each in seen)
    at, forces = _stations(rod, MANY), loads.sum(axis=1)
    mean = np.divide(loads @ at, forces, out=np.full(len(forces), np.nan), where=forces > 0)
    return Pressed(tip, R, forces[:count], mean[:count], y, rod)


def numbers(objects: Sequence[tuple[int, Sequence[float]]]) -> Array:
    """Kinds and numbers of at least three objects, so that JAX compiles once."""
    known = [*objects, *[_FAR] * (3 - len(objects))]
    padded = [[*each, *[0.0] * (10 - len(each))] for _, each in known]
    return np.array([kind for kind, _ in known]), np.array(padded, float)


def pressed(
    arm: Arm, p: Array, objects: Sequence[tuple[int, Sequence[float]]], force: Array, n: int,
    steps: int = 12,
) -> Pressed:  # fmt: skip
    """The arm after pressures and a force at the tip have grown from rest.

    Objects are (0, both ends and radius) of a capsule, (1, point, normal, 0) of a half-space, (2,
    two points, radius, a third point) of a tube that the arm is in, (3, centre, axis, radius) of a
    ring about it.
    """
    known, y = numbers(objects), np.zeros(6 * n * len(arm.tubes))
    for share in np.arange(steps + 1) / steps:
        rod = make_rod(arm, share * np.asarray(p), n, share * np.asarray(force, float))
        y = minimum(y, rod, known, _FEW)
    for spring in _STIFFER:
        rod, y = refined(rod, y, known, len(arm.tubes))
        rod = rod._replace(spring=np.float64(spring))
        y = minimum(y, rod, known, MANY)
    return read(y, rod, known, len(objects))


def refined(rod: Rod, y: Array, objects: Array, segments: int) -> tuple[Rod, Array]:
    """The same at the same strains, with more elements, which are short where springs push."""
    n, many = len(rod.h) // segments, _ELEMENTS // segments
    strains = rod.free + np.einsum("kij,kj->ki", rod.root, y.reshape(-1, 6))
    loads = np.asarray(_seen(rod, y.reshape(-1, 6), objects, MANY)[0]).sum(axis=0)
    where = _stations(rod, MANY)[loads > 0]
    ends = np.cumsum(rod.h + rod.connector) - rod.connector
    h, old = [], []
    for first in range(0, n * segments, n):
        own = slice(first, first + n)
        fine = np.linspace(ends[first] - rod.h[first], ends[first + n - 1], 4001)
        away = np.abs(fine[:, None] - where).min(axis=1, initial=np.inf)
        size = np.minimum(_SHORTEST + _GROWTH * away, _LONGEST)
        count = np.append(0, np.cumsum((1 / size[1:] + 1 / size[:-1]) / 2))
        marks = np.interp(np.linspace(0, count[-1], many + 1), count, fine)
        h.append(np.diff(marks))
        middles = (marks[1:] + marks[:-1]) / 2
        old.append(first + np.minimum(np.searchsorted(ends[own], middles), n - 1))
    lengths, of = np.concatenate(h), np.concatenate(old)
    connector = np.zeros(len(lengths))
    connector[many - 1 :: many] = rod.connector[n - 1 :: n]
    root = rod.root[of] * np.sqrt(rod.h[of] / lengths)[:, None, None]
    same = {name: getattr(rod, name)[of] for name in ("free", "weight", "centroid", "radius")}
    hold = np.zeros((len(lengths), 3))
    there = rod._replace(h=lengths, root=root, connector=connector, hold=hold, **same)
    return there, np.linalg.solve(root, (strains[of] - there.free)[..., None]).ravel()


def pushed(
    state: Pressed, objects: Sequence[tuple[int, Sequence[float]]], force: Array, steps: int = 1
) -> Pressed:
    """The same with one more force at the tip, grown in steps."""
    known, y = numbers(objects), state.strains
    for share in np.arange(1, steps + 1) / steps:
        rod = state.rod._replace(force=state.rod.force + share * np.asarray(force, float))
        y = minimum(y, rod, known, MANY)
    return read(y, rod, known, len(objects))
