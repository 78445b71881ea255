"""`Layout`: what formulas and machine code of an arm depend on, apart from its numbers.

Two arms have the same layout if they differ only in numbers: lengths, radii, moduli, compensation
and corrections.  These numbers are arguments of the formulas of the unloaded shape and of the
section functions of the loaded rod, so one compiled library serves every arm of a layout.

Formulas that an arm does not need are left out, which is part of the layout: a connector, a dead
band, a centroid off the axis, an inclined section; and, together, gains and offsets of channels and
the limits of bending that a calibration finds.  So there is one library for arms as drawn and one
for calibrated arms, which is about a tenth slower.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from stiffopt.arrays import Array
from stiffopt.model.actuation import SectionGeometry, StrainLaw
from stiffopt.model.codegen import dense
from stiffopt.model.description import RobotDescription
from stiffopt.model.kinematics import Actuation
from stiffopt.model.laws import strain_law
from stiffopt.model.parameters import explicit
from stiffopt.model.segment import Compensation, Corrections, Segment
from stiffopt.model.shape import FreeShape
from stiffopt.schema import Schema

_NOT_IN_FORMULAS = {"chambers", "channels", "density", "history", "inner_radius"}
"""Keys of a segment that act through its section's geometry, or do not affect statics."""
_SWITCHES = {"connector", "dead_band"}
"""Keys whose formulas are left out where they are zero."""


@dataclass(frozen=True)
class Layout:
    """What formulas and machine code of an arm are made for.

    `skeleton`: the arm's segments without their numbers; equal for arms of the same layout.
    `example`: some arm of this layout.
    """

    skeleton: str
    example: RobotDescription = field(compare=False, repr=False)


@dataclass(frozen=True)
class SymbolicArm:
    """The formulas of all arms of a layout."""

    numbers: ca.SX  # the arm's numbers (k,), see `numbers_of`
    actuation: Actuation  # sections and margins as functions of the pressures and these numbers
    # centroid (2,) of each segment's section, in m; sparse if it lies on the axis
    centroids: tuple[ca.SX, ...]
    tip: FreeShape  # the unloaded arm up to its tip


def layout_of(description: RobotDescription) -> Layout:
    """Return the layout of an arm."""
    drawn = is_as_drawn(description)
    segments = [
        [
            [
                (path, "number" if is_number else value)
                for path, value, is_number in _leaves(segment, drawn)
            ],
            [name for name, _ in _geometry_numbers(geometry)],
            segment.n_channels,
        ]
        for segment, geometry in _parts(description)
    ]
    return Layout(json.dumps(segments, sort_keys=True), description)


def numbers_of(description: RobotDescription) -> Array:
    """Return the numbers (k,) of an arm, in SI, in the order of its layout."""
    found: list[float] = []
    drawn = is_as_drawn(description)
    for segment, geometry in _parts(description):
        found += [value for _, value, is_number in _leaves(segment, drawn) if is_number]
        for _, values in _geometry_numbers(geometry):
            found += np.ravel(values).tolist()
    return np.array(found)


@lru_cache(maxsize=64)
def symbolic_arm(layout: Layout) -> SymbolicArm:
    """Return the formulas of a layout; cached."""
    symbols: list[ca.SX] = []

    def symbol(name: str, *shape: int) -> ca.SX:
        symbols.append(ca.SX.sym(name, *shape))
        return symbols[-1]

    segments: list[Segment] = []
    laws: list[StrainLaw] = []
    drawn = is_as_drawn(layout.example)
    for segment, geometry in _parts(layout.example):
        segments.append(_with_symbols(segment, symbol, drawn))
        laws.append(strain_law(segments[-1], _symbolic_geometry(geometry, symbol)))
    numbers = ca.vertcat(*(ca.vec(found) for found in symbols))
    description = layout.example.model_copy(update={"segments": tuple(segments)})
    actuation = Actuation.of(description, laws)
    centroids = tuple(ca.SX(law.geometry.centroid) for law in laws)
    return SymbolicArm(numbers, actuation, centroids, FreeShape.of(description, actuation))


