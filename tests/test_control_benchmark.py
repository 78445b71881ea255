"""The benchmarks of the closed loop and of calibration: cases, judgement, baselines; short."""

import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("numba")
import stiffopt.plant.devices  # noqa: F401 - its code is kept where it always is

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import calibration
import control
import control_cases
import control_runs
import disturbances
import regions
import setup_faults
from conftest import is_long
from control_baselines import CONTROLLERS, Gains, IntegralFeedback
from control_cases import DIRECTIONS, STEPS, draw_case, draw_path, settling_time, with_true_file
from stiffopt.identify.results import Comparison
from stiffopt.model.calibration import Calibration
from stiffopt.model.description import Recordings
from stiffopt.model.manipulator import load_robot
from stiffopt.optimise.solver import PressureSolver
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import Discretisation
from stiffopt.registration import Placement, Registration


@pytest.fixture(autouse=True)
def _quicker(compiled, monkeypatch):
    """Truth and controllers are too slow in the VM; fewer searches do where one is enough."""
    if not is_long():
        monkeypatch.setattr(control_cases, "STARTS", 3)


@pytest.fixture
def short_steps(monkeypatch):
    """Half the time for each target: with inertia it takes all of it to tell swings apart."""
    monkeypatch.setattr(control_runs, "HOLD", 5.0)
    monkeypatch.setattr(control_runs, "FROM", 3.0)
    monkeypatch.setattr(control_runs, "EARLY", (2.0, 3.0))
    monkeypatch.setattr(control_runs, "LATE", (4.0, 5.0))


def in_long_steps(description):
    """The description of a rig whose plant takes steps of 4 ms, but in the long form."""
    if is_long():
        return description
    plant = description.plant.model_copy(update={"discretisation": Discretisation(step=4e-3)})
    return description.model_copy(update={"plant": plant})


@cache
def drawn():
    """A case of one target, for all tests that only read it."""
    case = draw_case(3, targets=1)
    return replace(case, description=in_long_steps(case.description))


def test_a_case_is_what_the_bars_say_and_its_truth_is_that_of_the_arm():
    case = drawn()
    m = case.description.plant.mismatch
    assert np.linalg.norm(m.base.position) == pytest.approx(2e-3)
    assert np.abs(np.array(m.gain) - 1).max() <= 0.05
    assert np.abs(np.array(m.modulus) - 1).max() <= 0.2
    arm, aim = case.arm(), case.aims[0]
    assert arm.settled(aim.drawn) == pytest.approx(aim.position, abs=1e-6)
    assert arm.settled(aim.stiffest) == pytest.approx(aim.position, abs=2e-5)
    rest = arm.settled(np.zeros(6))
    assert STEPS[0] <= np.linalg.norm(aim.position - rest) <= STEPS[1]
    assert 0.1 < aim.ideal < 1.0
    direction = DIRECTIONS[aim.kind]
    # the model of the truth has linear silicone, and pressures that add nothing else
    assert case.truth.position(aim.drawn) == pytest.approx(aim.position, abs=8e-3)
    assert case.truth.stiffness(aim.drawn, direction) == pytest.approx(
        arm.stiffness(aim.drawn, direction), rel=0.15
    )
    choice = case.truth.choice(aim.drawn, direction, np.random.default_rng(0))
    for p, value in ((choice.softest, choice.least), (choice.stiffest, choice.most)):
        assert case.truth.position(p) == pytest.approx(case.truth.position(aim.drawn), abs=1e-4)
        assert case.truth.stiffness(p, direction) == pytest.approx(value)
    assert choice.least < case.truth.stiffness(aim.drawn, direction) < choice.most * (1 + 1e-9)


def test_arms_and_steps_may_be_other_ones():
    given = {"robot_file": "stiff-flop-2", "modulus": 0.85, "steps": (0.05, 0.11)}
    case = draw_case(3, targets=1, ranked=False, **given)
    assert case.believed.name == "stiff-flop-2"
    assert case.description.plant.mismatch.modulus == (0.85, 0.85)
    step = case.aims[0].position - case.arm().settled(np.zeros(6))
    assert 0.05 <= np.linalg.norm(step) <= 0.11


@pytest.mark.parametrize("what", control_cases.DEMANDS)
def test_tasks_may_demand_a_share_of_the_best_stiffness(what):
    case = drawn()
    place, kind = case.aims[0].position, case.aims[0].kind
    robot = load_robot(case.believed)
    best = PressureSolver(robot, case.task(place, kind)).solve().stiffness
    goal = control_cases.demanding(case, what, 0.9).task(place, kind).stiffness
    (demanded,) = goal.at_least or (goal.match,)
    assert demanded.value == pytest.approx(0.9 * best)
    assert demanded.direction == DIRECTIONS[kind]
    assert bool(goal.maximise) is (what == "both")
    assert control_cases.demanding(case, None, 0.9) is case


