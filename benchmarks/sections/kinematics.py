"""Time evaluations of the model, single and in batches, against CasADi's VM and soromox."""

from collections.abc import Callable

import casadi as ca
import numpy as np

import settings as bars
import tasks
from peers import paper
from peers.base import PeerMissingError, Vector
from peers.soromox_rod import Soromox
from report import Comparison, Section, at_least, times
from settings import Settings
from timing import Times, interleaved, looped, median, ratio

TEXT = """\
Whole calls from Python at random pressures, one at a time (microseconds per call) and as a
batch (microseconds per row). *CasADi VM*: the paper's equations written afresh, as a plain
`casadi.Function`. *soromox*: strains instead of pressures as input, compiled by JAX. Compliance
is the 6x6 matrix, stiffness the directional one. The pose with Jacobian is two calls of
stiffopt. Tip positions of soromox and stiffopt agree within {agreement:.1e} m."""

DIRECTION = np.array([0.6, 0.0, 0.8])
VM = "CasADi VM"
OWN = "stiffopt"
MANY = 60_000
"""Rows after which machine code is used for batches."""
WORKS = ("pose", "pose and Jacobian", "compliance", "stiffness", "stiffness gradient")


def section(sizes: Settings) -> Section:
    """The table of evaluations."""
    header = ("segments", "work", *(f"{who}, us" for who in (OWN, VM, Soromox.name)), "ratios")
    out = Section("Evaluations", TEXT, header)
    agreement = 0.0
    for segments in sizes.few_segments:
        agreement = max(agreement, _tables(out, segments, sizes))
    out.text = TEXT.format(agreement=agreement)
    return out


def _tables(out: Section, segments: int, sizes: Settings) -> float:
    robot = tasks.arm(segments)
    rng = np.random.default_rng([sizes.seed, segments])
    many = sizes.batch if segments == 2 else sizes.batch // 4
    P = robot.pressure_max * rng.random((many, robot.n_pressures))
    robot.tip_pose(np.resize(P, (MANY, robot.n_pressures)))  # so many that code is compiled
    jax: Soromox | None = None
    agreement = 0.0
    try:
        jax = Soromox.of(segments)
        q = jax.coordinates(P)
        miss = [jax.position(q[i]) - robot.tip_pose(P[i])[:3, 3] for i in range(20)]
        agreement = float(np.abs(miss).max())
    except PeerMissingError as error:
        out.skipped[Soromox.name] = str(error)
    for where, rows in (("single", P[:1]), ("batch", P)):
        calls = _calls(segments, rows if where == "batch" else rows[0], jax)
        for work in WORKS:
            of_work = {who: call for (task, who), call in calls.items() if task == work}
            taken = _timed(of_work, where, sizes.repetitions)
            _report(out, segments, f"{work}, {where}", taken, len(rows))
            if segments == 2 and where == "batch":
                _judge(out, work, len(rows) / median(taken[OWN]))
    return agreement


def _timed(calls: dict[str, Callable[[], object]], where: str, repetitions: int) -> Times:
    if where == "single":
        return looped(calls, repetitions)
    for call in calls.values():
        call()
    batches = {who: lambda _, c=call: c() for who, call in calls.items()}
    return interleaved(batches, 1, min(3, repetitions))


def _calls(
    segments: int, p: Vector, jax: Soromox | None
) -> dict[tuple[str, str], Callable[[], object]]:
    """What is timed, by work and by whom."""
    robot = tasks.arm(segments)
    symbol, x, R, C = paper.symbolic(segments)
    along = R.T @ ca.DM(DIRECTION)
    k = 1 / (along.T @ C[:3, :3] @ along)
    pose = ca.vertcat(ca.horzcat(R, x), ca.DM([[0, 0, 0, 1]]))
    slope = ca.densify(ca.gradient(k, symbol))
    functions = {
        "pose": ca.Function("f", [symbol], [pose]),
        "pose and Jacobian": ca.Function("f", [symbol], [pose, ca.jacobian(x, symbol)]),
        "compliance": ca.Function("f", [symbol], [C]),
        "stiffness": ca.Function("f", [symbol], [k]),
        "stiffness gradient": ca.Function("f", [symbol], [k, slope]),
    }
    bar = np.ascontiguousarray((p / paper.BAR).T)
    calls: dict[tuple[str, str], Callable[[], object]] = {
        (work, VM): lambda f=function: f(bar) for work, function in functions.items()
    }
    calls["pose", OWN] = lambda: robot.tip_pose(p)
    calls["pose and Jacobian", OWN] = lambda: (robot.tip_pose(p), robot.tip_jacobian(p))
    calls["compliance", OWN] = lambda: robot.tip_compliance(p)
    calls["stiffness", OWN] = lambda: robot.stiffness(p, DIRECTION)
    calls["stiffness gradient", OWN] = lambda: (
        robot.stiffness(p, DIRECTION), robot.stiffness_gradient(p, DIRECTION),
    )  # fmt: skip
    if jax is not None:
        q = jax.coordinates(np.atleast_2d(p))
        q = q[0] if p.ndim == 1 else q
        calls["pose", jax.name] = lambda: jax.pose(q)
        calls["pose and Jacobian", jax.name] = lambda: jax.pose_and_jacobian(q)
    return calls


def _report(out: Section, segments: int, work: str, taken: Times, rows: int) -> None:
    others = [who for who in (VM, Soromox.name) if who in taken]
    ratios = {who: ratio(taken[who], taken[OWN]) for who in others}
    out.rows.append(
        (
            str(segments), work,
            *(f"{median(taken[w]) / rows * 1e6:.3g}" if w in taken else "-"
              for w in (OWN, VM, Soromox.name)),
            ", ".join(times(value) for value in ratios.values()),
        )
    )  # fmt: skip
    out.data[f"{work} {segments}"] = {who: median(taken[who]) / rows for who in taken}
    for who, value in ratios.items():
        where = f"{work}, {tasks.arm_words(segments)}"
        out.comparisons.append(Comparison(where, who, value))


def _judge(out: Section, work: str, per_second: float) -> None:
    limits = {"pose": bars.BATCH_POSES, "stiffness": bars.BATCH_STIFFNESSES}
    if work in limits:
        what = f"batched {work}, 2 segments"
        out.verdicts.append(at_least(what, limits[work] / 1e6, per_second / 1e6, "million/s"))
