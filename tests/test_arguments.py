"""Bad arguments in Python are told as sentences, and odd but good ones work."""

import copy
import pickle

import numpy as np
import pytest

import stiffopt as so
from stiffopt.optimise.solver import PressureSolver

ARM = so.load_robot("stiff-flop-2")
P = np.array([0.5, 1.0, 0.2, 0.9, 0.1, 1.2]) * 1e5
X = (1.0, 0.0, 0.0)
TASK = so.Task(
    robot="stiff-flop-2",
    target=so.Target(position=(-0.03, 0.01, 0.19)),
    stiffness=so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=X)),
)
SOLVER = PressureSolver(ARM, TASK)
TWIST, WRENCH = so.Twist(np.arange(1.0, 7.0)), so.Wrench(np.arange(1.0, 7.0))
STRETCHED = np.diag([2.0, 0.5, 1.0, 1.0])
BAD = {
    "robot as text": (lambda: so.solve_pressure("name", TASK), "robot must be a Manipulator"),
    "no robot": (lambda: so.solve_pressure(None, TASK), "robot must be a Manipulator"),
    "no task": (lambda: so.solve_pressure(ARM, None), "task must be a Task"),
    "task as text": (lambda: so.solve_pressure(ARM, "x"), "task must be a Task"),
    "target as list": (lambda: SOLVER.solve([1, 2, 3]), "target must be a Target"),
    "guess as text": (lambda: SOLVER.solve(guess="abc"), "guess must be 6"),
    "guess of texts": (lambda: SOLVER.solve(guess=["1"] * 6), "guess"),
    "short guess": (lambda: SOLVER.solve(guess=[1, 2]), "guess"),
    "guess with NaN": (lambda: SOLVER.solve(guess=[np.nan] * 6), "guess"),
    "complex guess": (lambda: SOLVER.solve(guess=P * 1j), "guess"),
    "negative seed": (lambda: so.solve_pressure(ARM, TASK, seed=-1), "seed must be an integer"),
    "seed of 1.5": (lambda: so.solve_pressure(ARM, TASK, seed=1.5), "seed must be an integer"),
    "seed True": (lambda: so.solve_pressure(ARM, TASK, seed=True), "seed must be an integer"),
    "front of no task": (lambda: so.pareto_front(ARM, None, 3), "task must be a Task"),
    "front of 2.5": (lambda: so.pareto_front(ARM, TASK, 2.5), "must be an integer of at least 2"),
    "front of one": (lambda: so.pareto_front(ARM, TASK, 1), "must be an integer of at least 2"),
    "front of no robot": (lambda: so.pareto_front("x", TASK, 3), "robot must be a Manipulator"),
    "arm of text": (lambda: so.Manipulator("stiff-flop-2"), "expected a RobotDescription"),
    "resolution 0": (lambda: so.load_robot("stiff-flop-2", resolution=0), "resolution must be"),
    "resolution 1.5": (lambda: so.load_robot("stiff-flop-2", resolution=1.5), "resolution must"),
    "pose at text": (lambda: ARM.pose(P, "x"), "arc length must be a number; got 'x'"),
    "pose at None": (lambda: ARM.pose(P, None), "arc length must be a number; got None"),
    "pose at the base": (lambda: ARM.pose(P, 0), "is not on the arm"),
    "pose beyond the tip": (lambda: ARM.pose(P, 0.19), "is not on the arm"),
    "pose at NaN": (lambda: ARM.pose(P, np.nan), "arc length must be a finite number"),
    "compliance at text": (lambda: ARM.compliance(P, "x"), "arc length"),
    "compliance at None": (lambda: ARM.compliance(P, None), "arc length"),
    "stiffness at text": (lambda: ARM.stiffness(P, X, at="x"), "arc length"),
    "stiffness at array": (lambda: ARM.stiffness(P, X, at=np.ones(2)), "arc length"),
    "wrench at text": (lambda: ARM.internal_wrench(P, np.zeros(6), "x"), "arc length"),
    "loaded at text": (lambda: ARM.loaded_tip_pose(P, np.zeros(6), "x"), "arc length"),
    "method": (lambda: ARM.loaded_tip_pose(P, np.zeros(6), method="x"), "unknown method 'x'"),
    "wrench of text": (lambda: ARM.deflection(P, "x"), "wrench must be 6"),
    "wrench of 3": (lambda: ARM.deflection(P, X), "wrench must be 6"),
    "channel 1.5": (lambda: ARM.tip_twist(P, 1.5), "channel must be"),
    "channel None": (lambda: ARM.tip_twist(P, None), "channel must be"),
    "channel True": (lambda: ARM.tip_twist(P, True), "channel must be"),
    "channel 6": (lambda: ARM.tip_twist(P, 6), "channel must be between 0 and 5"),
    "channel -1": (lambda: ARM.tip_twist(P, -1), "channel must be"),
    "backbone of 1": (lambda: ARM.backbone(P, 1), "must be an integer of at least 2"),
    "backbone of 2.0": (lambda: ARM.backbone(P, 2.0), "must be an integer"),
    "backbone of text": (lambda: ARM.backbone(P, "x"), "must be an integer"),
    "direction zero": (lambda: ARM.stiffness(P, np.zeros(3)), "direction must not be zero"),
    "direction of text": (lambda: ARM.stiffness(P, "x"), "direction must be 3"),
    "direction complex": (lambda: ARM.stiffness(P, [1j, 0, 0]), "direction must be 3"),
    "kind": (lambda: ARM.stiffness(P, X, "x"), "unknown kind 'x'; choose one of translation"),
    "kind None": (lambda: ARM.stiffness(P, X, None), "unknown kind None"),
    "boundary": (lambda: ARM.stiffness(P, X, boundary=np.ones(2)), "unknown boundary"),
    "frame": (lambda: ARM.stiffness(P, X, frame=["base"]), "unknown frame"),
    "load of text": (lambda: ARM.with_load("x"), "force must be 3"),
    "load frame": (lambda: ARM.with_load(X, frame="x"), "unknown frame 'x'"),
    "twist of text": (lambda: so.Twist("abc"), "a twist has six finite coordinates"),
    "ragged twist": (lambda: so.Twist([1, [2, 3]]), "a twist has six finite coordinates"),
    "3x3 motion": (lambda: TWIST.transformed(np.eye(3)), "T_ab must be a rigid motion"),
    "3x3 motion of a wrench": (lambda: WRENCH.transformed(np.eye(3)), "T_ab must be a rigid"),
    "stretch": (lambda: TWIST.transformed(STRETCHED), "T_ab must be a rigid motion"),
    "mirror": (lambda: TWIST.transformed(np.diag([1, 1, -1, 1])), "T_ab must be a rigid"),
    "motion of text": (lambda: TWIST.transformed("x"), "T_ab must be a rigid motion"),
    "pitch": (lambda: so.Twist.from_axis(X, X, "x"), "pitch must be a number"),
    "axis": (lambda: so.Wrench.from_axis(X, "x"), "direction must be 3"),
    "power on a list": (lambda: WRENCH.power([1] * 6), "a wrench does work on a Twist"),
}
PRESSURES = {
    "text": "abc",
    "texts": ["1"] * 6,
    "None": None,
    "ragged": [1, [2, 3]],
    "complex": P + 0j,
    "complex list": [1j] * 6,
    "five": P[:5],
    "three axes": np.zeros((1, 1, 6)),
    "number": 1.0,
    "NaN": [np.nan] * 6,
    "infinite": [np.inf] + [0] * 5,
    "huge": np.full(6, 1e200),
    "beyond the modulus": np.full(6, 4e5),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_argument_is_an_input_error(what):
    call, message = BAD[what]
    with pytest.raises(so.InputError) as caught:
        call()
    assert message in str(caught.value)


@pytest.mark.parametrize("what", PRESSURES)
@pytest.mark.parametrize("loaded", [False, True])
def test_bad_pressures_are_pressure_errors(what, loaded):
    arm = ARM.with_load((0.01, 0, 0)) if loaded else ARM
    for call in (
        arm.tip_pose,
        arm.backbone,
        lambda p: arm.stiffness(p, X),
        lambda p: arm.tip_twist(p, 0),
        lambda p: arm.loaded_tip_pose(p, np.zeros(6)),
    ):
        with pytest.raises(so.PressureError):
            call(PRESSURES[what])


def test_a_batch_where_one_set_is_due():
    with pytest.raises(so.PressureError, match="not a batch"):
        ARM.tip_twist(np.zeros((2, 6)), 0)


def test_a_modulus_driven_to_zero_within_the_limits_is_refused_at_construction():
    pressure = ARM.description.pressure.model_copy(update={"max": 4e5})
    with pytest.raises(so.PressureError, match="within the robot's pressure limits: the pressure"):
        so.Manipulator(ARM.description.model_copy(update={"pressure": pressure}))


def test_numpy_integers_are_integers():
    assert ARM.backbone(P, np.int64(5)).shape == (5, 4, 4)
    assert ARM.tip_twist(P, np.int64(1)) == ARM.tip_twist(P, 1)
    assert PressureSolver(ARM, TASK, seed=np.int64(3)).seed == 3
    assert ARM.tip_pose(np.zeros(6, dtype=int)).shape == (4, 4)


@pytest.mark.parametrize(
    ("direction", "unit"),
    [
        ([1e-300, 0, 0], [1, 0, 0]),
        ([1e308] * 3, np.full(3, 3**-0.5)),
        ([1.7e308] * 3, np.full(3, 3**-0.5)),
        ([1e-160, 1e-160, 0], [0.5**0.5, 0.5**0.5, 0]),
        ([0, 5e-324, 0], [0, 1, 0]),
        ([0, 0, -3], [0, 0, -1]),
    ],
)
def test_directions_of_any_length(direction, unit):
    expected = ARM.stiffness(P, unit)
    assert ARM.stiffness(P, direction) == pytest.approx(expected, rel=1e-14)
    measure = so.StiffnessMeasure(direction=direction)
    assert measure.direction == pytest.approx(unit, rel=1e-15)


@pytest.mark.parametrize("scale", [1e-200, 1e-300, 1e200])
def test_screws_of_any_size(scale):
    screw = so.Wrench.from_axis((0, 0.1, 0), (scale, 0, 0), 0.25)
    assert screw.pitch == pytest.approx(0.25)
    assert screw.axis_point == pytest.approx([0, 0.1, 0])
    assert screw.axis_direction == pytest.approx([1, 0, 0])
    assert screw.magnitude == pytest.approx(scale)


@pytest.mark.parametrize("loaded", [False, True])
def test_arms_survive_pickling(loaded):
    arm = so.load_robot("stiff-flop-1", resolution=2)
    if loaded:
        arm = arm.with_load((0, 0.01, 0), (1e-4, 0, 0), "tip")
    p = np.array([0.3e5, 0, 0.1e5])
    T = arm.tip_pose(p)
    for other in (pickle.loads(pickle.dumps(arm)), copy.deepcopy(arm), copy.copy(arm)):
        assert isinstance(other, so.Manipulator)
        assert other.description == arm.description
        assert other.resolution == 2
        assert other.is_loaded is loaded
        assert np.array_equal(other.tip_pose(p), T)


def test_with_load_leaves_the_arm_as_it_was():
    before = ARM.tip_pose(P)
    loaded = ARM.with_load((0.01, 0, 0))
    assert loaded.is_loaded
    assert not ARM.is_loaded
    assert loaded.description is ARM.description
    assert np.array_equal(ARM.tip_pose(P), before)
    assert not loaded.with_load((0, 0, 0)).is_loaded


def test_arrays_of_a_solution_are_read_only():
    solution = SOLVER.solve()
    assert solution.found
    arrays = [solution.pressures, solution.tip_pose, solution.compliance, solution.tip_position]
    arrays += [solution.sensitivities.tip_jacobian, solution.sensitivities.stiffness_gradient]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    again = pickle.loads(pickle.dumps(solution))
    assert np.array_equal(again.pressures, solution.pressures)


RANGES = [
    ("{position: [1e200 m, 0 m, 0 m]}", "", "target.position[0]: 1e+200 m is out of range"),
    ("{position: [free, -1000.1 m, 0 m]}", "", "target.position[1]: -1000.1 m is out of range"),
    ("{position: [0 m, 0 m, 0.1 m]}", "force: [2 MN, 0 N, 0 N]", "load.force[0]: 2e+06 N is out"),
    (
        "{position: [0 m, 0 m, 0.1 m]}",
        "moment: [0 N*m, -1e200 N*m, 0 N*m]",
        "load.moment[1]: -1e+200 N*m is out of range; expected -1e+06 N*m to 1e+06 N*m",
    ),
]


@pytest.mark.parametrize(("target", "load", "message"), RANGES)
def test_what_is_out_of_range_is_refused(tmp_path, target, load, message):
    path = tmp_path / "task.yaml"
    text = f"format: stiffopt-task/1\nrobot: stiff-flop-1\ntarget: {target}\n"
    path.write_text(text + (f"load: {{{load}}}\n" if load else ""), encoding="utf-8")
    with pytest.raises(so.FileError) as caught:
        so.load_task(path)
    assert message in str(caught.value)


def test_what_is_just_in_range_is_not():
    assert so.Target(position=(1000, -1000, None)).position == (1000, -1000, None)
    assert so.Load(force=(1e6, 0, 0), moment=(0, 0, -1e6)).force == (1e6, 0, 0)
    with pytest.raises(so.InputError, match=r"Target\.position\[2\]: 1001 m is out of range"):
        so.Target(position=(0, 0, 1001))
