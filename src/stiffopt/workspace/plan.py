"""What a map is of: the arm, the stiffnesses, the samples, the cells; and a block of it."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stiffopt.errors import EquilibriumError, InputError
from stiffopt.model.arguments import Measure, checked_measure
from stiffopt.model.compiled import BatchFunction, compiling_at_once, interpreted, library
from stiffopt.model.compliance import Boundary, Frame, Kind, directional_stiffness
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.numeric import checked_integer, checked_number
from stiffopt.model.shape import Shape
from stiffopt.workspace.sampling import Grid, QuasiRandom, Sampling, checked_sampling
from stiffopt.workspace.table import FARTHEST, CellTable, cell_indices, cell_keys

Vector = NDArray[np.float64]

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Directions of a map unless others are named."""
_FREE_SAMPLES = 1_000_000
_LOADED_SAMPLES = 1_000  # an equilibrium takes thousands of times longer than a closed form
_FREE_BLOCK = 1 << 15
_COMPILED_FROM = 50_000  # samples; fewer take less time than a compiler
_NAME = "workspace_map_1"  # to be counted up when what `MapPlan._outputs` gives is changed
_LOADED_BLOCK = 16


@dataclass(frozen=True)
class Block:
    """What the samples of one block came to.

    Attributes
    ----------
    table : the cells that they fell into.
    lost : number of samples at which the arm has no stable equilibrium.
    low, high : (3,) least and greatest coordinates of the tip, in m.
    """

    table: CellTable
    lost: int
    low: Vector
    high: Vector


