"""The force on the tip, from tips that are made up here by other formulas, and pressing with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from conftest import is_long
from stiffopt import Press, StiffnessGoal, StiffnessMeasure, Target, Task, load_robot, load_task
from stiffopt.control.contact_tuning import (
    CreepTuning,
    ObstructionTuning,
    PressingTuning,
    TouchTuning,
)
from stiffopt.control.controller import TipController
from stiffopt.control.creep import CreepEstimator
from stiffopt.control.obstruction import ObstructionWatch
from stiffopt.control.pressing import Phase, Pressing
from stiffopt.control.touch import TipForce, TouchEstimator, _vibration
from stiffopt.control.vibration import transition
from stiffopt.errors import InputError
from stiffopt.model.robot_files import load_description
from stiffopt.optimise.solver import PressureSolver
from stiffopt.optimise.task import Load
from stiffopt.optimise.tip import TipModel
from stiffopt.plant.devices import SimulatedRig
from stiffopt.plant.settings import Discretisation, SoftSurface
from stiffopt.rig.assembly import make_rig
from stiffopt.rig.config import limits_of, load_rig_description, slew_of

Array = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
FRAME, NOISE = 0.025, 5e-5
ROBOT = load_robot("stiff-flop-1")
P = np.array([3e4, 1e4, 6e4])
TIP = TipModel(ROBOT).at(P)
R = TIP.pose[:3, :3]
C = R @ TIP.compliance[:3, :3] @ R.T
SOFT = np.linalg.eigh(C)[1][:, 1:]  # two axes
PUSH = SOFT @ np.array([0.025, -0.02])
OMEGA = 18.0


def felt(
    away: Callable[[float], Array],
    until: float,
    pressures: Callable[[float], Array] = lambda t: P,
    *,
    vibrates: bool = False,
    approach: Array | None = None,
) -> tuple[list[float], list[TipForce]]:
    """What is felt at each sample of a tip that is off the model by `away`."""
    estimator = TouchEstimator([3], vibrates=vibrates, damping=0.04, tuning=TouchTuning())
    estimator.expect(approach, 5e-3)
    rng, times, forces = np.random.default_rng(3), np.arange(0, until, FRAME).tolist(), []
    for time in times:
        seen = away(time) + NOISE * rng.standard_normal(3)
        estimator.take(time, seen, pressures(time), TIP, OMEGA)
        forces.append(estimator.felt)
    return times, forces


def within(force: TipForce, true: Array) -> bool:
    return float(np.linalg.norm(force.force - true)) < 0.2 * np.linalg.norm(true) + 3e-3


def test_a_push_is_felt_at_once_and_its_end_too() -> None:
    bias = np.array([4e-3, -2e-3, 1e-3])
    times, forces = felt(lambda t: bias + C @ PUSH * (3.0 < t < 6.0), 9.0)
    for time, force in zip(times, forces, strict=True):
        if time < 3.0 or time > 7.0:
            assert not force.touches
            assert not force.force.any()
        elif 3.3 < time < 6.0:
            assert force.touches
            assert within(force, PUSH)


def test_a_push_on_an_arm_with_inertia_is_felt_before_the_swing_has_decayed() -> None:
    """The tip is a mass on a spring, integrated by SciPy."""

    def motion(t: float, y: Array) -> Array:
        goal = C @ PUSH * (t > 3.0)
        return np.concatenate([y[3:], -(OMEGA**2) * (y[:3] - goal) - 0.08 * OMEGA * y[3:]])

    found = solve_ivp(motion, (0, 6), np.zeros(6), max_step=2e-3, dense_output=True)
    times, forces = felt(lambda t: found.sol(t)[:3], 6.0, vibrates=True)
    after = [force for time, force in zip(times, forces, strict=True) if 4.0 < time < 4.5]
    assert np.ptp([found.sol(t)[:3] @ PUSH for t in np.arange(4.0, 4.5, 0.01)]) > 0.5 * (
        PUSH @ C @ PUSH
    ), "it still swings"
    assert all(force.touches and within(force, PUSH) for force in after)


def test_neither_motion_with_errors_nor_creep_is_felt() -> None:
    """The arm moves by 10 mm, the model errs by 8 % of it, and creep adds 5 % of it later."""
    way = np.array([0.0, 3e4, -2e4])
    moved = R @ TIP.jacobian[:3] @ way

    def progress(t: float) -> float:
        return float(np.clip((t - 2.0) / 0.8, 0, 1))

    def away(t: float) -> Array:
        creep = 1 - np.exp(-max(t - 2.4, 0.0) / 3.0)
        return moved * (0.08 * progress(t) + 0.05 * creep)

    _, forces = felt(away, 12.0, lambda t: P + way * progress(t))
    assert np.linalg.norm(moved) > 4e-3
    assert not any(force.touches for force in forces)


def test_its_vibration_is_that_of_the_tip_estimator() -> None:
    for duration in (0.005, 0.025, 0.4):
        expected = np.array(transition(OMEGA, 0.04, duration))
        np.testing.assert_allclose(_vibration(OMEGA, 0.04, duration), expected, rtol=1e-12)


def test_along_a_stiff_axis_nothing_is_felt_and_nothing_is_known() -> None:
    stiff = np.linalg.eigh(C)[1][:, 0]
    _, forces = felt(lambda t: 2e-3 * stiff * (t > 2.0), 5.0)
    assert not any(force.touches for force in forces)
    last = forces[-1]
    assert stiff @ last.covariance @ stiff == pytest.approx(TouchTuning().force ** 2)
    assert SOFT[:, 0] @ last.covariance @ SOFT[:, 0] < 0.2 * TouchTuning().force ** 2


def test_the_covariance_has_that_of_the_stiffness() -> None:
    _, forces = felt(lambda t: C @ PUSH * (t > 2.0), 4.0)
    along = PUSH / np.linalg.norm(PUSH)
    deviation = np.sqrt(along @ forces[-1].covariance @ along)
    assert deviation > 0.1 * np.linalg.norm(PUSH)  # of the arm, where no more is known
    assert deviation < 0.5 * np.linalg.norm(PUSH)


def test_a_force_on_an_approach_is_followed_while_it_grows() -> None:
    """The tip comes to a rigid surface at 5 mm/s, by a model that errs by 8 % of the way."""
    way = SOFT[:, 0]
    compliance = float(way @ C @ way)
    per_metre = np.linalg.pinv(R @ TIP.jacobian[:3]) @ way
    last = 4e-3 + 0.03 * compliance  # 30 mN

    def shift(t: float) -> float:
        return min(5e-3 * max(t - 1.0, 0.0), last)

    def force(t: float) -> Array:
        return -way * max(shift(t) - 4e-3, 0.0) / compliance

    times, forces = felt(
        lambda t: -0.08 * shift(t) * way + C @ force(t),
        8.0,
        lambda t: P + per_metre * shift(t),
        approach=way,
    )
    assert np.linalg.norm(force(8.0)) == pytest.approx(0.03)
    for time, found in zip(times, forces, strict=True):
        assert np.linalg.norm(found.force - force(time)) < 0.2 * np.linalg.norm(force(time)) + 5e-3


def test_a_model_that_changes_is_no_force() -> None:
    estimator = TouchEstimator([3], vibrates=False, damping=0.04, tuning=TouchTuning())
    shift = np.array([5e-3, -4e-3, 1e-3])
    for time in np.arange(0, 4, FRAME):
        if abs(time - 2.0) < FRAME / 2:
            estimator.change_model(np.concatenate([shift, np.zeros(3)]))
        estimator.take(time, shift if time > 2.0 - FRAME / 2 else np.zeros(3), P, TIP)
        assert not estimator.felt.touches


def test_creep_that_is_learned_is_no_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its shares change at once, and with them the creep that is predicted; the tip is at rest."""
    estimator = TouchEstimator([3], vibrates=False, damping=0.04, tuning=TouchTuning())
    creep, rng, moved = estimator.creep, np.random.default_rng(6), 0.0
    monkeypatch.setattr(creep, "learn", lambda *_: None)
    for time in np.arange(0.0, 6.0, FRAME).tolist():
        if abs(time - 3.0) < FRAME / 2:
            before = creep.displacement
            taught = creep._mean + np.repeat([0.0, 0.08], 3)
            monkeypatch.setattr(creep, "learn", lambda *_, to=taught: setattr(creep, "_mean", to))
            moved = float(np.linalg.norm(creep._phi @ taught[3:] - before))
        pressures = P * (1.0 + (time >= 1.0))
        estimator.take(time, NOISE * rng.standard_normal(3), pressures, TIP, OMEGA)
        assert time < 2.0 or not estimator.felt.touches
    assert moved > 2e-3