def test_feedback_beats_the_model_alone_and_the_table_says_so(short_steps):
    case = drawn()

    def slow(rig, robot, dynamics):
        return IntegralFeedback(rig, robot, Gains(1.0, 2e5))

    alone = control_runs.run_case(case, "open-loop", CONTROLLERS["open-loop"], "quasi-static")
    helped = control_runs.run_case(case, "integral", slow, "quasi-static", in_loop=True)
    assert helped[0].steady < 0.3 * alone[0].steady
    assert alone[0].broken == helped[0].broken == 0
    assert not helped[0].unstable
    assert 0.5 < helped[0].kept <= 1 + 1e-9
    text = control.tables([*alone, *helped])
    assert "| measure | open-loop | integral |" in text
    assert "quasi-static" in text


def test_a_path_has_the_right_speed():
    case = drawn()
    path = draw_path(case)
    lengths = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    assert (lengths / np.diff(path.times)).max() == pytest.approx(0.010, rel=0.03)
    # an eight whose axis is 40 mm long
    spread = np.linalg.norm(path.positions[:, None] - path.positions[None], axis=2).max()
    assert spread == pytest.approx(0.040, rel=0.05)
    assert path.at(np.array([1e9]))[0] == pytest.approx(path.positions[-1])


def test_a_robot_file_with_another_base_gets_targets_and_poses_in_that_base():
    nominal = drawn()
    case = with_true_file(nominal)
    place, axis = case.aims[0].position, DIRECTIONS["lateral"]
    base = case.description.plant.mismatch.base.transform()
    here = base[:3, :3].T @ (place - base[:3, 3])
    assert case.target(place).position == pytest.approx(here, abs=1e-9)
    assert nominal.target(place).position == pytest.approx(place, abs=1e-12)
    (goal,) = case.task(place, "lateral").stiffness.maximise
    assert goal.direction == pytest.approx(base[:3, :3].T @ axis, abs=1e-9)
    with nominal.rig("quasi-static") as rig:
        rig.clock.sleep(1.0)
        tip = rig.world.plant.tip_pose()[:3, 3]
        (*_, seen) = rig.tracker.read()
    assert seen.position == pytest.approx(tip, abs=5e-4)  # noise
    with case.rig("quasi-static") as rig:
        rig.clock.sleep(1.0)
        (*_, seen) = rig.tracker.read()
    assert seen.position == pytest.approx(case.target(tip).position, abs=5e-4)
    assert np.linalg.norm(seen.position - tip) > 2e-3


def test_what_a_file_calls_the_tip_is_what_goes_to_the_target(short_steps):
    nominal = drawn()
    off = Placement(position=(4e-3, 0.0, 0.0))
    recordings = Recordings(registration=Registration(tip_in_sensor=off))
    case = replace(nominal, believed=nominal.robot.model_copy(update={"recordings": recordings}))
    (step,) = control_runs.run_case(case, "stiffopt", CONTROLLERS["stiffopt"], "quasi-static")
    assert step.steady < 3e-4


def test_a_calibrated_file_comes_from_a_recording_without_the_run_s_noise_and_is_kept(
    tmp_path, monkeypatch
):
    nominal = drawn()
    loaded = nominal.description.plant.model_copy(update={"payload": 0.01})
    case = replace(nominal, description=nominal.description.model_copy(update={"plant": loaded}))
    asked = []

    def recorded(rig, robot, sizes, folder):
        asked.append(rig.plant)
        return ["log"]

    def calibrate(robot, logs, settings):
        assert (robot, logs) == (case.robot, ["log"])
        return SimpleNamespace(robot=robot.model_copy(update={"tip_mass": 0.021}))

    monkeypatch.setattr(control_cases, "recorded", recorded)
    monkeypatch.setattr(control_cases, "calibrate", calibrate)
    for _ in range(2):
        known = control.with_file(case, "calibrated", tmp_path)
        assert known.believed == case.robot.model_copy(update={"tip_mass": 0.021})
    (plant,) = asked  # once
    assert plant.mismatch == case.description.plant.mismatch
    assert (plant.dynamics, plant.payload) == ("full", 0.0)
    assert plant.seed != case.description.plant.seed
    assert control.with_file(case, "nominal", None) is case


def test_settling_ends_where_the_tip_comes_near_for_good():
    times = np.arange(1, 101) * 0.1
    errors = np.full(100, 0.5e-3)
    assert settling_time(times, errors, 1.0) == 0.0
    errors[:20] = 5e-3
    assert settling_time(times, errors, 1.0) == pytest.approx(2.0)
    errors[59] = 1.1e-3  # it leaves once more
    assert settling_time(times, errors, 1.0) == pytest.approx(6.0)
    errors[95] = 1.1e-3  # so late that nobody knows whether it stays
    assert settling_time(times, errors, 1.0) == np.inf


