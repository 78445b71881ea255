"""`map_workspace` computes a workspace map, or resumes one; `open_workspace_map` reads it."""

import os
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stiffopt.errors import FileError, InputError, require_package
from stiffopt.model.arguments import checked_integer
from stiffopt.model.compliance import Boundary, Frame, Kind
from stiffopt.model.description import RobotDescription
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene
from stiffopt.model.stopping import Cancel, checkpoint, giving_up
from stiffopt.workspace.map import WorkspaceMap
from stiffopt.workspace.plan import TUNING, MapPlan
from stiffopt.workspace.store import MapStore, is_vacant
from stiffopt.workspace.table import CellTable, Gathering, MapPart
from stiffopt.workspace.workers import Cluster, Threads, results

Report = Callable[[int, int], None]


def map_workspace(
    robot: Manipulator,
    path: str | os.PathLike[str] | None = None,
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
    scheduler: str | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
    timeout: float | None = None,
    cancel: Cancel | None = None,
) -> WorkspaceMap:
    """Map where an arm's tip can be, and the range of its stiffness there, by sampling pressures.

    The same arguments give the same map to the last bit, with any number of threads or workers and
    after any number of interruptions.

    Parameters
    ----------
    robot : Manipulator
        The arm, with any load at its tip.
    path : path, optional
        Folder of the map, a Zarr group. An unfinished map there is resumed; a complete one is
        returned as it is. Without a path nothing is stored.
    directions : list of (3,), optional
        Of the stiffnesses; need not be of unit length. By default the axes x, y and z.
    kind, boundary, frame
        Of the stiffnesses, as in `Manipulator.stiffness`.
    samples : int, optional
        Number of quasi-random samples; by default a million, for an arm with gravity or load 1000.
    levels : int, optional
        Instead of `samples`: a full grid with this number of levels of each channel, limits
        included.
    cell : float
        Size of a cell in m.
    seed : int
        Of the quasi-random samples.
    scene : Scene, optional
        Samples whose body is nearer to its objects than its clearance are left out.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers evaluate the samples.
    threads : int, optional
        Number of threads of this process; by default one for each core. The result does not depend
        on it.
    overwrite : bool
        Replace a map that exists at the path.
    progress : callable, optional
        Called now and then with the number of samples done and of all samples. An exception that it
        raises stops the run, which can then be resumed.
    timeout, cancel : optional
        When to stop, as for `PressureSolver.solve`; a run with a path can then be resumed.

    Returns
    -------
    WorkspaceMap

    Raises
    ------
    InputError
        An argument is wrong, or the cells are too small.
    FileError
        The path cannot be used, or holds something else.
    MissingExtraError
        Zarr (extra ``map``) or distributed (extra ``dask``) is needed and not installed.
    ClusterError
        The cluster cannot be reached, or failed.
    OutOfTimeError, CancelledError
        `timeout` or `cancel` stopped it.
    """
    plan = MapPlan.of(
        robot, directions=directions, kind=kind, boundary=boundary, frame=frame, samples=samples,
        levels=levels, cell=cell, seed=seed, scene=scene,
    )  # fmt: skip
    if threads is not None:
        checked_integer("threads", threads, 1)
        if scheduler is not None:
            raise InputError("give threads or a scheduler, not both")

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(done, total)
        checkpoint()

    with giving_up(timeout, cancel), ExitStack() as stack:
        store = None if path is None else _opened(path, plan, overwrite, stack)
        if store is not None and store.is_complete:
            store.tidy()
            return _as_map(plan, store.read(), store.path, evaluated=0)
        begun = None if store is None else store.load()
        run = _MapRun(plan, store, begun, report)
        workers: Threads | Cluster = (
            stack.enter_context(Threads(plan, threads))
            if scheduler is None
            else stack.enter_context(Cluster(plan, scheduler))
        )
        return run.finish(workers)


def open_workspace_map(path: str | os.PathLike[str]) -> WorkspaceMap:
    """Read a complete map from its folder.

    Raises
    ------
    FileError
        There is none, or it is not complete.
    MissingExtraError
        Zarr (extra ``map``) is not installed.
    """
    require_package("zarr", "map")
    store = MapStore(path)
    if not store.is_complete:
        raise FileError(path, "is not complete; run the command that made it again to continue")
    return _as_map(_plan_of(store), store.read(), store.path, evaluated=0)


