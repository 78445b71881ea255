"""Arms of one layout share formulas and machine code: their numbers are arguments."""

import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import stiffopt as so
from running import wait_for
from stiffopt.model import compiler
from stiffopt.model.kinematics import Actuation
from stiffopt.model.laws import strain_laws
from stiffopt.model.layout import layout_of, numbers_of, symbolic_arm
from stiffopt.model.segment import Compensation, Corrections
from stiffopt.model.shape import FreeShape

RNG = np.random.default_rng(15)
TASK = so.load_task(Path(__file__).parents[1] / "problems/two_segment_stiff_x.yaml")


def changed(description, rng, *, calibrated=False, eccentric=False):
    """The same kind of arm with every number of it another one."""

    def about(value, share=0.1):
        return float(value * rng.uniform(1 - share, 1 + share))

    segments = []
    for segment in description.segments:
        chambers = segment.chambers
        angles = np.array(chambers.angles)
        if eccentric:
            angles = angles + 0.05 * np.arange(len(angles))
        update = {
            "length": about(segment.length),
            "outer_radius": about(segment.outer_radius, 0.02),
            "inner_radius": about(segment.inner_radius),
            "chambers": chambers.model_copy(update={"angles": tuple(angles.tolist())}),
            "material": segment.material.model_copy(
                update={"youngs_modulus": about(segment.material.youngs_modulus)}
            ),
            "compensation": Compensation(
                modulus_per_pressure=-0.1 * rng.uniform(),
                area=about(1.1),
                inertia=about(1.0),
                stiffness=about(1.2),
                softening=0.7,
                bending_radius=0.01 * rng.uniform() if calibrated else 0.0,
                lengthening=0.1 * rng.uniform() if calibrated else 0.0,
            ),
        }
        if calibrated:
            n = segment.n_channels
            update["corrections"] = Corrections(
                gain=tuple(rng.uniform(0.9, 1.1, n).tolist()),
                offset=tuple(rng.uniform(-500, 500, n).tolist()),
                azimuth=tuple(rng.uniform(-0.1, 0.1, n).tolist()),
            )
        segments.append(segment.model_copy(update=update))
    name = f"{description.name}-{rng.integers(1000)}"
    copied = description.model_copy(update={"name": name, "segments": tuple(segments)})
    return so.RobotDescription(**copied.model_dump())


def own_shape(description):
    """Pose, Jacobian and compliance from formulas in which the arm's numbers are constants."""
    tip = FreeShape.of(description, Actuation.of(description))
    return ca.Function("own", [tip.pressures], [tip.transform, tip.jacobian, tip.compliance])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize("eccentric", [False, True])
@pytest.mark.parametrize("law", strain_laws())
@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-3"])
def test_formulas_of_the_layout_are_those_of_the_arm(name, law, calibrated, eccentric):
    """The contract of every law: numbers as arguments give what numbers as constants give."""
    rng = np.random.default_rng(3)
    description = changed(
        so.load_robot(name).description, rng, calibrated=calibrated, eccentric=eccentric
    )
    segments = tuple(
        segment.model_copy(update={"strain_law": law}) for segment in description.segments
    )
    arm = so.Manipulator(description.model_copy(update={"segments": segments}))
    p = rng.uniform(arm.pressure_min, 0.6 * arm.pressure_max)
    for found, own in zip(
        (arm.tip_pose(p), arm.tip_jacobian(p), arm.tip_compliance(p)),
        own_shape(arm.description)(p),
        strict=True,
    ):
        own = own.full()
        assert found == pytest.approx(own, rel=1e-9, abs=1e-12 * np.abs(own).max())


def test_a_layout_is_told_by_structure_not_by_numbers():
    nominal = so.load_robot("stiff-flop-2").description
    others = [changed(nominal, RNG) for _ in range(3)]
    assert {layout_of(other) for other in others} == {layout_of(nominal)}
    numbers = [tuple(numbers_of(other).tolist()) for other in (nominal, *others)]
    assert len(set(numbers)) == 4
    calibrated = [changed(nominal, RNG, calibrated=True) for _ in range(3)]
    assert len({layout_of(other) for other in calibrated}) == 1
    assert layout_of(calibrated[0]) != layout_of(nominal)
    assert layout_of(so.load_robot("stiff-flop-1").description) != layout_of(nominal)
    assert symbolic_arm(layout_of(others[0])) is symbolic_arm(layout_of(others[1]))


def test_switches_belong_to_the_layout():
    nominal = so.load_robot("stiff-flop-1").description
    (segment,) = nominal.segments

    def layout(**update):
        return layout_of(
            nominal.model_copy(update={"segments": (segment.model_copy(update=update),)})
        )

    connected = [layout(connector=length) for length in (1e-3, 2e-3)]
    banded = [layout(corrections=Corrections(dead_band=band)) for band in (1e3, 2e3)]
    assert connected[0] == connected[1] != layout()
    assert banded[0] == banded[1] != layout()
    assert layout(strain_law="rest-length") != layout()


def cached(folder):
    return sorted(path.name for path in Path(folder).glob("*.so"))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["stiff-flop-2", "stiff-flop-2-hanging"])