def test_after_a_long_gap_it_begins_anew() -> None:
    times, forces = felt(lambda t: C @ PUSH * (t > 2.0), 4.0)
    assert forces[-1].touches
    estimator = TouchEstimator([3], vibrates=False, damping=0.04, tuning=TouchTuning())
    for time in [*times, *(10.0 + np.array(times))]:
        estimator.take(time, C @ PUSH * (time > 2.0), P, TIP)
    assert not estimator.felt.touches  # the offset is an error as well as a force then


# A press -----------------------------------------------------------------------------------------

N = np.array([1.0, 0.0, 0.0])
COMPLIANCE = np.diag([0.1, 0.1, 5e-4])  # m/N
TARGET = Target(position=(0.02, 0.0, 0.1))
PRESS = Press(force=0.03, direction=(1, 0, 0), travel=0.01)


class Spring:
    """An arm as a spring, before a surface: what a `Pressing` sees of them.

    `late` is how late the force is felt, in ticks of 10 ms; the free arm moves by `reach` at most.
    """

    def __init__(
        self,
        at: float,
        stiffness: float,
        press: Press = PRESS,
        late: int = 10,
        reach: float = math.inf,
    ) -> None:
        self.pressing, self.reach = Pressing(press, TARGET, PressingTuning()), reach
        self.creep = CreepEstimator(3, False, CreepTuning())  # of an arm that has not moved
        self.at, self.stiffness, self.late = at, stiffness, late
        self.forces: list[float] = []
        self.kinds: list[str] = []

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            position = self.pressing.at(0.0).position
            assert position is not None
            asked = cast("float", position[0]) - 0.02
            free = min(asked, self.reach)
            depth = max(0.0, free - self.at) / (1 + self.stiffness * COMPLIANCE[0, 0])
            self.forces.append(self.stiffness * depth)
            tip = np.array([0.02 + free - COMPLIANCE[0, 0] * self.forces[-1], 0.0, 0.1])
            seen = self.forces[-self.late] if len(self.forces) > self.late else 0.0
            force = TipForce(seen > 3e-3, -seen * N, 1e-6 * np.eye(3), -0.1 * seen * N)
            offset = np.concatenate([tip - [0.02 + free, 0.0, 0.1], np.zeros(3)])
            self.pressing.advance(
                0.01, True, True, tip, offset, force, self.creep, np.eye(3), COMPLIANCE,
                (asked - free) * N,
            )  # fmt: skip
            self.kinds += [n.kind for n in self.pressing.notices() if n.kind not in self.kinds]


