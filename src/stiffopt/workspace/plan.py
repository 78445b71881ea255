"""`MapPlan`: arm, stiffnesses, samples and cells of a workspace map, and the evaluation of a block.

Sample i of a plan depends only on i (and a seed), so any block of samples can be computed anywhere
and the pressures of a sample follow from its number. Sampling uses integer arithmetic up to the
last step, which rounds the same on every machine.
"""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cache, cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from stiffopt.arrays import Array, Flags
from stiffopt.directions import direction_name
from stiffopt.errors import EquilibriumError, InputError, shown
from stiffopt.model.arguments import (
    DirectionalMeasure,
    checked_integer,
    checked_measure,
    checked_number,
)
from stiffopt.model.batch import BatchFunction
from stiffopt.model.compiled import compiling_at_once, interpreted, library
from stiffopt.model.compliance import Boundary, Frame, Kind, directional_stiffness
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.model.shape import Shape
from stiffopt.workspace.table import FARTHEST, CellTable, MapPart, cell_indices, cell_keys

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Default directions of a map."""
_NAME = "workspace_map_1"  # increase the number when `MapPlan._outputs` changes
MOST_SAMPLES = 10**12
"""Largest number of samples of a map."""


@dataclass(frozen=True)
class MapTuning:
    """Sizes and times of a map run; none changes the cells' values for a given plan."""

    # default number of samples of a free arm, and of one with gravity or loads, whose equilibria
    # take thousands of times longer than the closed form
    samples: int = 1_000_000
    loaded_samples: int = 1_000
    block: int = 1 << 15  # number of samples that are evaluated at a time, likewise
    loaded_block: int = 16
    clear_from: int = 4096  # number of samples from which machine code of distances pays
    # number of samples from which machine code pays for its compilation
    compiled_from: int = 50_000
    # cells that one map may fill; each takes about 0.5 kB while it is made
    max_cells: int = 1_500_000
    checkpoint: float = 5.0  # time between two checkpoints on disk, in s
    checkpoint_share: float = 0.05  # share of the time that checkpoints may take
    # time to wait for a scheduler, and for workers while there are none, in s
    cluster_patience: float = 30.0
    retries: int = 3  # of a block that fails for a temporary reason, such as a lost worker


TUNING = MapTuning()


@dataclass(frozen=True)
class Sampling(ABC):
    """Numbered samples of the pressures, between the limits of each channel, in Pa."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    @abstractmethod
    def total(self) -> int:
        """Number of samples."""

    @abstractmethod
    def shares(self, start: int, stop: int) -> Array:
        """Return samples start to stop - 1 as shares (k, n) of each channel's range, 0 to 1."""

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return the parameters of the sampling, as plain data."""

    def pressures(self, start: int, stop: int) -> Array:
        """Return pressures (k, n) of samples start to stop - 1, in Pa."""
        lower, upper = np.array(self.lower), np.array(self.upper)
        return np.asarray(lower + (upper - lower) * self.shares(start, stop))


@dataclass(frozen=True)
class QuasiRandom(Sampling):
    """Additive recurrence with the generalised golden ratio (M. Roberts, 2018), in 64 bits.

    Sample i is ``frac(shift + (i + 1) ratio^-j)`` of the range of channel j, in fixed point; the
    seed determines the shifts.
    """

    count: int
    seed: int = 0

    @property
    def total(self) -> int:
        """Number of samples."""
        return self.count

    def shares(self, start: int, stop: int) -> Array:
        """Return samples start to stop - 1 as shares (k, n) of the channels' ranges, in [0, 1)."""
        n = len(self.lower)
        steps = np.array(_golden_steps(n), dtype=np.uint64)
        shifts = np.array([_shift(self.seed, channel) for channel in range(n)], dtype=np.uint64)
        numbers = np.arange(start + 1, stop + 1, dtype=np.uint64)
        fixed = numbers[:, np.newaxis] * steps + shifts  # modulo 2^64
        return np.asarray((fixed >> np.uint64(11)).astype(np.float64) * 2.0**-53)

    def record(self) -> dict[str, Any]:
        """Return kind, count and seed."""
        return {"sampling": "quasi-random", "samples": self.count, "seed": self.seed}


