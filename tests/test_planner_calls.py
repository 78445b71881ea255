"""What planners call: warm answers, reachability, giving up, and objects that travel and read."""

import gc
import multiprocessing
import pickle
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import stiffopt as so
from stiffopt.optimise.compiled_search import CompiledSearch
from stiffopt.optimise.solver import PressureSolver

PLACE = (-0.03, 0.01, 0.19)


def along(*direction, **options):
    return so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=direction, **options))


def hanging(name="stiff-flop-2"):
    description = so.load_robot(name).description
    return so.load_robot(description.model_copy(update={"gravity": (0.0, 0.0, 9.81)}))


def solver_of(robot, target=None, goal=None, **options):
    task = so.Task(target=target or so.Target(position=PLACE), stiffness=goal or along(1, 0, 0))
    return PressureSolver(robot, task.model_copy(update=options))


@pytest.fixture(params=["compiled", "VM"])
def code(request):
    """With machine code, and without a compiler."""
    if request.param == "compiled":
        request.getfixturevalue("compiled")
    return request.param


# -- warm calls -------------------------------------------------------------------------------


@pytest.mark.parametrize("segments", [1, 2])
def test_a_warm_call_answers_as_solve_does(segments, compiled):
    robot = so.load_robot(f"stiff-flop-{segments}")
    rng = np.random.default_rng(segments)
    place = robot.tip_pose(rng.uniform(0, 1.5e5, robot.n_pressures))[:3, 3]
    solver = solver_of(robot, so.Target(position=tuple(place)))
    p = solver.solve().pressures
    for _ in range(5):
        place = place + rng.normal(size=3) * 2e-4
        answer = solver.warm(place, p)
        solution = solver.solve(so.Target(position=tuple(place)), guess=p)
        np.testing.assert_array_equal(answer.pressures, solution.pressures)
        assert answer.found
        assert answer.stiffness == solution.stiffness
        assert answer.solution.task.target == solution.task.target
        assert answer.counts["iterations"] == solution.counts["iterations"]
        p = answer.pressures


@pytest.mark.parametrize("load", [None, so.Load(force=(0, 0, -0.02))])
def test_a_warm_call_of_a_loaded_arm(load, compiled):
    robot = hanging("stiff-flop-1")
    place = (0.01, 0.01, 0.095)
    solver = solver_of(robot, so.Target(position=(0.01, 0.01, None)), load=load)
    first = solver.solve()
    answer = solver.warm((0.0102, 0.0101, place[2]), first.pressures)
    expected = solver.solve(so.Target(position=(0.0102, 0.0101, None)), guess=first.pressures)
    assert answer.found
    np.testing.assert_array_equal(answer.pressures, expected.pressures)


def test_parts_of_the_target_take_the_place_of_the_tasks(code):
    robot = so.load_robot("stiff-flop-2")
    T = robot.tip_pose(np.array([0.2, 0.5, 0.3, 0.7, 0.4, 0.1]) * 1e5)
    q = tuple(so.lie.quaternion_from_rotation(T[:3, :3]))
    for target in (
        so.Target(position=tuple(T[:3, 3]), orientation=q),
        so.Target(position=(T[0, 3], None, T[2, 3]), pointing=tuple(T[:3, 2])),
    ):
        asked = {key: getattr(target, key) for key in ("pointing", "orientation")}
        asked = {key: 2 * np.array(value) for key, value in asked.items() if value is not None}
        if "orientation" in asked:
            asked["orientation"] /= 2
        solver = solver_of(robot, target)
        start = solver.solve().pressures
        moved = None if target.position is None else T[:3, 3] + (3e-4, -0.1, 2e-4)
        if target.position is not None and target.position[1] is not None:
            moved[1] = T[1, 3]
        answer = solver.warm(moved, start, **asked)
        assert answer.found
        assert answer.solution.task.target.tolerance == target.tolerance
        pose = robot.tip_pose(answer.pressures)
        if moved is not None:
            own = [i for i, x in enumerate(target.position) if x is not None]
            assert np.linalg.norm((pose[:3, 3] - moved)[own]) <= 1e-4
        if target.pointing is not None:
            assert pose[:3, 2] @ target.pointing > np.cos(np.radians(1.0001))


def test_what_a_caller_does_to_his_arrays_later_does_not_matter(compiled):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    place, guess = np.array(PLACE), solver.solve().pressures.copy()
    answer, again = (solver.warm(place, guess) for _ in range(2))
    place[:], guess[:] = 0, 0
    assert answer.found
    assert answer.solution.task.target == solver.task.target
    assert solver.warm(None, again.pressures).found  # the task's own target, not the last one
    np.testing.assert_array_equal(again.pressures, answer.pressures)