@pytest.mark.parametrize("stiffness", [20.0, 200.0, 1e4])
def test_a_force_is_reached_and_held_without_overshoot(stiffness: float) -> None:
    arm = Spring(0.003, stiffness)
    arm.run(12.0)
    assert arm.pressing.phase is Phase.PRESSING
    assert arm.forces[-1] == pytest.approx(0.03, abs=5e-4)
    assert max(arm.forces) < 1.15 * 0.03
    assert arm.kinds == ["touch", "pressing"]


def test_the_approach_keeps_its_speed() -> None:
    arm = Spring(0.008, 500.0, PRESS.model_copy(update={"speed": 2e-3}))
    places = []
    for _ in range(400):
        arm.run(0.01)
        position = arm.pressing.at(0.0).position
        assert position is not None
        places.append(position[0])
    assert np.diff(places).max() <= 2e-3 * 0.01 + 1e-12


@pytest.mark.parametrize(
    ("at", "stiffness", "why"),
    [(0.05, 100.0, "nothing was felt within 10 mm"), (0.004, 2.0, "not reached within 10 mm")],
)
def test_it_goes_back_where_there_is_nothing_or_not_enough(
    at: float, stiffness: float, why: str
) -> None:
    arm = Spring(at, stiffness)
    arm.run(40.0)
    assert arm.pressing.phase is Phase.ENDED
    assert arm.pressing.at(0.0) == TARGET
    (notice,) = arm.pressing.notices()
    assert notice.kind == "press-failed"
    assert notice.standing
    assert why in notice.text


