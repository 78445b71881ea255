"""Create, move, resize and save the objects of a scene for the studio."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array
from stiffopt.errors import FileError
from stiffopt.files import save_file
from stiffopt.model.obstacle import Obstacle
from stiffopt.model.scene import AllowedContact, Scene, SceneObject, load_scene
from stiffopt.studio.design import changed

NEW = ("sphere", "box", "capsule", "cylinder", "half_space")
"""Kinds of objects that can be added."""
_PLACES = ("centre", "start", "end", "point")  # fields of a shape that are points


def new_object(kind: str, others: Sequence[SceneObject], length: float) -> SceneObject:
    """Return a new object of a kind beside an arm of a length, with a unique name."""
    names = {each.name for each in others}
    name = next(f"{kind} {k}" for k in count(1) if f"{kind} {k}" not in names)
    size = round(0.06 * length, 3)
    middle, aside = (0.4 * length, 0.0, 0.6 * length), (0.0, 0.2 * length, 0.0)
    ends = {"start": _point(np.subtract(middle, aside)), "end": _point(np.add(middle, aside))}
    shapes: dict[str, dict[str, Any]] = {
        "sphere": {"centre": _point(middle), "radius": size},
        "box": {"centre": _point(middle), "size": (2 * size,) * 3},
        "capsule": {**ends, "radius": size},
        "cylinder": {**ends, "radius": size},
        "half_space": {"point": _point((0.5 * length, 0.0, 0.0)), "normal": (-1.0, 0.0, 0.0)},
    }
    return SceneObject(**{"name": name, kind: shapes[kind]})


def place_of(shape: Obstacle) -> Array:
    """Return the point (3,) of a shape at which its handle is, in m."""
    points = [getattr(shape, key) for key in _PLACES if hasattr(shape, key)]
    return np.asarray(np.mean(points or [shape.points[0]], axis=0))  # type: ignore[attr-defined]


def moved(item: SceneObject, place: ArrayLike) -> SceneObject:
    """Return an object moved so that its handle is at a point (3,), in m, to 0.1 mm."""
    way = np.asarray(place) - place_of(item.shape)
    parts: dict[str, Any] = {
        key: _point(np.add(getattr(item.shape, key), way))
        for key in _PLACES
        if hasattr(item.shape, key)
    }
    if not parts:
        parts = {"points": tuple(_point(np.add(p, way)) for p in item.shape.points)}  # type: ignore[attr-defined]
    return _with_shape(item, **parts)


def size_of(shape: Obstacle) -> float | None:
    """Return the radius of a shape or the longest edge of a box, in m; None if it has neither."""
    size = getattr(shape, "size", None)
    return getattr(shape, "radius", None) if size is None else max(size)


def resized(item: SceneObject, size: float) -> SceneObject:
    """Return an object of another size, see `size_of`; a box keeps its proportions."""
    edges = getattr(item.shape, "size", None)
    if edges is not None:
        return _with_shape(item, size=tuple(edge * size / max(edges) for edge in edges))
    return _with_shape(item, radius=size) if hasattr(item.shape, "radius") else item


def leant_on(item: SceneObject, *, allowed: bool) -> SceneObject:
    """Return an object that allows or forbids contact."""
    contact = item.contact or AllowedContact()
    return changed(item, contact=changed(contact, allowed=allowed))


def replaced(objects: Sequence[SceneObject], item: SceneObject) -> tuple[SceneObject, ...]:
    """Return objects in which an item replaces that with its name."""
    return tuple(item if each.name == item.name else each for each in objects)


def save_scene(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene file; only another scene file is overwritten.

    Raises `FileError`: the file exists and is not a scene file, or cannot be written.
    """
    if Path(path).suffix.lower() not in (".yaml", ".yml"):
        raise FileError(path, "is no name of a scene file; expected one that ends in .yaml")
    if Path(path).exists():
        try:
            load_scene(path)
        except FileError:
            raise FileError(path, "exists and is no scene file; give another name") from None
    save_file(path, "scene", scene)


def _with_shape(item: SceneObject, **parts: Any) -> SceneObject:
    return changed(item, **{item.shape.key: changed(item.shape, **parts)})


def _point(values: ArrayLike) -> tuple[float, ...]:
    return tuple((np.round(np.asarray(values, dtype=float), 4) + 0.0).tolist())