@dataclass(frozen=True)
class Grid(Sampling):
    """Equally spaced levels of each channel, limits included; the last channel runs fastest."""

    levels: int  # of each channel, at least 2

    @property
    def total(self) -> int:
        """Number of samples: levels to the power of the number of channels."""
        return int(self.levels ** len(self.lower))

    def shares(self, start: int, stop: int) -> Array:
        """Return samples start to stop - 1 as shares (k, n) of each channel's range, 0 to 1."""
        left = np.arange(start, stop, dtype=np.int64)
        digits = np.empty((len(left), len(self.lower)))
        for channel in reversed(range(len(self.lower))):
            left, digits[:, channel] = np.divmod(left, self.levels)
        return digits / (self.levels - 1)

    def record(self) -> dict[str, Any]:
        """Return kind, levels and the resulting number of samples."""
        return {"sampling": "grid", "samples": self.total, "levels": self.levels}


@cache
def _golden_steps(n: int) -> tuple[int, ...]:
    """Return the steps per channel in units of 2^-64, from the ratio r^(n+1) = r + 1."""
    with localcontext() as context:
        context.prec = 60
        ratio, change = Decimal(2), Decimal(1)
        while abs(change) > Decimal("1e-50"):  # Newton's method converges from above
            change = (ratio ** (n + 1) - ratio - 1) / ((n + 1) * ratio**n - 1)
            ratio -= change
        return tuple(int(2**64 / ratio**power) for power in range(1, n + 1))


def _shift(seed: int, channel: int) -> int:
    digest = hashlib.sha256(f"stiffopt workspace {seed} {channel}".encode()).digest()
    return int.from_bytes(digest[:8], "big")