def test_one_library_serves_all_arms_of_a_layout(compiled, tmp_path, monkeypatch, name):
    """Its answers are those of the general method; nothing is compiled for the second arm."""
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(tmp_path))
    nominal = so.load_robot(name).description
    arms = [so.Manipulator(changed(nominal, np.random.default_rng(k))) for k in (4, 5)]
    for arm in arms:
        p = np.array([0.3, 0.5, 0.1, 0.2, 0.4, 0.3]) * 1e5
        target = so.Target(position=tuple(arm.tip_pose(p)[:3, 3].tolist()))
        task = so.Task(robot="any", target=target, stiffness=TASK.stiffness)
        solver = so.PressureSolver(arm, task)
        assert solver.is_compiled
        solution = solver.solve()
        assert solution.found
        again = arm.tip_pose(solution.pressures)[:3, 3]
        assert np.linalg.norm(again - target.position) < 1.1e-4
        stiffness = arm.stiffness(solution.pressures, [1, 0, 0])
        assert solution.stiffness == pytest.approx(stiffness, rel=1e-6)
        assert solution.stiffness >= arm.stiffness(p, [1, 0, 0]) * (1 - 1e-3)
    assert len(cached(tmp_path)) == 1


def test_times_of_answers_leave_out_the_compilation(
    code_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told apart, once: code is made for the first answer of a kind."""
    monkeypatch.setenv("STIFFOPT_COMPILER", "cc -O0")
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(tmp_path / "empty"))
    robot = so.load_robot("stiff-flop-1")
    task = so.Task(target=so.Target(position=(-0.01, 0.004, None)))
    begin = time.perf_counter()
    first = so.solve_pressure(robot, task)
    elapsed = time.perf_counter() - begin
    second = so.solve_pressure(robot, task)
    assert first.timings["compilation"] > 0.3 * elapsed
    assert first.timings["total"] + first.timings["compilation"] <= elapsed
    assert "compilation" not in second.timings


# -- in the background ----------------------------------------------------------------------


@pytest.fixture
def empty_cache(compiled, tmp_path, monkeypatch):
    """An empty cache of code that is made in the background."""
    monkeypatch.setenv("STIFFOPT_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("STIFFOPT_COMPILE")
    monkeypatch.setattr("stiffopt.model.compiled._notified", set())
    monkeypatch.setattr("stiffopt.model.compiled._awaited", {})
    return tmp_path


def test_the_first_answer_does_not_wait_for_the_compiler(empty_cache):
    solver = so.PressureSolver(so.load_robot("stiff-flop-1"), one_segment_task())
    with pytest.warns(so.SlowWarning, match="compiling once"):
        first = solver.solve()
    assert first.found
    wait_for(lambda: solver.is_compiled)
    assert len(cached(empty_cache)) == 1
    second = solver.solve()
    assert second.stiffness == pytest.approx(first.stiffness, rel=1e-4)


def test_one_process_is_started_however_often_code_is_asked_for(empty_cache, monkeypatch):
    started = []
    monkeypatch.setattr(compiler, "start_background", lambda *request: started.append(request))
    solver = so.PressureSolver(so.load_robot("stiff-flop-1"), one_segment_task())
    with pytest.warns(so.SlowWarning, match="compiling once"):
        assert not solver.is_compiled
    for _ in range(3):
        time.sleep(0.25)  # longer than it takes until the cache is looked at again
        assert not solver.is_compiled
    assert len(started) == 1


def one_segment_task():
    target = so.Target(position=(0.01, 0.01, None))
    return so.Task(robot="stiff-flop-1", target=target, stiffness=TASK.stiffness)


COMMAND = """
import sys, warnings
sys.path.insert(0, sys.argv[1])
warnings.simplefilter("ignore")
from test_layout import one_segment_task
import stiffopt as so
so.PressureSolver(so.load_robot("stiff-flop-1"), one_segment_task()).solve()
"""


def test_compilation_outlives_a_short_command_and_happens_once(empty_cache):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    commands = [
        subprocess.Popen(
            [sys.executable, "-c", COMMAND, str(Path(__file__).parent)], env=environment
        )
        for _ in range(3)
    ]
    assert [command.wait(120) for command in commands] == [0, 0, 0]
    wait_for(lambda: cached(empty_cache))
    wait_for(lambda: not list(empty_cache.glob("build-*")))
    assert len(cached(empty_cache)) == 1


def test_nothing_is_compiled_while_an_arm_is_armed(empty_cache):
    solver = so.PressureSolver(so.load_robot("stiff-flop-1"), one_segment_task())
    with compiler.held_off():
        assert solver.solve().found
        assert not solver.compile()
        time.sleep(0.5)
        assert not list(empty_cache.glob("build-*"))
        assert not solver.is_compiled
    with pytest.warns(so.SlowWarning):
        wait_for(lambda: solver.is_compiled or list(empty_cache.glob("build-*")))


def test_a_failed_compilation_is_told_once(empty_cache, monkeypatch):
    bad = empty_cache / "cc"
    bad.write_text(
        "#!/bin/sh\ncase $1 in --version) echo bad;; *) echo broken >&2; exit 1;; esac\n"
    )
    bad.chmod(0o755)
    monkeypatch.setenv("STIFFOPT_COMPILER", str(bad))
    solver = so.PressureSolver(so.load_robot("stiff-flop-1"), one_segment_task())
    with pytest.warns(so.SlowWarning, match="background"):
        assert solver.solve().found
    with pytest.warns(so.SlowWarning, match="broken") as warned:
        wait_for(lambda: solver.is_compiled or warned.list)
    assert list(empty_cache.glob("*.failed"))
    assert not solver.is_compiled


def test_a_solver_pickles():
    solver = so.PressureSolver(so.load_robot("stiff-flop-1"), one_segment_task(), seed=3)
    other = pickle.loads(pickle.dumps(solver))
    assert other.seed == 3
    assert other.task == solver.task
    assert np.array_equal(other.solve().pressures, solver.solve().pressures)
