"""Paths: the stiffest pressures along them, within the rates, and what cannot be followed."""

import itertools

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import stiffopt as so
from stiffopt.errors import InputError
from stiffopt.optimise.solver import PressureSolver
from stiffopt.paths.candidates import candidates
from stiffopt.paths.path import Path
from stiffopt.paths.points import PathCandidate, PathTasks
from stiffopt.paths.quickening import quickened, share_of
from stiffopt.paths.refinement import refined
from stiffopt.paths.route import RouteSearch
from stiffopt.paths.solver import solve_path

LINE = {"line": {"from": (-0.03, -0.02, 0.19), "to": (-0.03, 0.02, 0.19)}}


@pytest.fixture
def robot():
    return so.load_robot("stiff-flop-2")


def path_of(path=LINE, *, over="worst", frame="base", **options):
    keys = {
        "path": path,
        "points": 21,
        "timing": {"speed": 0.01},
        "tolerance": {"position": 1e-4},
        "stiffness": {"maximise": {"direction": (1, 0, 0), "frame": frame, "over": over}},
    }
    keys |= options
    return Path(**{key: value for key, value in keys.items() if value is not None})


def through(positions):
    return {"through": [{"position": tuple(map(float, x))} for x in positions]}


def wandering(robot, seed, begin, end, step=1e-3):
    """Positions 1 mm apart on a spline through random tips; some of the points of the whole."""
    rng = np.random.default_rng(seed)
    low, high = np.array(robot.pressure_min) + 1e4, 0.8 * np.array(robot.pressure_max)
    curve = CubicSpline(
        np.arange(6), robot.tip_pose(rng.uniform(low, high, (6, len(low))))[:, :3, 3]
    )
    at = np.linspace(0, 5, 4000)
    lengths = np.insert(np.linalg.norm(np.diff(curve(at), axis=0), axis=1).cumsum(), 0, 0.0)
    return curve(np.interp(np.arange(begin, end) * step, lengths, at))


def check(robot, path, solution):
    """That a solution keeps what it claims, by tip poses, differences and stiffnesses alone."""
    points = path.points()
    assert solution.found, solution.message
    tips = np.array([robot.tip_pose(p)[:3, 3] for p in solution.pressures])
    assert np.linalg.norm(tips - points.positions, axis=1).max() <= path.tolerance.position
    lower, upper = path.pressure_bounds(robot.description)
    assert (solution.pressures >= lower).all()
    assert (solution.pressures <= upper).all()
    rates = np.abs(np.diff(solution.pressures, axis=0)) / np.diff(solution.times)[:, np.newaxis]
    assert (rates <= np.array(solution.slew) * (1 + 1e-6)).all()
    if solution.stiffness is not None:
        own = [
            robot.stiffness(p, goal.maximise[0].direction, frame=goal.maximise[0].frame)
            for p, goal in zip(solution.pressures, points.goals, strict=True)
        ]
        np.testing.assert_allclose(solution.stiffness, own, rtol=1e-9)
        assert solution.worst == min(solution.stiffness)
        assert (solution.stiffness <= solution.alone * (1 + 1e-9)).all()


def warm_started(robot, positions):
    """What following by warm starts gives: pressures and stiffness at each point."""
    goal = so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=(1, 0, 0)))
    task = so.Task(target=so.Target(position=tuple(positions[0])), stiffness=goal)
    solver, p, found = PressureSolver(robot, task), None, []
    for place in positions:
        solution = solver.solve(so.Target(position=tuple(place)), guess=p)
        p = solution.pressures
        found.append((p, solution.stiffness))
    return np.array([p for p, _ in found]), np.array([k for _, k in found])


def test_a_line_is_followed_as_stiffly_as_its_points_can_be(robot, compiled):
    path = path_of()
    solution = solve_path(robot, path)
    check(robot, path, solution)
    _, stiffness = warm_started(robot, path.points().positions)
    assert solution.worst >= stiffness.min() * (1 - 1e-6)
    np.testing.assert_allclose(solution.times, np.linspace(0, 4, 21))


def test_a_line_is_followed_without_a_compiler(robot):
    path = path_of(points=4, pressure={"slew": 1e6})
    check(robot, path, solve_path(robot, path))