def test_it_goes_back_when_the_contact_is_lost() -> None:
    arm = Spring(0.003, 200.0)
    arm.run(8.0)
    arm.at = 1.0  # it gives way
    arm.run(4.0)
    assert arm.pressing.phase is Phase.ENDED
    assert "lost" in arm.pressing.notices()[0].text
    near_its_end = Spring(0.003, 200.0, PRESS.model_copy(update={"travel": 4e-3}))
    near_its_end.run(8.0)
    near_its_end.at = 1.0
    near_its_end.run(4.0)
    assert "gave way, by more than the travel of 4 mm" in near_its_end.pressing.notices()[0].text


def test_it_goes_back_when_too_much_is_felt_or_nothing_although_it_is_held_back() -> None:
    arm = Spring(0.003, 200.0)
    arm.run(8.0)
    arm.at = -0.0003  # it comes nearer
    arm.run(4.0)
    assert "presses with" in arm.pressing.notices()[0].text
    numb = Spring(0.003, 1e4, late=10_000)
    numb.run(8.0)
    assert "held back" in numb.pressing.notices()[0].text
    assert max(numb.forces) < 0.06


@pytest.mark.parametrize(
    ("at", "reach", "late", "why"),
    [
        (0.05, 0.004, 10, "no farther than 4.0 mm along the direction, and nothing is felt there"),
        (
            0.003,
            0.005,
            10,
            "no farther than 3.0 mm along the direction, and it presses with 20 mN of",
        ),
        (0.003, 0.009, 10_000, "held back"),  # it could go on
        (0.003, 0.007, 10_000, "no farther than 3.0 mm along the direction"),
    ],
)
def test_the_end_of_the_arms_reach_is_told_from_something_that_holds_the_tip_back(
    at: float, reach: float, late: int, why: str
) -> None:
    arm = Spring(at, 1e3, late=late, reach=reach)
    arm.run(10.0)
    assert why in arm.pressing.notices()[0].text
    assert arm.forces[-1] == 0.0
    assert max(arm.forces) < 0.06


def test_a_force_is_kept_where_the_pose_is_a_little_out_of_reach() -> None:
    arm = Spring(0.003, 1e3, reach=0.0062)  # 6.03 mm are needed
    arm.run(8.0)
    arm.reach = 0.0052
    arm.run(1.0)
    assert arm.pressing.phase is Phase.PRESSING
    arm.reach = 0.0035
    arm.run(4.0)
    text = arm.pressing.notices()[0].text
    assert "no farther than 3.0 mm along the direction, and it presses with" in text
    assert "of 30 mN" in text


@pytest.mark.parametrize("inside", [0.0, 3e-4])
def test_it_goes_back_when_the_tip_touched_something_before_the_approach(inside: float) -> None:
    arm = Spring(-inside, 200.0, late=10_000)
    arm.run(0.75)
    assert arm.pressing.phase is Phase.APPROACHING
    arm.run(0.2)
    assert arm.pressing.is_blocked
    assert arm.pressing.touches
    assert math.isnan(arm.pressing.force)  # not known: it began before it was watched
    arm.run(3.0)
    assert arm.forces[-1] == 0.0
    assert arm.pressing.phase is Phase.ENDED
    assert "holds the tip at the target" in arm.pressing.notices()[0].text
    position = arm.pressing.at(0.0).position
    assert position is not None
    assert 2e-3 < 0.02 - inside - cast("float", position[0]) < 5e-3


@pytest.mark.parametrize("stiffness", [100.0, 2e3])
def test_it_goes_back_from_an_object_on_the_way_that_lets_the_target_unreached(
    stiffness: float,
) -> None:
    """The tip is held a millimetre short of its target, and feedback presses ever harder."""
    pressing, creep = Pressing(PRESS, TARGET, PressingTuning()), Spring(1.0, 1.0).creep
    c, wall, free, forces = COMPLIANCE[0, 0], 0.019, 0.0, []
    none = TipForce(False, np.zeros(3), 1e-6 * np.eye(3), np.zeros(3))
    for tick in range(1600):
        if tick == 800:
            assert pressing.phase is Phase.ENDED
            assert forces[-1] == 0.0
            wall -= 4e-3  # the object follows, and the tip goes back once more
        forces.append(max(0.0, stiffness * (free - wall) / (1 + stiffness * c)))
        tip = np.array([free - c * forces[-1], 0.0, 0.1])
        offset = np.array([tip[0] - free, 0.0, 0.0, 0.0, 0.0, 0.0])
        pressing.advance(
            0.01, False, True, tip, offset, none, creep, np.eye(3), COMPLIANCE, np.zeros(3)
        )  # fmt: skip
        position = pressing.at(0.0).position
        assert position is not None
        goal = cast("float", position[0]) - pressing.corrected(offset)[0]
        free += float(np.clip(0.1 * (goal - free), -1e-3, 1e-3))  # 0.1 s late
    assert pressing.phase is Phase.ENDED
    assert max(forces) < 0.1
    assert forces[-1] == 0.0
    assert 2e-3 < wall - tip[0] < 5e-3