def test_an_arm_in_use_has_a_line_with_what_the_loop_causes_and_its_settling(monkeypatch):
    """The way of the tip is 1 s on a straight line; the line that is kinked leaves it by 3 mm."""
    goal = np.array([0.1, 0.0, 0.0])
    ticks = round(disturbances.AFTER / disturbances.PERIOD)
    way = goal * np.minimum(1.0, np.arange(ticks)[:, None] * disturbances.PERIOD)

    def run(case, row, dynamics, *, in_use, frozen=False):
        assert in_use
        if "kinked" in row.name and not frozen:
            return disturbances.Outcome(0.5, "slip", way + np.array([0, 3e-3, 0]), "inactive")
        return disturbances.Outcome(np.inf, "", way, "active")

    monkeypatch.setattr(disturbances, "run_row", run)
    case = SimpleNamespace(seed=7, aims=(None, SimpleNamespace(position=goal)))
    rows = [row for row in disturbances.ROWS if "line behind a gauge" in row.name]
    line = disturbances._in_use(case, rows, "full")
    assert line == ["7", "0.0 (not told)", "3.0 (0.50, slip)", "1.00"]


# -- calibration ------------------------------------------------------------------------------


def test_a_file_with_the_true_values_has_no_error_and_predicts_what_the_probe_measures():
    description, robot = calibration.described(calibration.CASES["sim-agreeing"], 3)
    description = in_long_steps(description)
    plant = Plant(robot, description.plant)
    same = calibration.with_true_values(robot, plant.mismatch)
    files = {"nominal": robot, "calibrated": same}
    known = {name: calibration.Known.of(each) for name, each in files.items()}
    found = calibration.Found()
    pressures = (
        np.random.default_rng(1).uniform(0, 1, (6 if is_long() else 3, 3)) * robot.pressure_max
    )
    calibration.held_out(plant, known, pressures, found)
    assert np.max(found.values["settled"]["calibrated"]) < 0.1  # % of length
    assert np.mean(found.values["settled"]["nominal"]) > 2

    calibration.probed(description, robot, known, np.array([[0.3e5, 0.6e5, 0.0]]), found)
    assert not found.notes
    for axis in calibration.DIRECTIONS:
        (error,) = found.values[f"stiffness {axis}"]["calibrated"]
        assert abs(error) < 4  # %
    assert "| settled tip, % of length, mean / p95 |" in calibration.markdown("sim", found)


def test_a_file_with_the_true_values_hangs_as_the_arm_does_from_its_tilted_base():
    description, _ = calibration.described(calibration.Case("sim-two-segment", agrees=True), 3)
    hanging = load_robot("stiff-flop-2-hanging").description
    segments = [s.model_copy(update={"strain_law": "rest-length"}) for s in hanging.segments]
    robot = hanging.model_copy(update={"segments": tuple(segments)})
    plant = Plant(robot, description.plant)
    same = calibration.with_true_values(robot, plant.mismatch)
    files = {
        "true": calibration.Known.of(same),
        "not tilted": calibration.Known.of(same.model_copy(update={"gravity": robot.gravity})),
    }
    found = calibration.Found()
    pressures = np.random.default_rng(1).uniform(0, 0.5, (3, 6)) * robot.pressure_max
    calibration.held_out(plant, files, pressures, found)
    errors = found.values["settled"]  # % of length
    assert np.max(errors["true"]) < 0.01
    assert np.min(errors["not tilted"]) > 1


def test_real_arms_are_calibrated_by_each_of_their_runs(monkeypatch):
    """Each fit is tested with the other runs, and all of these are pooled."""
    fits, tests, compared = [], [], Comparison(
        "", np.arange(600.0), *[np.zeros((600, 3))] * 5, None, *np.ones((2, 600), dtype=bool),
        *[np.repeat([0.4, 0.6], 300)] * 2, (),
    )  # fmt: skip

    def names(logs):
        return [Path(name).stem[-6:] for name, _ in logs]

    def calibrated(robot, logs, *, settings):
        fits.append((names(logs), settings.sequence))
        return SimpleNamespace(robot=robot)

    def tested(robot, logs, settings):
        tests.append(names(logs))
        return [compared] * len(logs)

    monkeypatch.setattr(regions, "read_log", lambda path: path)
    monkeypatch.setattr(regions, "calibrate", calibrated)
    monkeypatch.setattr(regions, "validate", tested)
    found = dict(regions.of_recordings(Path("somewhere")))
    assert list(found) == ["ucl-58", "ucl-55", "asu"]  # two modules have no test run
    runs = ["ol-p2p", "cl-p2p", "-07-29"]
    assert fits[3:6] == [([run], False) for run in runs]
    assert tests[3:6] == [[each for each in runs if each != run] for run in runs]
    assert len(found["ucl-55"]) == 6
    assert fits[6] == ([f"apr4_{number}" for number in range(1, 6)], True)  # one after another
    assert tests[6] == ["apr4_6", "apr4_7"]


