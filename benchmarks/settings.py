"""Amounts of measurement, and the bars to meet."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Sizes of a run.

    Attributes
    ----------
    seed : of the tasks.
    quick : the small form, which shows that all works but proves nothing.
    segments : arms of the full task.
    tasks : random tasks per arm, cold.
    warm_tasks : of these, warm too.
    kind_tasks : tasks per kind.
    repetitions : of each timed call.
    reference_starts : random starts of IPOPT per task, for the best known answer.
    most_seconds : per solver and table; a solver that needs more is timed on fewer tasks.
    batch : rows of the batched evaluations.
    batch_tasks : tasks of `solve_batch`.
    paths, scene_paths : random paths per arm, without and with objects.
    reference_paths, reference_points : paths with references, and their points.
    lattice : configurations per point of the dynamic programme.
    path_starts : random starts of IPOPT for a whole path.
    """

    seed: int = 1
    quick: bool = False
    segments: tuple[int, ...] = (1, 2, 3, 5)
    tasks: int = 40
    warm_tasks: int = 20
    kind_tasks: int = 10
    repetitions: int = 5
    reference_starts: int = 4
    most_seconds: float = 3.0
    batch: int = 60_000
    batch_tasks: int = 2000
    paths: int = 12
    scene_paths: int = 10
    reference_paths: int = 1
    reference_points: int = 60
    lattice: int = 2500
    path_starts: int = 8

    @property
    def few_segments(self) -> tuple[int, ...]:
        """Arms for what takes long to prepare or says little on more of them."""
        return (2,) if self.quick else tuple(n for n in self.segments if n <= 3)


def quick(seed: int) -> Settings:
    """Everything once, small."""
    return Settings(
        seed=seed, quick=True, segments=(1, 2), tasks=3, warm_tasks=2, kind_tasks=1,
        repetitions=2, reference_starts=1, most_seconds=0.5, batch=2000, batch_tasks=10,
        paths=1, scene_paths=1, reference_paths=0, reference_points=8, lattice=200, path_starts=2,
    )  # fmt: skip


COLD_MS = {1: 0.5, 2: 1.0, 3: 2.0, 5: 8.0}
WARM_MS = {1: 0.05, 2: 0.1, 3: 0.25, 5: 1.0}
COLD_TIMES_IPOPT = {1: 7.0, 2: 17.0, 3: 23.0}
VM_COLD_MS = {1: 2.0, 2: 5.0, 3: 12.0}
VM_WARM_MS = {1: 1.0, 2: 2.0, 3: 4.0}
NEAR_BEST = 5e-3
SHARE_BEST = {1: 0.99, 2: 0.99, 3: 0.98}
KIND_FACTOR, LOADED_FACTOR = 3.0, 10.0
COMPILE_SECONDS = 3.0  # three segments
FIRST_ANSWER = 1.5  # times what it takes without a compiler
COMMAND_SECONDS = 0.8
TIMES_REAL_TIME = 10.0  # of the simulated arm, two segments, full dynamics
BATCH_SOLVES = 1500.0  # per second, two segments
BODY_SINGLE_US, BODY_BATCH_US = {"free": 40.0, "hanging": 150.0}, {"free": 10.0, "hanging": 100.0}
CLEARANCE_BATCH_US = 5.0
WARM_ABOVE_HOT_US, WARM_ABOVE_COLD_US = 20.0, 250.0  # CPU of a lean call above that of C
UNREACHABLE_MS = 60.0  # CPU, under gravity or a load
BATCH_POSES, BATCH_STIFFNESSES = 1.5e6, 0.5e6  # per second, two segments
PATH_SECONDS = {2: 0.5, 3: 1.5}  # CPU, 250 points
PATH_SHARE = 0.99  # of the stiffness that a reference finds
MOTION_MS, MOTION_LOADED_MS = 100.0, 1000.0  # p95, to a timed motion
MOTIONS_SOLVED = 0.98
MOTION_BELOW_MM = 0.05