def test_the_same_seed_gives_the_same_answer(robot, compiled):
    a, b = (solve_path(robot, path_of(), seed=3) for _ in range(2))
    np.testing.assert_array_equal(a.pressures, b.pressures)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("slew", [1e5, 5e5, 0.5e5])
def test_where_warm_starts_jump_the_rates_are_kept(slew, robot, compiled):
    positions = wandering(robot, 3, 20, 60)
    jumping, stiffness = warm_started(robot, positions)
    jump = np.abs(np.diff(jumping, axis=0)).max()
    path = path_of(through(positions), points=None, pressure={"slew": slew})
    assert jump > slew * 0.1  # which takes more than the time between two points
    solution = solve_path(robot, path)
    check(robot, path, solution)
    assert solution.worst >= stiffness.min() * (1 - 1e-6)


def test_a_way_between_branches_is_found_over_other_configurations(robot, compiled):
    positions = wandering(robot, 8, 200, 250)
    path = path_of(through(positions), points=None)
    check(robot, path, solve_path(robot, path))


def test_points_that_the_rates_hold_back_are_optimised_together(robot, compiled):
    positions = wandering(robot, 3, 20, 60)
    path = path_of(through(positions), points=None, over="mean")
    points = path.points()
    pairs = zip(points.targets, points.goals, strict=True)
    tasks = PathTasks(robot, [path.task(target, goal) for target, goal in pairs], 0)
    layers, _ = candidates(tasks)
    steps = np.full((len(points) - 1, robot.n_pressures), 0.05e5)
    route = RouteSearch(tasks, layers, steps, "mean").best()
    pressures = np.array([each.pressures for each in route.candidates])
    better = refined(tasks, pressures, steps, "mean")
    judged = [tasks.judged(p) for p in (pressures, better)]
    assert all(judgement.holds for each in judged for judgement in each)
    before, after = (np.mean([np.log(j.stiffnesses[0]) for j in each]) for each in judged)
    assert after > before + 1e-4
    assert (np.abs(np.diff(better, axis=0)) <= steps * (1 + 1e-9) + 1e-6).all()


def test_the_mean_is_maximised_where_it_is_asked_for(robot, compiled):
    path = path_of(over="mean")
    solution = solve_path(robot, path)
    check(robot, path, solution)
    assert solution.stiffness.mean() >= 0.999 * solution.alone.mean()


def test_the_direction_turns_with_the_path(robot, compiled):
    circle = {"centre": (0, 0, 0.19), "normal": (0, 0, 1), "radius": 0.025,
              "start": (0.025, 0, 0.19)}  # fmt: skip
    path = path_of({"circle": circle}, frame="path", points=25, timing={"speed": 0.02})
    solution = solve_path(robot, path)
    check(robot, path, solution)
    np.testing.assert_array_equal(solution.pressures[0], solution.pressures[-1])
    tangent = path.points().tangents[5]
    assert solution.stiffness[5] == pytest.approx(robot.stiffness(solution.pressures[5], tangent))


def test_as_fast_as_the_rates_allow(robot, compiled):
    solution = solve_path(robot, path_of(timing={"fastest": True}))
    steps = np.abs(np.diff(solution.pressures, axis=0))
    least = (steps / solution.slew).max(axis=1)
    np.testing.assert_allclose(np.diff(solution.times), np.maximum(least, 1e-3))


def test_points_far_apart_are_followed_as_fast_as_the_rates_allow(robot, compiled):
    """Steps of a tenth of a channel's range cannot lead from one to the next."""
    ends = np.array([[0.1, 0, 0, 0.1, 0, 0], [0, 1.2, 0.3, 0, 1.0, 0]]) * 1e5
    tips = robot.tip_pose(np.linspace(*ends, 4))[:, :3, 3]
    path = path_of(through(tips), points=None, timing={"fastest": True})
    solution = solve_path(robot, path)
    check(robot, path, solution)
    assert np.abs(np.diff(solution.pressures, axis=0)).max() > 0.1 * robot.pressure_max.max()
    assert "with more points, or lower rates, it stays nearer" in solution.message


