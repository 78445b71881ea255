"""What reaches the supply while an experiment runs: slew, pauses, gauges, ramps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from conftest import is_long
from experiment_runs import (
    RATE,
    began,
    first_row_alone,  # noqa: F401
    short,
    stall,
    written,
)
from fake_rig import PERIOD, fake_rig, world_of
from stiffopt.errors import DeviceError, InputError, StiffoptError
from stiffopt.experiments.conductor import Conductor
from stiffopt.experiments.kinematics import PressureSequence, run_kinematics
from stiffopt.rig.settings import Safety
from stiffopt.safety.gate import effective_slew
from stiffopt.safety.settings import COMMANDS

pytestmark = pytest.mark.usefixtures("first_row_alone")


def hold(conductor: Conductor, target: float, seconds: float) -> None:
    conductor.settle(np.full(3, target), lambda rows: False, seconds)


def test_an_experiment_needs_the_gate() -> None:
    rig = fake_rig()
    rig.supply = rig.bare  # type: ignore[attr-defined]
    with rig, pytest.raises(InputError, match=r"open it by stiffopt\.open_rig"):
        Conductor(rig, RATE)


@pytest.mark.parametrize("gauges", [True, False])
def test_a_pause_shorter_than_a_command_holds_changes_nothing(gauges: bool) -> None:
    rig = fake_rig(slew=1e5)
    world_of(rig).watchdog = 0.3  # of the device: it is spoken to all the time
    if not gauges:
        world_of(rig).gauge = lambda p: np.full(3, np.nan)
    with rig:
        conductor = began(rig, 1e5)
        before = len(world_of(rig).writes)
        for pause in (0.32, 0.36, 0.49):
            stall(rig, pause)
            hold(conductor, 1e5, 0.3)
        assert set(written(rig, before)) == {1e5}
        assert world_of(rig).pressures == pytest.approx([1e5] * 3, rel=1e-3)


@pytest.mark.parametrize("start", [1e5, -0.5e5], ids=["pressure", "vacuum"])
def test_after_a_longer_pause_pressures_come_back_slowly(start: float) -> None:
    """The command has expired: the arm is being let down, and goes on from there."""
    rig = fake_rig(slew=1e5, low=-1.5e5)
    with rig:
        conductor = began(rig, start)
        before = len(world_of(rig).writes)
        stall(rig, 0.9)
        low = abs(world_of(rig).commanded[0])
        assert 0.5 * abs(start) < low < 0.7 * abs(start)
        conductor.ramp(np.full(3, start))
        assert np.diff(np.abs(written(rig, before))).max() <= 1001


@pytest.mark.parametrize("pause", [1.6, 10.0])
def test_after_a_long_pause_the_arm_is_vented_and_the_experiment_ends(pause: float) -> None:
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = began(rig, 1e5)
        stall(rig, pause)
        assert not world_of(rig).commanded.any()
        before = len(world_of(rig).writes)
        with pytest.raises(DeviceError, match=r"stalled for 1.* s.*--resume"):
            conductor.tick(np.full(3, 1e5))
        assert not written(rig, before).any()


@pytest.mark.parametrize("pause", [0.6, 5.0])
def test_after_everything_stood_still_nothing_is_commanded(pause: float) -> None:
    """Not even what guards the arm has run meanwhile; the device has vented by itself."""
    rig = fake_rig(slew=1e5)
    world_of(rig).watchdog = 0.3
    with rig:
        conductor = began(rig, 1e5)
        before = len(world_of(rig).writes)
        world_of(rig).sleep_until(world_of(rig).t + pause)
        with pytest.raises(StiffoptError, match=r"no command came|stalled"):
            conductor.tick(np.full(3, 1e5))
        assert not written(rig, before).any()


@pytest.mark.parametrize("start", [1.5e5, -0.2e5])
@pytest.mark.parametrize("error", [-0.07e5, 0.07e5, 0.145e5])
@pytest.mark.parametrize("pause", [0.0, 0.4])
def test_a_gauge_that_is_wrong_moves_nothing(start: float, error: float, pause: float) -> None:
    """Too low by half of `Safety.max_pressure_error`, or too high by all of it."""
    rig = fake_rig(slew=1e5, low=-0.6e5)
    world_of(rig).gauge = lambda p: p + error
    with rig:
        conductor = began(rig, start)
        before = len(world_of(rig).writes)
        for target in (start, start / 2, start):
            stall(rig, pause)
            conductor.ramp(np.full(3, target))
            hold(conductor, target, 1.0)
        moved = np.diff(written(rig, before - 1))
    assert np.abs(moved).max() <= 1001


@pytest.mark.parametrize("shown", [0.0, 1.5e5, 9e5, np.nan])
@pytest.mark.parametrize("pause", [0.0, 0.4])
def test_one_or_two_bad_readings_move_nothing(shown: float, pause: float) -> None:
    rig = fake_rig(slew=1e5)
    world = world_of(rig)
    bad: list[float] = []
    world.gauge = lambda p: np.full(3, bad.pop()) if bad else p
    with rig:
        conductor = began(rig, 1e5)
        before = len(world.writes)
        for count in (1, 2):
            bad.extend([shown] * count)
            stall(rig, pause)
            conductor.ramp(np.full(3, 1e5))
            hold(conductor, 1e5, 1.0)
        assert set(written(rig, before)) == {1e5}
        conductor.ramp(np.zeros(3))
    assert np.diff(written(rig, before)[:-1]).min() >= -1001


@pytest.mark.parametrize("shown", [9e5, np.nan])
def test_readings_that_stay_impossible_end_the_experiment(shown: float) -> None:
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = began(rig, 1e5)
        world_of(rig).gauge = lambda p: np.array([p[0], shown, p[2]])
        with pytest.raises(DeviceError, match=r"channel 2 reads .*, which cannot be"):
            hold(conductor, 1e5, 1.0)
    assert not world_of(rig).commanded.any()


def test_slow_regulators_are_not_taken_for_lost_pressure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fake_rig.LAG", 2.0)
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = began(rig, 1.5e5)
        hold(conductor, 1.5e5, 5.0)
        for _ in range(200):
            conductor.tick(np.full(3, 0.2e5))
        before = len(world_of(rig).writes)
        for pause in (0.0, 0.2, 0.4, 0.4):
            stall(rig, pause)
            hold(conductor, 0.2e5, 3.0)
        assert set(written(rig, before)) == {0.2e5}
        conductor.ramp(np.full(3, 1.5e5))
        hold(conductor, 1.5e5, 3.0)


@pytest.mark.parametrize("start", [1e5, -0.5e5], ids=["pressure", "vacuum"])
@pytest.mark.parametrize("left", [0.0, 0.3])
def test_pressure_that_is_lost_ends_the_experiment(start: float, left: float) -> None:
    """Somebody has shut the air, or a tube is off: what was measured then is worth nothing."""
    rig = fake_rig(slew=1e5, low=-1e5)
    world, lost = world_of(rig), [False]
    world.gauge = lambda p: np.array([p[0] * left, p[1], p[2]]) if lost[0] else p
    with rig:
        conductor = began(rig, start)
        hold(conductor, start, 10.0)
        lost[0] = True
        before = world.t
        with pytest.raises(DeviceError, match=r"channel 1 reads .* (leaks|is stuck)"):
            hold(conductor, start, 5.0)
        assert world.t - before < 1.0
    assert not world.commanded.any()


def test_pressure_that_nobody_commanded_ends_the_experiment() -> None:
    rig = fake_rig(slew=1e5)
    with rig:
        conductor = Conductor(rig, RATE)
        conductor.start()
        world_of(rig).gauge = lambda p: p + np.array([0.0, 0.0, 0.5e5])
        with pytest.raises(DeviceError, match=r"channel 3 reads 0\.5 bar.* is stuck"):
            hold(conductor, 0.0, 1.0)


def test_a_loop_that_was_held_up_does_not_jump_on_a_rig_without_slew(tmp_path: Path) -> None:
    rig = fake_rig(slew=None)
    assert effective_slew(rig).tolist() == [COMMANDS.default_slew] * 3
    stalls = iter([False] * 400 + [True] + [False] * 10000)

    def check() -> None:
        if next(stalls):
            stall(rig, 1.4)

    with rig:
        run_kinematics(rig, tmp_path, short(repetitions=1, period=4.0), rate=RATE, check=check)
    values = written(rig)
    assert values.max() > 0.45e5
    most = COMMANDS.default_slew * COMMANDS.pause_periods * PERIOD
    assert np.abs(np.diff(values)).max() <= most + 1e-6
    quick_teeth = PressureSequence.sawtooth(np.zeros(3), [1.5e5], 0.1, effective_slew(rig))
    assert quick_teeth.times[1] == pytest.approx(1.5e5 / COMMANDS.default_slew)


@pytest.mark.parametrize(("low", "high"), [(0.1e5, 0.6e5), (-0.6e5, 0.6e5), (-0.6e5, 0.0)])
def test_every_arm_can_be_ramped_down(low: float, high: float) -> None:
    rig = fake_rig(slew=1e5, low=low, high=high)
    target = 0.3e5 if high > 0 else -0.3e5
    with rig:
        conductor = began(rig, target)
        assert world_of(rig).commanded.tolist() == [target] * 3
        started = world_of(rig).t
        conductor.ramp(np.zeros(3))
        assert not world_of(rig).commanded.any()
        assert world_of(rig).t - started < 1.0


def test_a_ramp_that_gets_nowhere_ends() -> None:
    """Three channels together need more force than the rig allows."""
    rig = fake_rig(slew=1e5, high=0.2e5, safety=Safety(max_force=0.5))
    with rig:
        conductor = Conductor(rig, RATE)
        conductor.start()
        with pytest.raises(DeviceError, match="the gate limits them"):
            conductor.ramp(np.full(3, 0.2e5))
    force = max(rig.force(value) for _, value in world_of(rig).writes)
    assert 0.4 < force <= 0.5


def test_a_slew_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="slew: expected values above 0"):
        fake_rig(slew=0.0)


LIMITS = [(0.0, 1.5e5), (0.1e5, 1e5), (-0.6e5, 0.6e5), (-0.9e5, 0.0)]


STEPS = st.tuples(
    st.sampled_from(["tick", "ramp", "stall", "halt", "spike"]), st.floats(0, 1), st.booleans()
)


@examples(
    max_examples=40 if is_long() else 12, deadline=None, derandomize=True,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
@example(LIMITS[0], 0.3, 0.0, [("ramp", 0.7, True), ("stall", 1.0, True), ("tick", 0.7, True)], 0)
@example(LIMITS[1], 0.3, 0.0, [("ramp", 0.2, True), ("halt", 1.0, True), ("ramp", 0.2, False)], 0)
@example(LIMITS[3], math.inf, -0.07e5, [("ramp", 0.7, True)] * 3, 1)
@given(
    limits=st.sampled_from(LIMITS),
    watchdog=st.sampled_from([0.3, 0.5, math.inf]),
    error=st.sampled_from([0.0, 0.145e5, -0.07e5]),
    steps=st.lists(STEPS, min_size=1, max_size=7),
    seed=st.integers(0, 99),
)
def test_commands_keep_their_promises(
    limits: tuple[float, float],
    watchdog: float,
    error: float,
    steps: list[tuple[str, float, bool]],
    seed: int,
) -> None:
    """Whatever happens: within limits and slew, or vented; and an end leaves the arm vented."""
    low, high = limits
    slew = [1e5, 0.3e5, None][seed % 3]
    rig = fake_rig(slew=slew, low=low, high=high)
    world, bad = world_of(rig), [0]
    world.watchdog = watchdog

    def gauge(p: np.ndarray) -> np.ndarray:
        bad[0] = max(bad[0] - 1, 0)
        return p + error if not bad[0] else np.full(3, 7e4 * (seed % 5 - 2))

    world.gauge = gauge
    ended = False
    with rig:
        conductor = began(rig, min(max(0.0, low), high))
        try:
            for what, share, long in steps:
                target = np.array([share, 1 - share, 0.5]) * (high - low) + low
                target = np.where([long, True, not long], target, 0.0)
                if what == "stall":
                    stall(rig, (2.0 if long else 0.6) * share)
                elif what == "halt":  # of all that runs here
                    world.sleep_until(world.t + (2.0 if long else 0.6) * share)
                elif what == "spike":
                    bad[0] = 2  # the next reading but none after it
                elif what == "ramp":
                    conductor.ramp(target)
                    assert world.commanded.tolist() == target.tolist()
                for _ in range(20 if long else 3):
                    conductor.tick(target)
            conductor.ramp(np.zeros(3))
            assert not world.commanded.any()
        except StiffoptError:
            ended = True
            assert any(what in ("stall", "halt") for what, _, _ in steps)
    assert not world.commanded.any()
    times = np.array([time for time, _ in world.writes])
    values = np.array([value for _, value in world.writes])
    assert ((values == 0) | ((values >= low) & (values <= high))).all()
    edge = min(max(0.0, low), high)  # what is nearest to nothing that can be held
    rate = COMMANDS.default_slew if slew is None else slew
    for k in range(1, len(values)):
        passed = min(times[k] - times[k - 1], COMMANDS.pause_periods * PERIOD)
        step = rate * passed + 1e-6
        vented = not values[k].any()  # at once, when the arm is closed or a command has expired
        for old, new in zip(values[k - 1], values[k], strict=True):
            smooth = abs(new - old) <= step
            gap = (old, new) in ((0, edge), (edge, 0)) or (
                new == 0 and abs(old) <= abs(edge) + step
            )
            assert smooth or gap or vented, (k, old, new)
    assert ended or not values[-1].any()