def test_limits_of_a_warm_call_only_narrow_the_tasks(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    p = solver.solve().pressures
    lower, upper = np.full(6, -1e5), np.full(6, 1.1e5)
    answer = solver.warm(PLACE, p, limits=(lower, upper))
    assert answer.found
    assert (answer.pressures <= 1.1e5).all()
    assert (answer.pressures >= 0).all()
    assert (solver.warm(PLACE, p).pressures > 1.1e5).any()  # they hold for that call alone
    with pytest.raises(so.InputError, match="no pressure that the task permits"):
        solver.warm(PLACE, p, limits=(upper, lower))


def test_without_an_answer_next_to_the_guess_the_search_is_global(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    assert solver.warm((0.05, 0.03, 0.18), np.zeros(6)).found
    nothing = solver.warm((0, 0, 1), np.zeros(6))
    assert not nothing.found
    assert nothing.pressures is None
    assert nothing.solution is None
    assert repr(nothing) == "WarmAnswer(nothing was found)"
    with pytest.raises(AttributeError, match="look at 'found'"):
        _ = nothing.stiffness


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 0), np.zeros(6)), "position must be 3 finite numbers"),
        (((0, 0, np.nan), np.zeros(6)), "finite numbers"),
        ((PLACE, np.zeros(5)), "guess must be 6 finite numbers"),
        ((PLACE, [np.inf] * 6), "finite numbers"),
        ((PLACE, "x"), "guess must be 6"),
    ],
)
def test_wrong_arguments_of_a_warm_call(arguments, message, code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    with pytest.raises(so.InputError, match=message):
        solver.warm(*arguments)
    assert solver.warm(PLACE, np.zeros(6)).found  # what was wrong is not remembered


def test_a_part_that_the_target_does_not_have_is_refused(compiled):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    with pytest.raises(so.InputError, match="target has no pointing"):
        solver.warm(PLACE, np.zeros(6), pointing=(0, 0, 1))


def test_warm_calls_from_several_threads(compiled):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    p = solver.solve().pressures
    places = [np.add(PLACE, (0, i * 1e-4, 0)) for i in range(8)]
    alone = [solver.warm(place, p).pressures for place in places]
    found = [None] * 8

    def ask(i):
        for _ in range(20):
            found[i] = solver.warm(places[i], p).pressures

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_array_equal(found, alone)


# -- whether it can be reached ----------------------------------------------------------------


@pytest.mark.parametrize("name", ["stiff-flop-1", "stiff-flop-2"])
def test_reachable_says_what_solving_would(name, compiled):
    robot = so.load_robot(name)
    rng = np.random.default_rng(4)
    solver = solver_of(robot)
    for k in range(12):
        place = robot.tip_pose(rng.uniform(0, 1.5e5, robot.n_pressures))[:3, 3]
        if k % 3 == 0:
            place = place + rng.normal(size=3) * 0.2 * robot.length
        target = so.Target(position=tuple(place))
        assert solver.reachable(target) == solver.solve(target).found


@pytest.mark.parametrize("robot", ["stiff-flop-1", "hanging"])
def test_reachable_without_a_compiler(robot):
    robot = hanging("stiff-flop-1") if robot == "hanging" else so.load_robot(robot)
    place = robot.tip_pose([0.3e5, 0.6e5, 0.2e5])[:3, 3]
    solver = solver_of(robot, so.Target(position=tuple(place)))
    assert solver.reachable()
    assert not solver.reachable(so.Target(position=(0, 0, 0.2)))
    with pytest.raises(so.InputError, match="must be a Target"):
        solver.reachable(place)


# -- out of reach -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["free", "hanging"])
def test_the_closest_configuration_is_that_of_the_general_method(kind, compiled, monkeypatch):
    name = "stiff-flop-2" if kind == "free" else "stiff-flop-1"
    robot = hanging(name) if kind == "hanging" else so.load_robot(name)
    rng = np.random.default_rng(3)
    for k in range(3 if kind == "free" else 1):
        way = rng.normal(size=3)
        place = tuple(1.3 * robot.length * way / np.linalg.norm(way))
        target = so.Target(position=place, pointing=(0, 0.3, 1) if k == 2 else None)
        solver = solver_of(robot, target)
        fast = solver.solve()
        assert fast.status == "unreachable"
        assert fast.counts["descents"] > 0
        assert str(fast.confidence).startswith("none of ")
        with monkeypatch.context() as patch:
            patch.setattr(CompiledSearch, "nearest", lambda *_: None)
            slow = solver.solve()
        assert fast.position_error < slow.position_error + 1e-7
        assert fast.message == slow.message
        assert fast.active_bounds == slow.active_bounds
        assert fast.freedom == slow.freedom
        if k < 2:
            expected = slow.sensitivities.per_bound
            assert fast.sensitivities.per_bound == pytest.approx(expected, rel=1e-2, abs=1e-9)
        p = fast.pressures
        assert np.linalg.norm(robot.tip_pose(p)[:3, 3] - place) == pytest.approx(
            fast.position_error, abs=1e-6
        )


# -- giving up --------------------------------------------------------------------------------


def test_out_of_time_without_an_answer(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    solver.solve()
    solution = solver.solve(so.Target(position=(0, 0, 1)), timeout=1e-9)
    assert solution.status == "failed"
    assert "no answer within the 1e-09 s" in solution.message
    assert solution.pressures is None


def test_the_best_so_far_holds(compiled):
    """A search that is stopped after its first descent keeps what that has found."""
    solver = solver_of(so.load_robot("stiff-flop-2"), so.Target(position=(0.02, None, 0.16)))
    whole = solver.solve()
    least = min(
        (solver.solve(timeout=t) for t in np.geomspace(1e-5, 1e-2, 30)),
        key=lambda solution: (solution.status != "solved", solution.counts.get("descents", 0)),
    )
    assert least.found
    assert least.stiffness <= whole.stiffness * (1 + 1e-9)
    assert least.position_error <= 1e-4


def test_cancelling_by_an_event_or_a_function(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    never, event = threading.Event(), threading.Event()
    assert solver.solve(cancel=never).found
    event.set()
    far = so.Target(position=(0, 0, 1))
    for cancel in (event, lambda: True):
        assert solver.solve(far, cancel=cancel).message == "cancelled before there was an answer"


def test_a_warm_call_gives_up(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    p = solver.solve().pressures
    plain = solver.warm(PLACE, p)
    again = solver.warm(PLACE, p, timeout=10.0, cancel=threading.Event())
    np.testing.assert_array_equal(again.pressures, plain.pressures)
    for options in ({"timeout": 1e-9}, {"cancel": lambda: True}):
        away = solver.warm((0, 0, 1), p, **options)
        assert not away.found
        assert away.pressures is None
    assert solver.warm(PLACE, p).found  # nothing of it stays
    with pytest.raises(so.InputError, match="timeout must be"):
        solver.warm(PLACE, p, timeout=0)


def test_what_a_cancel_function_raises_is_raised(compiled):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    solver.solve()

    def broken():
        raise LookupError("lost")

    with pytest.raises(LookupError, match="lost"):
        solver.solve(cancel=broken)


def test_a_question_may_be_cancelled(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    assert solver.reachable(timeout=10.0)
    event = threading.Event()
    event.set()
    with pytest.raises(so.CancelledError):
        solver.reachable(so.Target(position=(0, 0, 1)), cancel=event)


def test_a_timeout_may_be_any_number(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    assert solver.solve(timeout=np.float32(5)).found
    assert solver.solve(timeout=np.int64(5)).found


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"timeout": 0}, "timeout must be a positive number of seconds; got 0"),
        ({"timeout": float("nan")}, "timeout must be"),
        ({"timeout": "1 s"}, "timeout must be"),
        ({"cancel": 1}, "cancel must be an event or a function"),
    ],
)
def test_wrong_limits_of_time(options, message):
    with pytest.raises(so.InputError, match=message):
        solver_of(so.load_robot("stiff-flop-1")).solve(**options)


def test_a_batch_keeps_what_was_solved_in_time(compiled):
    robot = hanging("stiff-flop-2")
    tasks = [solver_of(robot, so.Target(position=(0.001 * k, 0.02, 0.185))).task for k in range(40)]
    so.solve_pressure(robot, tasks[0])
    done = threading.Event()
    asked = iter(range(10_000))

    def soon():
        return done.is_set() or next(asked) > 5

    solutions = so.solve_batch(robot, tasks, cancel=soon)
    assert len(solutions) == 40
    assert {solution.status for solution in solutions} <= {"solved", "failed"}
    assert solutions[-1].status == "failed"


def test_a_trade_off_that_is_given_up_has_its_first_points():
    robot = so.load_robot("stiff-flop-1")
    task = solver_of(robot, so.Target(position=tuple(robot.tip_pose([1e5, 0, 0.5e5])[:3, 3]))).task
    with pytest.raises(so.OutOfTimeError, match="no answer within") as caught:
        so.pareto_front(robot, task, 500, timeout=0.5)
    assert isinstance(caught.value, TimeoutError)
    assert caught.value.found
    assert all(solution.found for solution in caught.value.found)
    with pytest.raises(so.CancelledError):
        so.pareto_front(robot, task, 5, cancel=lambda: True)


# -- objects ----------------------------------------------------------------------------------


def test_a_task_needs_no_robot_but_in_a_file(tmp_path: Path):
    task = so.Task(target=so.Target(position=PLACE))
    assert task.robot is None
    assert so.solve_pressure(so.load_robot("stiff-flop-2"), task).found
    with pytest.raises(so.InputError, match="the task names no robot"):
        task.resolve_robot()
    file = tmp_path / "task.yaml"
    file.write_text("format: stiffopt-task/1\ntarget: {position: [0 mm, 0 mm, 180 mm]}\n")
    with pytest.raises(so.FileError, match="the key 'robot' is missing"):
        so.load_task(file)


def test_objects_read():
    robot = so.load_robot("stiff-flop-2")
    target = so.Target(position=(-0.03, None, 0.19), pointing=(0, 0, 1))
    task = so.Task(robot="stiff-flop-2", target=target, stiffness=along(1, 0, 0))
    assert repr(robot) == "Manipulator(stiff-flop-2: 2 segments, 6 channels, 180 mm)"
    assert repr(hanging("stiff-flop-1")).endswith("1 segment, 3 channels, 90 mm, loaded)")
    assert repr(target) == (
        "Target(position (-30, free, 190) mm within 0.1 mm, pointing (0, 0, 1) within 1 deg)"
    )
    assert str(task) == repr(task)
    assert repr(task) == (
        f"Task(stiff-flop-2, {target!r}, StiffnessGoal(maximise against translation along "
        "(1, 0, 0), base axes, free))"
    )
    solver = solver_of(robot)
    assert repr(solver) == f"PressureSolver({robot!r}, {solver.task!r})"
    solution = solver.solve()
    assert repr(solution).startswith("PressureSolution(solved: (")
    assert repr(solution).endswith(f" mm off, {solution.stiffness:.4g} N/m)")
    assert len(repr(solution)) < 160
    failed = solver.solve(so.Target(position=(0, 0, 1)), timeout=1e-9)
    assert repr(failed) == f"PressureSolution(failed: {failed.message})"
    loaded = task.model_copy(
        update={"load": so.Load(force=(0, 0, 1)), "pressure": {"max": 1e5}, "robot": None}
    )
    assert "with a load, with pressure limits" in repr(loaded)


def test_objects_are_pickled(code):
    solver = solver_of(so.load_robot("stiff-flop-2"))
    answer = solver.warm(PLACE, np.zeros(6))
    again, task, other = pickle.loads(pickle.dumps((answer, solver.task, solver)))
    np.testing.assert_array_equal(again.pressures, answer.pressures)
    assert again.found
    assert again.stiffness == answer.stiffness
    assert task == solver.task
    np.testing.assert_array_equal(other.warm(PLACE, np.zeros(6)).pressures, answer.pressures)


def in_another_process(solver, place):
    """Answers of a solver that came from elsewhere."""
    return solver.warm(place, np.zeros(6)), solver.solve(), solver.reachable()


def test_the_same_objects_serve_in_processes():
    solver = solver_of(so.load_robot("stiff-flop-2"))
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        answer, solution, comes = pool.apply(in_another_process, (solver, PLACE))
    assert answer.found
    assert solution.stiffness == pytest.approx(solver.solve().stiffness, rel=1e-9)
    assert comes


def test_ctrl_c_reaches_a_batch_in_machine_code(compiled):
    robot = hanging("stiff-flop-1")
    rng = np.random.default_rng(0)
    places = robot.tip_pose(rng.uniform(0, 1.5e5, (60, 3)))[:, :3, 3]
    tasks = [solver_of(robot, so.Target(position=tuple(place))).task for place in places]
    so.solve_batch(robot, tasks[:1])
    main = threading.main_thread().ident
    timer = threading.Timer(0.02, signal.pthread_kill, (main, signal.SIGINT))

    def for_long():
        end = time.monotonic() + 60
        while time.monotonic() < end:
            so.solve_batch(robot, tasks)

    gc.disable()  # in a callback of the collector, which others have, Ctrl-C would be lost
    try:
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            for_long()
    finally:
        gc.enable()
        timer.join()