def test_an_error_of_the_model_that_feedback_removes_holds_nothing_back() -> None:
    watch, target = ObstructionWatch(ObstructionTuning()), np.array([0.02, 0.01, 0.1])
    goal = target.copy()
    for _ in range(2000):  # everything moves the tip by a third less than modelled
        tip = 0.7 * goal
        assert not watch.take(tip, np.concatenate([tip - goal, np.zeros(3)]), target)
        goal = goal + 0.05 * (target - tip)
    assert np.linalg.norm(tip - target) < 1e-6


@pytest.mark.parametrize(("left", "holds"), [(3e-4, False), (2e-3, True)])
def test_an_offset_that_changes_with_the_posture_holds_nothing_back(
    left: float, holds: bool
) -> None:
    """Feedback keeps the tip near its target then; an object keeps it off."""
    watch, target = ObstructionWatch(ObstructionTuning()), np.array([0.02, 0.01, 0.1])
    tip, found = target - np.array([left, 0.0, 0.0]), False
    for offset in np.linspace(0.0, -8e-3, 1000):
        watch.change_posture(1e-4)
        found = found or watch.take(tip, np.array([offset, 0.0, 0.0, 0.0, 0.0, 0.0]), target)
    assert found is holds


def test_the_offset_is_kept_along_the_direction_only() -> None:
    arm = Spring(0.003, 200.0)
    arm.run(6.0)
    offset = np.array([-3e-3, 1e-3, 2e-3, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(arm.pressing.corrected(offset), [0, *offset[1:]], atol=1e-12)
    waiting = Pressing(PRESS, TARGET, PressingTuning())
    assert waiting.corrected(offset) is offset


def test_it_waits_until_the_creep_to_come_is_known_but_not_for_ever() -> None:
    arm, t = Spring(0.003, 200.0), PressingTuning()
    arm.creep.advance(np.inf, np.zeros(3), 4e-7 * np.eye(3))
    arm.creep.advance(0.5, np.full(3, 2e5), 4e-7 * np.eye(3))  # 80 mm, whose creep is to come
    arm.run(t.longest_rest - 0.5)
    assert arm.pressing.phase is Phase.GOING
    arm.run(1.0)
    assert arm.pressing.phase is Phase.APPROACHING


def test_it_does_not_begin_while_something_touches_the_tip() -> None:
    pressing, force = (
        Pressing(PRESS, TARGET, PressingTuning()),
        TipForce(True, 0.05 * N, 1e-6 * np.eye(3), 5e-3 * N),
    )
    still, tip, offset = CreepEstimator(3, False, CreepTuning()), np.zeros(3), np.zeros(6)
    for _ in range(900):
        pressing.advance(
            0.01, True, True, tip, offset, force, still, np.eye(3), COMPLIANCE, np.zeros(3)
        )  # fmt: skip
    assert pressing.phase is Phase.GOING
    assert pressing.begins_free
    assert [notice.kind for notice in pressing.notices()] == ["press-waits"]


@pytest.mark.parametrize(("pause", "is_told"), [(0.6, True), (5.5, False)])
def test_a_press_tells_that_it_waits_for_pushes_that_come_and_go(
    pause: float, is_told: bool
) -> None:
    """For an arm that swings after each, so that it does not rest between them."""
    pressing, still = (
        Pressing(PRESS, TARGET, PressingTuning()),
        CreepEstimator(3, False, CreepTuning()),
    )
    pushed, free = (
        TipForce(touches, force * N, 1e-6 * np.eye(3), 5e-3 * N)
        for touches, force in ((True, 0.05), (False, 0.0))
    )
    for time in np.arange(0.0, 40.0, 0.01):
        force = pushed if time % (1.0 + pause) < 1.0 else free
        pressing.advance(
            0.01, False, True, np.zeros(3), np.zeros(6), force, still, np.eye(3), COMPLIANCE,
            np.zeros(3),
        )  # fmt: skip
    assert pressing.phase is Phase.GOING
    assert [notice.kind for notice in pressing.notices()] == ["press-waits"] * is_told


@pytest.mark.parametrize(
    ("tip", "kinds"),
    [
        ([0.023, 0.03, 0.1], ["press-beyond"]),
        ([0.021, 0.0, 0.1], []),  # about at its target
        ([-0.02, 0.03, 0.1], []),
    ],
)
def test_a_press_that_begins_beyond_its_target_is_told_once(
    tip: list[float], kinds: list[str]
) -> None:
    pressing, free = (
        Pressing(PRESS, TARGET, PressingTuning()),
        TipForce(False, np.zeros(3), 1e-6 * np.eye(3), np.zeros(3)),
    )
    still, found = CreepEstimator(3, False, CreepTuning()), []
    for place in (np.array(tip), np.array([0.03, 0.0, 0.1])):  # it overshoots later
        pressing.advance(
            0.01, False, True, place, np.zeros(6), free, still, np.eye(3), COMPLIANCE, np.zeros(3)
        )  # fmt: skip
        found += [notice.kind for notice in pressing.notices()]
    assert found == kinds


def test_the_creep_that_is_predicted_moves_the_pressed_arm_back() -> None:
    arm = Spring(0.003, 200.0)
    arm.run(6.0)
    offset = np.array([-3e-3, 1e-3, 2e-3, 0.1, 0.2, 0.3])
    kept = arm.pressing.corrected(offset)
    arm.creep.advance(np.inf, np.zeros(3), 4e-7 * np.eye(3))
    arm.creep.advance(0.5, np.array([1e4, 2e4, 0]), 4e-7 * np.eye(3))
    arm.run(0.01)
    changed = arm.pressing.corrected(offset) - kept
    np.testing.assert_allclose(changed[:3], N * arm.creep.displacement[0], atol=1e-12)
    assert changed[0] < 0


def test_a_force_that_is_forgotten_is_an_error_of_the_model() -> None:
    estimator = TouchEstimator([3], vibrates=False, damping=0.04, tuning=TouchTuning())
    rng = np.random.default_rng(3)
    for time in np.arange(0, 8, FRAME):
        away = C @ PUSH * (time > 2.0) + NOISE * rng.standard_normal(3)
        if abs(time - 4.0) < FRAME / 2:
            assert estimator.felt.touches
            estimator.forget()
        estimator.take(time, away, P, TIP)
        assert not (time > 4.1 and estimator.felt.touches)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("dynamics", [pytest.param("quasi-static", marks=pytest.mark.long), "full"])
def test_the_simulated_arm_presses_as_hard_as_it_is_told(dynamics: str) -> None:
    """The shipped palpation, on an arm that nobody has tuned it for."""
    description = load_rig_description(ROOT / "rig" / "palpation.yaml")
    update: dict[str, Any] = {"dynamics": dynamics, "seed": 11}
    if not is_long():
        update["discretisation"] = Discretisation(
            bending_degree=2, shear_degree=1, sub_intervals=4, step=0.002
        )
    plant = cast("Any", description.plant).model_copy(update=update)
    description = description.model_copy(update={"plant": plant})
    robot = load_description(description.robot)
    rig = cast("SimulatedRig", make_rig(description, robot))
    controller = TipController(
        load_robot(robot), limits_of(description, robot), slew_of(description, robot),
        period=0.01, control=description.control, safety=description.safety,
        vibrates=dynamics == "full", slow_first_motion=False,
    )  # fmt: skip
    controller.check()
    command, forces, kinds = np.zeros(robot.n_pressures), [], set()
    with rig:
        rig.supply.arm()
        controller.begin(rig.clock.now())
        controller.set_task(load_task(ROOT / "problems" / "two_segment_palpation.yaml"))
        for _ in range(1900):
            now = rig.clock.now()
            controller.observe(now, command, rig.supply.read(), rig.tracker.read())
            command = controller.compute(now).pressures
            rig.supply.command(command)
            rig.clock.sleep_until(now + 0.01)
            forces.append(rig.world.plant.contact_force())
            kinds |= {notice.kind for notice in controller.notices()}
        status = controller.status(rig.clock.now())
        tip = rig.world.plant.tip_pose()[:3, 3]
    controller.close()
    assert np.mean(forces[-300:]) == pytest.approx(0.03, abs=0.2 * 0.03 + 3e-3)
    assert max(forces) < 1.6 * 0.03 + 6e-3
    assert status.press_force == pytest.approx(0.03, abs=3e-3)
    assert status.press_goal == 0.03
    assert status.touches
    assert status.wrench[0] < -0.02
    assert status.task == "press"
    assert {"touch", "pressing"} <= kinds
    assert "press-failed" not in kinds
    assert abs(tip[1]) < 2e-3
    assert abs(tip[2] - 0.195) < 3e-3


# Tasks with a press ------------------------------------------------------------------------------


def asked(**update: Any) -> Task:
    given: dict[str, Any] = {
        "target": Target(position=(0.01, 0.0, 0.195)),
        "press": Press(force=0.03, direction=(1, 0, 0)),
        "stiffness": StiffnessGoal(maximise=StiffnessMeasure(direction=(1, 0, 0))),
    }
    return Task(**{**given, **update})


HANGING = load_robot("stiff-flop-2-hanging")


@pytest.mark.usefixtures("compiled")
def test_a_press_is_planned_as_its_reaction() -> None:
    pressed = PressureSolver(HANGING, asked()).solve()
    load = Load(force=(-0.03, 0.0, 0.0))
    loaded = PressureSolver(HANGING, asked(press=None, load=load)).solve()
    assert pressed.found
    assert pressed.pressures is not None
    np.testing.assert_allclose(pressed.pressures, loaded.pressures, atol=1.0)
    assert np.linalg.norm(pressed.tip_position - np.array([0.01, 0.0, 0.195])) < 1.1e-4


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    ("press", "why"),
    [
        (Press(force=0.03, direction=(0, 0, 1)), "cannot feel"),
        (Press(force=0.5, direction=(1, 0, 0)), "cannot hold 0.5 N there"),
        (Press(force=0.0037, direction=(1, 0, 0)), "press with more than 3.75 mN"),
        (Press(force=0.03, direction=(1, 0, 0), tolerance=0.03), "may be none at all"),
        (Press(force=0.03, direction=(1, 0, 0), speed=0.1), "press.speed must be at most"),
    ],
)
def test_what_cannot_be_held_or_felt_is_refused(press: Press, why: str) -> None:
    solution = PressureSolver(HANGING, asked(press=press)).solve()
    assert not solution.found
    assert why in solution.message
    controller = TipController(
        HANGING, limits_of(*_rig()), np.full(6, 5e5), period=0.01, vibrates=False
    )
    with pytest.raises(InputError, match="press: the arm cannot press like that"):
        controller.check_ahead(asked(press=press))
    controller.close()


@pytest.mark.usefixtures("compiled")
def test_a_pose_out_of_reach_is_no_fault_of_the_press() -> None:
    solution = PressureSolver(HANGING, asked(target=Target(position=(0.2, 0.0, 0.195)))).solve()
    assert not solution.found
    assert "closest configuration" in solution.message
    assert "hold" not in solution.message.partition(";")[0]


def _rig() -> tuple[Any, Any]:
    description = load_rig_description(ROOT / "rig" / "palpation.yaml")
    return description, load_description(description.robot)


@pytest.mark.parametrize(
    ("update", "why"),
    [
        ({"load": Load(force=(0, 0, 0.1))}, "cannot be combined with load"),
        ({"target": Target(position=(None, 0, 0.2))}, "needs a target with a position"),
        ({"target": Target(pointing=(0, 0, 1))}, "needs a target with a position"),
    ],
)
def test_a_press_that_makes_no_sense_is_refused(update: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        asked(**update)


def test_a_surface_pushes_back_and_a_mounted_probe_takes_its_place() -> None:
    description, robot = _rig()
    surface = SoftSurface(point=(0.0, 0.0, 0.0), normal=(-1, 0, 0), stiffness=100.0)
    plant = description.plant.model_copy(update={"surface": surface, "dynamics": "quasi-static"})
    rig = cast("SimulatedRig", make_rig(description.model_copy(update={"plant": plant}), robot))
    with rig:
        rig.world.plant.settle(np.array([0.6e5, 0, 0, 0, 0, 0]))
        rig.clock.sleep(1.0)
        x = float(rig.world.plant.tip_pose()[0, 3])
        assert rig.world.plant.contact_force() == pytest.approx(100 * max(x, 0.0), abs=1e-6)