def test_intervals_of_a_real_arm_are_by_its_runs():
    """Blocks of a run that repeats its way are no evidence of their own."""
    every = np.ones(600, dtype=bool)
    runs = [
        Comparison(
            "", np.arange(600.0), *[np.zeros((600, 3))] * 5, None, every, every,
            *[np.full(600, level)] * 2, (),
        )
        for level in (0.4, 0.6, 0.6)
    ]  # fmt: skip
    told = regions.markdown("", [[run] for run in runs])
    (row,) = (line for line in told.splitlines() if line.startswith("| with history |"))
    assert row.startswith("| with history | 1800 | 33 (0 to 100) | 100 (100 to 100) |")


def test_arms_of_an_undriven_channel_differ_by_its_tolerances_alone():
    robot, arm = regions.made("sim", 32000)
    priors = {"gain": 0.05, "azimuth": 0.05}
    parameters = [
        {"key": f"segments[0].corrections.{name}[{channel}]", "deviation": 0.01, "prior": prior}
        for name, prior in priors.items()
        for channel in range(3)
    ]
    known = {"parameters": parameters, "correlation": np.eye(6).tolist()}
    fit = robot.model_copy(update={"calibration": Calibration.model_validate(known)})
    first, found = arm.plant.mismatch, list(regions.with_other_channels("sim", 32000, fit))
    drawn = []
    for each in found:
        own = each.plant.mismatch
        assert own.model_copy(update={"gain": first.gain, "angle": first.angle}) == first
        assert (own.gain[:-1], own.angle[:-1]) == (first.gain[:-1], first.angle[:-1])
        drawn += [np.log(own.gain[-1]) / priors["gain"], own.angle[-1] / priors["azimuth"]]
    assert len(np.unique(drawn)) == 2 * regions.UNDRIVEN
    assert 0.5 < np.std(drawn) < 1.5
    commands = np.array([[0, 0, 0], [5e4, 5e4, 0]])
    one, other = (each.recorded(np.array([0, 1.0]), commands) for each in (arm, found[0]))
    np.testing.assert_allclose(one.tip_position, other.tip_position, atol=1e-5)


@pytest.mark.parametrize("name", ["none", "dead line", "axes of one log"])
def test_faults_of_a_set_up_are_told_rightly(name):
    robot, _ = regions.made("sim", 41900)
    fault = setup_faults.FAULTS[name](robot, np.random.default_rng(0))
    remarks = setup_faults.told_in_calibration("sim", 41900, fault)
    how, left = setup_faults.judged(fault, remarks)
    assert how == "rightly"
    assert name == "none" or left < 0.5


def test_what_is_told_of_faults_is_judged():
    robot = calibration.described(calibration.CASES["two-segment"], 0)[1]
    fault = setup_faults.lines(robot, [0], [(4, 5)])
    dead = "the line of segment 1 channel 1 is dead{}; the robot file's arm then misses the tip by "
    dead += "2.0 mm instead of 8.0 mm, however soft it is; --keep lines leaves that"
    both = dead.format(", and segment 2 channel 2 has the pressure of segment 2 channel 3")
    idle = "the pressure of segment {} channel 1 does not show in the tip (--keep lines)"
    assert setup_faults.judged(fault, [both]) == ("rightly", 0.25)
    then = "with that corrected, segment 2 channel 2 has the pressure of segment 2 channel 3; "
    then += "the robot file's arm then misses the tip by 1.0 mm instead of 2.0 mm; --keep lines"
    assert setup_faults.judged(fault, [dead.format(""), then]) == ("rightly", 0.125)
    assert setup_faults.judged(fault, [dead.format("")])[0] == "in part"
    assert setup_faults.judged(fault, [idle.format(1)])[0] == "in part"
    assert setup_faults.judged(setup_faults.lines(robot, [0], []), [both])[0] == "wrongly"
    assert setup_faults.judged(fault, [idle.format(2)])[0] == "wrongly"
    assert setup_faults.judged(fault, ["3 rows count less"])[0] == "nothing"
    assert setup_faults.row("two", [("rightly", 0.25), ("wrongly", 0.5)])[1:] == (
        "2", "1", "0", "1", "0", "25 to 25",
    )  # fmt: skip


@pytest.mark.long
def test_the_quick_form_of_the_calibration_runs():
    command = [sys.executable, calibration.__file__, "--quick", "--arms", "sim"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| settled tip, % of length, mean / p95 |" in done.stdout
    assert "| stiffness z, %, mean / mean of size |" in done.stdout