def test_a_speed_that_no_rate_allows_names_the_rate_and_what_can_be_followed(robot, compiled):
    path = path_of(timing={"speed": 1e4})
    solution = solve_path(robot, path)
    assert solution.status == "unreachable"
    assert "too fast for the rates" in solution.message
    assert "with 5 bar/s holds it back most" in solution.message
    slower = path_of(timing={"speed": 0.04 / solution.times[-1]})
    check(robot, slower, solution.__class__(**{**vars(solution), "status": "solved"}))


def test_pressures_at_the_start_are_kept(robot, compiled):
    free = solve_path(robot, path_of())
    target = so.Target(position=tuple(path_of().points().positions[0]))
    stiff_in_y = so.StiffnessGoal(maximise=so.StiffnessMeasure(direction=(0, 1, 0)))
    start = so.solve_pressure(robot, so.Task(target=target, stiffness=stiff_in_y)).pressures
    assert np.abs(start - free.pressures[0]).max() > 1e3
    path = path_of(start={"pressures": tuple(start)})
    solution = solve_path(robot, path)
    check(robot, path, solution)
    np.testing.assert_array_equal(solution.pressures[0], start)


def test_pressures_at_the_start_that_are_elsewhere_are_refused(robot):
    path = path_of(points=3, start={"pressures": (0.0,) * 6})
    with pytest.raises(InputError, match=r"start\.pressures.* mm off that point"):
        solve_path(robot, path)


def test_rates_that_are_too_few_are_refused(robot):
    with pytest.raises(InputError, match=r"pressure\.slew: has 2 values; expected one value or"):
        solve_path(robot, path_of(pressure={"slew": (1e5, 1e5)}))


def test_objects_on_the_path_are_named_with_the_nearest_path(robot, compiled):
    """Next to objects the nearest points are borders of what can be had, which descents miss."""
    tenths = [(795, -410, 1311), (793, -420, 1309), (792, -429, 1306), (790, -439, 1303)]
    centres = [(0.0605, -0.0811, 0.0837), (0.0208, -0.0228, 0.134), (0.0372, -0.0742, 0.0979)]
    objects = [
        {"name": f"post {k}", "sphere": {"centre": centre, "radius": 0.006}}
        for k, centre in enumerate(centres)
    ]
    scene = {"clearance": 0.001, "objects": objects}
    path = path_of(through(np.array(tenths) * 1e-4), points=None, scene=scene)
    solution = solve_path(robot, path)
    assert (solution.status, len(solution.pressures)) == ("unreachable", 4)
    assert "cannot be reached" in solution.message
    assert "'post 1'" in solution.message
    assert robot.clearance(solution.pressures, path.scene).min() > 0.001 - 2e-5
    reached = solution.position_errors <= 1e-4
    assert reached[: solution.first_failure].all()
    assert not reached[solution.first_failure]


def test_a_point_out_of_reach_is_named_with_the_nearest_path(robot, compiled):
    path = path_of({"line": {"from": (-0.03, 0, 0.19), "to": (-0.16, 0, 0.19)}})
    solution = solve_path(robot, path)
    assert solution.status == "unreachable"
    index = solution.first_failure
    assert f"point {index + 1} of 21" in solution.message
    assert "segment 2 channel 2 max" in solution.message
    reached = solution.position_errors <= 1e-4
    assert reached[:index].all()
    assert not reached[index]
    alone = so.solve_pressure(robot, path.task(path.points().targets[-1], None))
    assert solution.position_errors[-1] == pytest.approx(alone.position_error, abs=2e-4)


def test_the_body_keeps_clear_of_a_scene(robot, compiled):
    free = solve_path(robot, path_of())
    outer = robot.description.segments[0].outer_radius
    beside = robot.pose(free.pressures[-1], 0.12)
    centre = beside[:3, 3] + beside[:3, :3] @ [0, outer + 0.005, 0]  # 1 mm from the body
    post = {"name": "post", "sphere": {"centre": tuple(centre), "radius": 0.004}}
    scene = so.Scene(clearance=0.003, objects=[post])
    assert robot.clearance(free.pressures, scene).min() < 0.003
    path = path_of(scene={"clearance": 0.003, "objects": [post]})
    solution = solve_path(robot, path)
    check(robot, path, solution)
    for p, said in zip(solution.pressures, solution.clearance, strict=True):
        line = robot.backbone(p, 400)[:, :3, 3]
        own = np.linalg.norm(line - centre, axis=1).min() - 0.004 - outer
        assert own == pytest.approx(said, abs=1e-4)
        assert said >= 0.003 - 5e-5