@dataclass(frozen=True)
class MapPlan:
    """All that decides what a map comes to.

    Attributes
    ----------
    robot : the arm, with the load at its tip.
    measures : the stiffnesses; their directions are of unit length.
    sampling : the pressures.
    cell : size of a cell, in m.
    """

    robot: Manipulator
    measures: tuple[Measure, ...]
    sampling: Sampling
    cell: float

    @classmethod
    def of(
        cls,
        robot: Manipulator,
        *,
        directions: Iterable[ArrayLike] | None = None,
        kind: Kind = "translation",
        boundary: Boundary = "free",
        frame: Frame = "base",
        samples: int | None = None,
        levels: int | None = None,
        cell: float = 0.01,
        seed: int = 0,
    ) -> "MapPlan":
        """Plan from arguments; see `map_workspace`.

        Raises
        ------
        InputError
            If an argument is wrong.
        """
        if not isinstance(robot, Manipulator):
            raise InputError(
                f"expected a Manipulator, as load_robot returns it, not {type(robot).__name__}"
            )
        measures = _measures(AXES if directions is None else directions, kind, boundary, frame)
        sampling = _sampling(robot, samples, levels, checked_integer("seed", seed, 0))
        return cls(robot, measures, sampling, _cell_size(robot, cell))

    # -- blocks -----------------------------------------------------------------------------

    @property
    def total(self) -> int:
        """Number of samples."""
        return self.sampling.total

    @property
    def block_size(self) -> int:
        """Samples of a block, the last one excepted."""
        return _LOADED_BLOCK if self.robot.is_loaded else _FREE_BLOCK

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return -(-self.total // self.block_size)

    def samples_in(self, blocks: int) -> int:
        """Number of samples in so many first blocks."""
        return min(blocks * self.block_size, self.total)

    def prepare(self) -> None:
        """Compile what blocks need; then they may be evaluated by several threads at once."""
        if not self.robot.is_loaded:
            self._function  # noqa: B018

    def evaluate(self, index: int) -> Block:
        """Result of one block, counted from 0."""
        start, stop = self.samples_in(index), self.samples_in(index + 1)
        pressures = self.sampling.pressures(start, stop)
        evaluate = self._at_equilibria if self.robot.is_loaded else self._in_closed_form
        position, stiffness = evaluate(pressures)
        sample = np.arange(start, stop)
        good = np.isfinite(position).all(axis=1) & np.isfinite(stiffness).all(axis=0)
        if not good.all():
            position, stiffness, sample = position[good], stiffness[:, good], sample[good]
        return Block(
            CellTable.of_samples(
                cell_keys(cell_indices(position, self.cell)), stiffness, sample
            ),
            int((~good).sum()),
            position.min(axis=0, initial=np.inf),
            position.max(axis=0, initial=-np.inf),
        )  # fmt: skip

    def _in_closed_form(self, pressures: Vector) -> tuple[Vector, Vector]:
        """Positions (k, 3) and stiffnesses (m, k) of the arm without loads."""
        position, stiffness = self._function.many(pressures, self.robot.numbers, threads=1)
        return position[:, :, 0], np.ascontiguousarray(stiffness[:, :, 0].T)

    def _at_equilibria(self, pressures: Vector) -> tuple[Vector, Vector]:
        """The same of the loaded arm; NaN where it has no equilibrium."""
        position = np.full((len(pressures), 3), np.nan)
        stiffness = np.full((len(self.measures), len(pressures)), np.nan)
        evaluator = self.robot.evaluator(("workspace", self.measures), self._outputs)
        for row, p in enumerate(pressures):
            evaluator.restart()  # each from rest: it must not matter which came before
            try:
                at, values = evaluator(p)
            except EquilibriumError:
                continue
            position[row], stiffness[:, row] = at[:, 0], values[:, 0]
        return position, stiffness

    @property
    def _function(self) -> BatchFunction:
        """Outputs at pressures (n,), in machine code if that pays; the robot keeps it."""

        def functions() -> list[ca.Function]:
            return [self.robot.tip_function(_NAME, self._outputs)]

        def make() -> BatchFunction:
            content = (_NAME, self.robot.layout.skeleton, self.measures)
            pays = self.total >= _COMPILED_FROM
            with compiling_at_once():
                code = library(content, functions, build_missing=pays)
            return interpreted(functions)[_NAME] if code is None else code.function(_NAME)

        return self.robot.kept((_NAME, self.measures), make)

    def _outputs(self, shape: Shape, _: Any) -> list[Any]:
        """Position (3, 1) of the tip and its stiffnesses (m, 1)."""
        return [shape.position, ca.vertcat(*(_stiffness(shape, m) for m in self.measures))]

    # -- what is written down ---------------------------------------------------------------

    @property
    def unit(self) -> Literal["N/m", "N*m/rad"]:
        """Unit of the stiffnesses."""
        return "N/m" if self.measures[0].kind == "translation" else "N*m/rad"

    @cached_property
    def record(self) -> dict[str, Any]:
        """The plan as plain data, enough to make it again."""
        from stiffopt import __version__

        first = self.measures[0]
        return {
            "robot": self.robot.description.name,
            "robot_description": self.robot.description.model_dump(mode="json"),
            "tip_load": list(self.robot.tip_load),
            "resolution": self.robot.resolution,
            "pressure_min_pa": list(self.sampling.lower),
            "pressure_max_pa": list(self.sampling.upper),
            "directions": [list(measure.direction) for measure in self.measures],
            "kind": first.kind,
            "boundary": first.boundary,
            "frame": first.frame,
            "stiffness_unit": self.unit,
            **self.sampling.record(),
            "cell_m": self.cell,
            "block_size": self.block_size,
            "stiffopt_version": __version__,
        }

    @cached_property
    def token(self) -> str:
        """Name of this plan that no other has."""
        text = json.dumps(self.record, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def direction_name(direction: Sequence[float]) -> str:
    """Return ``x`` for an axis of the frame, ``-x`` or ``(0.6, 0.8, 0)`` for others."""
    for axis, name in zip(AXES, "xyz", strict=True):
        if tuple(direction) == axis:
            return name
        if tuple(direction) == tuple(-part for part in axis):
            return f"-{name}"
    return f"({', '.join(f'{round(part, 3) + 0.0:g}' for part in direction)})"


def _stiffness(shape: Shape, measure: Measure) -> Any:
    return directional_stiffness(
        shape.compliance,
        shape.rotation,
        ca.DM(measure.direction),
        frame=measure.frame,
        kind=measure.kind,
        boundary=measure.boundary,
    )


def _measures(
    directions: Iterable[ArrayLike], kind: Kind, boundary: Boundary, frame: Frame
) -> tuple[Measure, ...]:
    try:
        given = list(directions)
    except TypeError:
        raise InputError(f"directions must be a list of directions, not {directions!r}") from None
    if given and all(np.ndim(one) == 0 and not isinstance(one, str) for one in given):
        raise InputError(f"directions must be a list of directions, not one: [{given!r}]")
    measures = tuple(checked_measure(one, kind, boundary, frame) for one in given)
    if not measures:
        raise InputError("directions must not be empty; name at least one direction")
    for number, measure in enumerate(measures):
        if measure in measures[:number]:
            raise InputError(f"direction {direction_name(measure.direction)} is named twice")
    return measures


def _sampling(robot: Manipulator, samples: int | None, levels: int | None, seed: int) -> Sampling:
    limits = tuple(robot.pressure_min.tolist()), tuple(robot.pressure_max.tolist())
    if levels is not None:
        if samples is not None:
            raise InputError("give samples or levels, not both")
        return checked_sampling(Grid(*limits, checked_integer("levels", levels, 2)))
    if samples is None:
        samples = _LOADED_SAMPLES if robot.is_loaded else _FREE_SAMPLES
    return checked_sampling(QuasiRandom(*limits, checked_integer("samples", samples, 1), seed))


def _cell_size(robot: Manipulator, cell: float) -> float:
    size = checked_number("cell", cell)
    # a segment that grows to eight times its length breaks: cells beyond that need no number
    smallest = 8 * robot.length / FARTHEST
    if not smallest <= size <= robot.length:
        raise InputError(
            f"cell, the size of a cell, must be between {smallest * 1e3:.2g} mm and the arm's "
            f"length of {robot.length * 1e3:g} mm; got {size * 1e3:g} mm"
        )
    return size