def free_tip_function(
    layout: Layout,
    name: str,
    outputs: Callable[[FreeShape, Any], list[Any]],
    n_parameters: int = 0,
) -> ca.Function:
    """Return a function of pressures (n,) and parameters: the arm's numbers, then a caller's own.

    `outputs`: function from the tip's shape and the symbols of the caller's parameters to outputs.
    """
    arm = symbolic_arm(layout)
    own = ca.SX.sym("own", n_parameters)
    found = ca.cse([ca.densify(output) for output in outputs(arm.tip, own)])
    inputs = [*arm.tip.inputs, ca.vertcat(arm.numbers, own)]
    return dense(ca.Function(name, inputs, found))


def is_as_drawn(description: RobotDescription) -> bool:
    """Return whether there are no gains and offsets, and no bending limits or lengthening."""
    for segment in description.segments:
        corrections = segment.corrections or Corrections()
        compensation = segment.compensation or Compensation()
        if set(corrections.gain) - {1.0} or any(corrections.offset):
            return False
        if compensation.bending_radius or compensation.lengthening:
            return False
    return True


def _parts(description: RobotDescription) -> Iterator[tuple[Segment, SectionGeometry]]:
    """Yield the segments with all needed defaults written out, and their effective geometry."""
    drawn = is_as_drawn(description)
    for segment in explicit(description).segments:
        corrections = segment.corrections or Corrections()
        geometry = SectionGeometry.of(segment).turned(np.array(corrections.azimuth))
        left_out = {"azimuth": (), **({"gain": (), "offset": ()} if drawn else {})}
        corrections = corrections.model_copy(update=left_out)
        yield segment.model_copy(update={"corrections": corrections}), geometry


def _is_number(key: str, value: Any, drawn: bool) -> bool:
    if not isinstance(value, float):
        return False
    if key in ("bending_radius", "lengthening"):
        return not drawn
    return key not in _SWITCHES or value != 0


def _fields(schema: Schema) -> Iterator[tuple[str, Any]]:
    for name in type(schema).model_fields:
        if name not in _NOT_IN_FORMULAS:
            yield name, getattr(schema, name)


def _leaves(node: Any, drawn: bool, path: str = "") -> Iterator[tuple[str, Any, bool]]:
    """Yield path and value of each entry of a segment, and whether it is a number of the arm."""
    if isinstance(node, Schema):
        for name, value in _fields(node):
            yield from _leaves(value, drawn, f"{path}.{name}")
    elif isinstance(node, tuple):
        for index, item in enumerate(node):
            yield from _leaves(item, drawn, f"{path}[{index}]")
    else:
        key = path.rpartition(".")[2].partition("[")[0]
        yield path, node, _is_number(key, node, drawn)


def _with_symbols(node: Any, symbol: Any, drawn: bool, key: str = "") -> Any:
    """Copy a node with a symbol for each number, in the order of `_leaves`; not validated."""
    if isinstance(node, Schema):
        update = {name: _with_symbols(value, symbol, drawn, name) for name, value in _fields(node)}
        return node.model_copy(update=update)
    if isinstance(node, tuple):
        return tuple(_with_symbols(item, symbol, drawn, key) for item in node)
    return symbol(key) if _is_number(key, node, drawn) else node


def _geometry_numbers(geometry: SectionGeometry) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of a geometry by name, without those that its kind of section lacks."""
    yield "area", geometry.area
    if geometry.centroid.any():
        yield "centroid", geometry.centroid
    yield "second moments", np.diagonal(geometry.second_moment)
    if geometry.second_moment[0, 1] != 0:
        yield "product of inertia", geometry.second_moment[0, 1]
    yield "channel_force", geometry.channel_force
    yield "channel_moment", geometry.channel_moment.T  # by columns


def _symbolic_geometry(geometry: SectionGeometry, symbol: Any) -> SectionGeometry:
    """Return the same geometry in symbols, in the order of `_geometry_numbers`."""
    found = {name: symbol(name, np.size(values)) for name, values in _geometry_numbers(geometry)}
    second_moment = ca.diag(found["second moments"])
    if "product of inertia" in found:
        second_moment[0, 1] = second_moment[1, 0] = found["product of inertia"]
    channels = len(geometry.channel_force)
    return SectionGeometry(
        area=found["area"],
        centroid=found.get("centroid", ca.SX(2, 1)),
        second_moment=second_moment,
        channel_force=found["channel_force"],
        channel_moment=ca.reshape(found["channel_moment"], channels, 2),
    )