def test_an_arm_under_gravity_follows_a_path(compiled):
    robot = so.load_robot("stiff-flop-2-hanging")
    tip = robot.tip_pose(np.full(6, 0.3e5) + np.arange(6) * 1e4)[:3, 3]
    line = {"line": {"from": tuple(tip), "to": tuple(tip + np.array([0, 0.006, 0]))}}
    path = path_of(line, points=5)
    check(robot, path, solve_path(robot, path))


def test_the_common_end_of_a_closed_path_is_found_where_rates_bind(robot, compiled):
    """Tips of a periodic curve of pressures, at 0.98 of the rate; its start is no local optimum."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 2 * np.pi, 41)
    waves = rng.normal(size=(2, 6, 2))
    shape = sum(
        np.cos((k + 1) * angle)[:, None] * a + np.sin((k + 1) * angle)[:, None] * b
        for k, (a, b) in enumerate(waves.transpose(0, 2, 1))
    )
    curve = 0.7e5 + 0.5e5 * shape / np.abs(shape).max()
    tips = robot.tip_pose(curve)[:, :3, 3]
    tips[-1] = tips[0]
    rate = np.abs(np.diff(curve, axis=0)).max(axis=1) / 0.98
    path = path_of(
        through(tips),
        points=None,
        closed=True,
        timing={"times": np.append(0, np.cumsum(rate / 5e5))},
        pressure={"slew": 5e5},
    )
    solution = solve_path(robot, path)
    check(robot, path, solution)
    np.testing.assert_array_equal(solution.pressures[0], solution.pressures[-1])


@pytest.mark.parametrize("timing", ["rates nearly used up", "fastest"])
def test_pressures_of_a_hanging_arm_that_are_not_optimal_are_found(timing, compiled):
    """Points of a curve of pressures; local optima alone do not lead along it."""
    robot = so.load_robot("stiff-flop-2-hanging")
    curve = smooth_curve(robot, 0, 40)[:14]
    rate = np.abs(np.diff(curve, axis=0)).max(axis=1) / 0.95
    times = np.append(0, np.cumsum(rate / 5e5))
    path = path_of(
        through(robot.tip_pose(curve)[:, :3, 3]),
        points=None,
        timing={"fastest": True} if timing == "fastest" else {"times": times},
        tolerance={"position": 5e-4},
        pressure={"slew": 5e5},
    )
    check(robot, path, solve_path(robot, path))


def smooth_curve(robot, seed, count):
    """Pressures (count, n) on a smooth curve through random ones."""
    knots = np.random.default_rng(seed).uniform(0.05, 0.9, (4, robot.n_pressures)) * 1.5e5
    return np.clip(CubicSpline(np.arange(4), knots)(np.linspace(0, 3, count)), 0, 1.5e5)


def test_points_may_differ_in_tolerance_where_rates_bind(robot, compiled):
    curve = smooth_curve(robot, 5, 40)
    tips = robot.tip_pose(curve)[:, :3, 3]
    wide, narrow = ({"position": each} for each in (2e-3, 2e-4))
    points = [
        {"position": tuple(x), "tolerance": narrow if k % 2 else wide}
        for k, x in enumerate(tips.tolist())
    ]
    rate = np.abs(np.diff(curve, axis=0)).max(axis=1) / 0.8
    path = path_of(
        {"through": points},
        points=None,
        timing={"times": np.append(0, np.cumsum(rate / 5e5))},
        tolerance=wide,
        pressure={"slew": 5e5},
    )
    solution = solve_path(robot, path)
    check(robot, path, solution)
    assert solution.position_errors[1::2].max() <= 2e-4


def test_a_sequence_is_quickened_to_what_is_known_to_be_possible(robot, compiled):
    """Off a smooth curve at random by its null space, the steps are larger than along it."""
    curve = smooth_curve(robot, 8, 30)
    path = path_of(through(robot.tip_pose(curve)[:, :3, 3]), points=None)
    points = path.points()
    pairs = zip(points.targets, points.goals, strict=True)
    tasks = PathTasks(robot, [path.task(target, goal) for target, goal in pairs], 0)
    aside = 0.2e5 * np.random.default_rng(1).normal(size=curve.shape)
    aside[0] = 0.0
    given = tasks.brought(np.arange(30), curve + aside)
    assert given.arrived.all()
    rough = list(map(PathCandidate, given.pressures, given.values))
    steps = np.abs(np.diff(curve, axis=0)).max(axis=1, keepdims=True) * np.ones(6)
    assert share_of(steps, given.pressures) > 1.5
    found = np.array([each.pressures for each in quickened(tasks, rough, steps, {0})])
    np.testing.assert_array_equal(found[0], given.pressures[0])
    assert share_of(steps, found) < 1.02
    tips = robot.tip_pose(found)[:, :3, 3]
    assert np.linalg.norm(tips - points.positions, axis=1).max() <= path.tolerance.position


def test_giving_up_says_so(robot, compiled):
    solution = solve_path(robot, path_of(), cancel=lambda: True)
    assert solution.status == "failed"
    assert "cancelled" in solution.message
    assert solution.pressures.shape == (0, 6)


def test_steps_that_are_asked_of_a_crossing_are_kept(robot, compiled):
    """Sequences over every pair of candidates are as good as the search says."""
    positions = wandering(robot, 3, 28, 44)
    path = path_of(through(positions), points=None)
    points = path.points()
    pairs = zip(points.targets, points.goals, strict=True)
    tasks = PathTasks(robot, [path.task(target, goal) for target, goal in pairs], 0)
    layers, _ = candidates(tasks)
    small = [layer[:2] for layer in layers[:8]]
    steps = np.full((7, robot.n_pressures), 1.5e5)
    search, by_numpy = (RouteSearch(tasks, small, steps, "mean") for _ in range(2))
    route = search.best()
    by_numpy._sequences.code = None
    assert search._sequences.code is not None
    assert by_numpy.best() == route
    values = [
        np.mean([each.value for each in some])
        for some in itertools.product(*small)
        if (np.abs(np.diff([each.pressures for each in some], axis=0)) <= 1.5e5).all()
    ]
    assert route.value("mean") >= max(values) - 2e-3
    assert len(search.beginning()) == len(by_numpy.beginning()) == 8


def post_half_way(arm, solution):
    """A scene with a post that the body comes within 0.5 mm of, half-way between two points."""
    at, (begin, end) = 0.9 * arm.length, solution.pressures
    first, middle, last = (arm.pose(p, at)[:3, 3] for p in (begin, (begin + end) / 2, end))
    out = middle - (first + last) / 2  # of the chord
    reach = arm.description.segments[0].outer_radius + 0.0045
    centre = middle + reach * out / np.linalg.norm(out)
    post = {"name": "post", "sphere": {"centre": tuple(centre), "radius": 0.004}}
    return {"clearance": 0.001, "objects": [post]}


def test_the_body_keeps_clear_between_points_too(robot, compiled):
    options = {"points": 2, "timing": {"times": [0, 4.0]}}
    free = solve_path(robot, path_of(**options))
    scene = post_half_way(robot, free)
    solution = solve_path(robot, path_of(**options, scene=scene))
    assert solution.found
    shares = np.linspace(0, 1, 41)[:, np.newaxis]
    between = (1 - shares) * solution.pressures[0] + shares * solution.pressures[1]
    assert robot.clearance(free.pressures.mean(axis=0), so.Scene(**scene)) < 0.0006
    assert robot.clearance(between, so.Scene(**scene)).min() > 0.001 - 1e-4


def test_a_path_on_which_it_cannot_is_told(compiled):
    """One segment has no other pressures for a position."""
    arm = so.load_robot("stiff-flop-1")
    tips = arm.tip_pose([[0, 0.7e5, 0.7e5], [0.7e5, 0, 0.7e5]])[:, :3, 3]
    options = {"path": through(tips), "points": None, "timing": {"times": [0, 4.0]}}
    free = solve_path(arm, path_of(**options))
    assert free.status == "solved"
    scene = post_half_way(arm, free)
    solution = solve_path(arm, path_of(**options, scene=scene))
    assert solution.clearance.min() > 0.001
    assert solution.status == "unreachable"
    assert solution.first_failure == 0
    assert "Between points 1 and 2 the clearance of the body falls to -" in solution.message
    assert "the scene asks for 1 mm" in solution.message