def _opened(
    path: str | os.PathLike[str], plan: MapPlan, overwrite: bool, stack: ExitStack
) -> MapStore:
    """Return the locked store at a path, an unfinished one or a new one."""
    require_package("zarr", "map")
    parent = Path(path).resolve().parent
    if not parent.is_dir():
        raise FileError(path, f"cannot be written: there is no folder '{parent}'")
    if not is_vacant(path):
        store = MapStore(path)
        if not overwrite:
            store.check(plan.record)
            stack.enter_context(store.locked())
            return MapStore(path)  # read again, now that it is locked
        with store.locked():
            store = MapStore.create(path, plan.record, overwrite=True)
    else:
        store = MapStore.create(path, plan.record, overwrite=False)
    stack.enter_context(store.locked())
    return store


class _MapRun:
    """A run of the sampling, from the last checkpoint to the end."""

    def __init__(
        self, plan: MapPlan, store: MapStore | None, begun: MapPart | None, report: Report
    ) -> None:
        if begun is None:
            none = CellTable.empty(len(plan.measures))
            begun = MapPart(0, 0, np.full(3, np.inf), np.full(3, -np.inf), none)
        self._plan, self._store, self._report = plan, store, report
        self._state, self._begun = begun, begun.blocks
        self._gathering = Gathering(begun.table, TUNING.max_cells)
        self._saved = begun.blocks
        self._whole = True  # False during an update, in case it is interrupted
        self._next_save = monotonic() + TUNING.checkpoint

    def finish(self, workers: Threads | Cluster) -> WorkspaceMap:
        """Evaluate the missing blocks and complete the map."""
        plan = self._plan
        self._report_progress()
        try:
            for block in results(workers, range(self._begun, plan.n_blocks), self._report_progress):
                self._take(block)
                if monotonic() > self._next_save:
                    self._save()
                self._report_progress()
        except BaseException:
            self._save()
            raise
        evaluated = plan.total - plan.samples_in(self._begun)
        self._save()
        state = self._state._replace(table=self._gathering.table())
        path = None if self._store is None else self._store.path
        done = _as_map(plan, state, path, evaluated)
        if self._store is not None:
            self._store.finish(done)
        return done

    def _take(self, block: MapPart) -> None:
        state, self._whole = self._state, False
        self._gathering.add(block.table)
        self._state = state._replace(
            blocks=state.blocks + 1,
            lost=state.lost + block.lost,
            low=np.minimum(state.low, block.low),
            high=np.maximum(state.high, block.high),
        )
        self._whole = True

    def _report_progress(self) -> None:
        self._report(self._plan.samples_in(self._state.blocks), self._plan.total)

    def _save(self) -> None:
        """Write a checkpoint if there is progress and no update was interrupted."""
        if self._store is None or self._state.blocks == self._saved or not self._whole:
            return
        begin = monotonic()
        self._whole = False
        table = self._gathering.table()
        self._whole = True
        self._store.save(self._state._replace(table=table))
        self._saved = self._state.blocks
        took = monotonic() - begin
        self._next_save = monotonic() + max(TUNING.checkpoint, took / TUNING.checkpoint_share)


def _as_map(plan: MapPlan, state: MapPart, path: Path | None, evaluated: int) -> WorkspaceMap:
    low, high = (np.where(np.isfinite(end), end, np.nan) for end in (state.low, state.high))
    return WorkspaceMap(plan, state.table, state.lost, low, high, path, evaluated)


def _plan_of(store: MapStore) -> MapPlan:
    """Return the plan of a stored map."""
    data: dict[str, Any] = store.attributes
    try:
        load = np.array(data["tip_load"], dtype=float)
        follows = bool(load[6:].any())
        wrench = load[6:] if follows else load[:6]
        robot = Manipulator(
            RobotDescription.model_validate(data["robot_description"], strict=False),
            force=wrench[:3],
            moment=wrench[3:],
            load_frame="tip" if follows else "base",
            resolution=data["resolution"],
        )
        grid = data["sampling"] == "grid"
        return MapPlan.of(
            robot, directions=data["directions"], kind=data["kind"], boundary=data["boundary"],
            frame=data["frame"], samples=None if grid else data["samples"],
            levels=data["levels"] if grid else None, cell=data["cell_m"],
            seed=0 if grid else data["seed"],
            scene=Scene.model_validate(data["scene"], strict=False) if "scene" in data else None,
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(store.path, f"is damaged: {error}") from None