@dataclass(frozen=True)
class MapPlan:
    """Everything that determines the values of a map."""

    robot: Manipulator  # the arm, with the load at its tip
    measures: tuple[DirectionalMeasure, ...]  # the stiffness measures (m,), with unit directions
    sampling: Sampling  # the sampled pressures
    cell: float  # edge length of a cell, in m
    scene: Scene | None = None  # objects that the body keeps clear of, or None

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
        scene: Scene | None = None,
    ) -> "MapPlan":
        """Return the plan for the arguments of `map_workspace`, after checking them.

        Raises `InputError`: one of them is wrong.
        """
        if not isinstance(robot, Manipulator):
            raise InputError(
                f"expected a Manipulator, as load_robot returns it, not {type(robot).__name__}"
            )
        measures = _measures(AXES if directions is None else directions, kind, boundary, frame)
        sampling = _sampling(robot, samples, levels, checked_integer("seed", seed, 0))
        if scene is not None:
            if not isinstance(scene, Scene):
                raise InputError(f"expected a Scene, as load_scene returns it, not {shown(scene)}")
            scene.check_against(robot.description)
        return cls(robot, measures, sampling, _cell_size(robot, cell), scene)

    # -- blocks -----------------------------------------------------------------------------

    @property
    def total(self) -> int:
        """Number of samples."""
        return self.sampling.total

    @property
    def block_size(self) -> int:
        """Number of samples of a block, except the last."""
        return TUNING.loaded_block if self.robot.is_loaded else TUNING.block

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return -(-self.total // self.block_size)

    def samples_in(self, blocks: int) -> int:
        """Return the number of samples in the first `blocks` blocks."""
        return min(blocks * self.block_size, self.total)

    def prepare(self) -> None:
        """Compile the functions of blocks; then several threads may evaluate blocks at once."""
        if not self.robot.is_loaded:
            self._function  # noqa: B018
        if self.scene is not None and self.total >= TUNING.clear_from:
            with compiling_at_once():
                self._is_clear(self.sampling.pressures(0, TUNING.clear_from))

    def evaluate(self, index: int) -> MapPart:
        """Return the result of one block, counted from 0."""
        start, stop = self.samples_in(index), self.samples_in(index + 1)
        pressures = self.sampling.pressures(start, stop)
        evaluate = self._at_equilibria if self.robot.is_loaded else self._in_closed_form
        position, stiffness = evaluate(pressures)
        sample = np.arange(start, stop)
        finite = np.isfinite(position).all(axis=1) & np.isfinite(stiffness).all(axis=0)
        good = np.asarray(finite)
        lost = int((~good).sum())
        if self.scene is not None:
            good[good] = self._is_clear(pressures[good])
        if not good.all():
            position, stiffness, sample = position[good], stiffness[:, good], sample[good]
        keys = cell_keys(cell_indices(position, self.cell))
        return MapPart(
            blocks=1,
            lost=lost,
            low=position.min(axis=0, initial=np.inf),
            high=position.max(axis=0, initial=-np.inf),
            table=CellTable.of_samples(keys, stiffness, sample),
        )

    def _is_clear(self, pressures: Array) -> Flags:
        """Return whether the body keeps the scene's clearance, at each of the pressures (k, n)."""
        assert self.scene is not None
        return self.robot.clearance(pressures, self.scene) >= self.scene.clearance

    def _in_closed_form(self, pressures: Array) -> tuple[Array, Array]:
        """Return positions (k, 3) and stiffnesses (m, k) of the arm without loads."""
        position, stiffness = self._function.many(pressures, self.robot.numbers, threads=1)
        return position[:, :, 0], np.ascontiguousarray(stiffness[:, :, 0].T)

    def _at_equilibria(self, pressures: Array) -> tuple[Array, Array]:
        """Return the same for the loaded arm; NaN where it has no equilibrium."""
        position = np.full((len(pressures), 3), np.nan)
        stiffness = np.full((len(self.measures), len(pressures)), np.nan)
        evaluator = self.robot.evaluator(("workspace", self.measures), self._outputs)
        for row, p in enumerate(pressures):
            evaluator.restart()  # from rest, so that the order of samples does not matter
            try:
                at, values = evaluator(p)
            except EquilibriumError:
                continue
            position[row], stiffness[:, row] = at[:, 0], values[:, 0]
        return position, stiffness

    @property
    def _function(self) -> BatchFunction:
        """Outputs at pressures (n,), in machine code if that pays; the robot caches it."""

        def functions() -> list[ca.Function]:
            return [self.robot.tip_function(_NAME, self._outputs)]

        def make() -> BatchFunction:
            content = (_NAME, self.robot.layout.skeleton, self.measures)
            pays = self.total >= TUNING.compiled_from
            with compiling_at_once():
                code = library(content, functions, build_missing=pays)
            return interpreted(functions)[_NAME] if code is None else code.function(_NAME)

        return self.robot.kept((_NAME, self.measures), make)

    def _outputs(self, shape: Shape, _: Any) -> list[Any]:
        """Return the position (3, 1) of the tip and its stiffnesses (m, 1)."""
        stiffness = (
            directional_stiffness(shape.compliance, shape.rotation, ca.DM(d), frame, kind, boundary)
            for d, kind, boundary, frame in self.measures
        )
        return [shape.position, ca.vertcat(*stiffness)]

    # -- record on disk ---------------------------------------------------------------------

    @property
    def unit(self) -> Literal["N/m", "N*m/rad"]:
        """Unit of the stiffnesses."""
        return "N/m" if self.measures[0].kind == "translation" else "N*m/rad"

    @cached_property
    def record(self) -> dict[str, Any]:
        """The plan as plain data, enough to recreate it."""
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
            **({} if self.scene is None else {"scene": self._scene_record}),
            "block_size": self.block_size,
            "stiffopt_version": __version__,
        }

    @property
    def _scene_record(self) -> dict[str, Any]:
        assert self.scene is not None
        return self.scene.model_dump(mode="json", by_alias=True, exclude_none=True)

    @cached_property
    def token(self) -> str:
        """Hash that identifies this plan."""
        text = json.dumps(self.record, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _measures(
    directions: Iterable[ArrayLike], kind: Kind, boundary: Boundary, frame: Frame
) -> tuple[DirectionalMeasure, ...]:
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
        sampling: Sampling = Grid(*limits, checked_integer("levels", levels, 2))
    else:
        if samples is None:
            samples = TUNING.loaded_samples if robot.is_loaded else TUNING.samples
        sampling = QuasiRandom(*limits, checked_integer("samples", samples, 1), seed)
    if sampling.total > MOST_SAMPLES:
        raise InputError(
            f"{sampling.total:.3g} samples are too many; expected at most {MOST_SAMPLES:.0e}. "
            "Take fewer levels, or quasi-random samples"
        )
    return sampling


def _cell_size(robot: Manipulator, cell: float) -> float:
    size = checked_number("cell", cell)
    # no segment grows to eight times its length, so no cell is farther away
    smallest = 8 * robot.length / FARTHEST
    if not smallest <= size <= robot.length:
        raise InputError(
            f"cell, the size of a cell, must be between {smallest * 1e3:.2g} mm and the arm's "
            f"length of {robot.length * 1e3:g} mm; got {size * 1e3:g} mm"
        )
    return size
