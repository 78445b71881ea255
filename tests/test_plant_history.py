"""The simulated arm does what its robot file says of its channels: history and corrections."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from independent.arms import FLOP, Arm
from independent.motions import turn_z
from references import free_tip
from stiffopt.control.channels import Channels
from stiffopt.control.regulators import PressureEstimator
from stiffopt.control.tuning import RegulatorTuning
from stiffopt.lie import log
from stiffopt.model.description import RobotDescription
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.segment import Corrections
from stiffopt.plant.plant import Plant, SimulationError
from stiffopt.plant.settings import Discretisation, Mismatch, PlantSettings, Silicone
from stiffopt.rig.interface import PressureLimits
from stiffopt.rig.settings import ControlSettings

Vector = NDArray[np.float64]

BAR = 1e5
PLAIN = Silicone(law="linear", damping=0.0, creep=(), hysteresis=())
CONSTANT = replace(FLOP, factors=(0.0, 1.2, 1.05))  # a modulus that pressure does not change
ONE, TWO = Arm((CONSTANT,)), Arm((CONSTANT, CONSTANT))
PLAYS = (Play(width=5e3, share=0.1), Play(width=2e4, share=0.15))
HYSTERETIC = History(play=PLAYS)
LARGEST = 0.1 * 5e3 + 0.15 * 2e4


def robot(arm: Arm, **changes: Any) -> RobotDescription:
    """Robot whose segments all have the same history, corrections and the like."""
    described = RobotDescription(**arm.mapping())
    segments = [segment.model_dump() | changes for segment in described.segments]
    return RobotDescription(**{**described.model_dump(), "segments": segments})


def make(description: RobotDescription, silicone: Silicone = PLAIN, **settings: Any) -> Plant:
    settings.setdefault("dynamics", "quasi-static")
    return Plant(description, PlantSettings(silicone=silicone, **settings))


def settled(plant: Plant, p: ArrayLike) -> Vector:
    plant.settle(p)
    return plant.tip_pose()


# -- history --------------------------------------------------------------------------------


@pytest.mark.parametrize("dynamics", ["quasi-static", "full"])
def test_the_shape_comes_late_and_lags(dynamics: str) -> None:
    """Without inertia it is that of the lagged pressure; with some it is so once it is slow."""
    damped = PLAIN.model_copy(update={"damping": 0.5})
    plant = make(
        robot(ONE, history=History(dead_time=0.05, lag=0.3)),
        PLAIN if dynamics == "quasi-static" else damped,
        dynamics=dynamics,
    )
    p = BAR * np.array([1.0, 0.2, 0.0])
    plant.advance(0.05, p)
    assert plant.tip_pose() == pytest.approx(free_tip(ONE, np.zeros(3)), abs=1e-7)
    for wait in (0.013, 0.2, 1.0):
        plant.advance(wait, p)
        u = p * (1 - np.exp(-(plant.time - 0.05) / 0.3))
        if dynamics == "quasi-static":
            assert plant.tip_pose() == pytest.approx(free_tip(ONE, u), abs=1e-6)
    tolerance = 1e-6 if dynamics == "quasi-static" else 1e-3
    assert plant.tip_pose() == pytest.approx(free_tip(ONE, u), abs=tolerance)
    plant.advance(4.0, p)
    assert plant.tip_pose() == pytest.approx(free_tip(ONE, p), abs=1e-5)


def test_each_segment_has_its_own_history() -> None:
    description = RobotDescription(**TWO.mapping())
    mapping = description.model_dump()
    mapping["segments"][1]["history"] = {"creep": [{"time": 0.5, "share": 0.3}]}
    plant = make(RobotDescription(**mapping))
    p = BAR * np.array([0.6, 0.1, 0.0, 0.0, 0.8, 0.2])
    plant.advance(0.4, p)
    slow = 1 - 0.3 * np.exp(-0.4 / 0.5)
    u = p * np.array([1, 1, 1, slow, slow, slow])
    assert plant.tip_pose() == pytest.approx(free_tip(TWO, u), abs=1e-6)


def test_the_same_command_from_above_and_from_below() -> None:
    """The tips are apart by what twice the largest memory does, in every channel that moved."""
    history = HYSTERETIC.model_copy(update={"lag": 0.1, "creep": (Creep(time=0.2, share=0.1),)})
    p, swing = BAR * np.array([0.7, 0.4, 0.3]), BAR * np.array([0.5, 0.0, 0.0])
    tips = {}
    for name, first in (("below", p - swing), ("above", p + swing)):
        plant = make(robot(ONE, history=history), discretisation=Discretisation(step=0.02))
        plant.advance(2.0, p - swing)  # channels 2 and 3 rise in both cases
        plant.advance(4.0, first)
        plant.advance(4.0, p)
        tips[name] = plant.tip_pose()
    change = np.array([2 * LARGEST, 0, 0])
    middle = p - LARGEST * np.array([0, 1, 1])
    assert tips["below"] == pytest.approx(free_tip(ONE, middle - change / 2), abs=1e-6)
    assert tips["above"] == pytest.approx(free_tip(ONE, middle + change / 2), abs=1e-6)
    apart = np.asarray(log(np.linalg.inv(tips["below"]) @ tips["above"]))
    assert np.linalg.norm(apart[:3]) > 1e-3
    model = Manipulator(RobotDescription(**ONE.mapping()))
    expected = model.tip_jacobian(middle) @ change  # its arcs are per deformed length: not exact
    for half in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(apart[half] - expected[half])
        assert error < 0.1 * np.linalg.norm(expected[half])


def test_deflated_chambers_stay_stretched_and_the_daemon_makes_up_for_it() -> None:
    """One channel is kept after all were: what was let down of elongation stays by half."""
    history = History(play=[Play(width=2e4, share=0.5, of="elongation")])
    described = robot(ONE, history=history)
    plant = make(described)
    control = ControlSettings(regulator_lag=0.0, regulator_dead_time=0.0)
    fast, tuning = np.full(3, 1e9), RegulatorTuning()
    limits = PressureLimits(np.zeros(3), np.full(3, 2 * BAR))
    channels = Channels(limits, fast, np.full(3, 1e4), tuning)
    estimator = PressureEstimator(described, control, 0.1, fast, tuning, channels)

    def command(p: Vector) -> None:
        plant.advance(0.1, p)
        estimator.advance(1, p, p)

    full, kept = BAR * np.array([0.9, 0.9, 0.9]), BAR * np.array([0.9, 0.0, 0.0])
    command(full)
    assert plant.tip_pose() == pytest.approx(free_tip(ONE, full - 0.5 * 2e4), abs=1e-6)
    command(kept)
    assert plant.tip_pose() == pytest.approx(free_tip(ONE, kept + 0.5 * 2e4), abs=1e-6)
    command(np.zeros(3))
    assert plant.tip_pose()[2, 3] - free_tip(ONE, np.zeros(3))[2, 3] > 1e-3
    for wanted in (kept + 0.2 * BAR, full, kept + 0.3 * BAR):
        for _ in range(20):  # what is held back changes with the command
            command(wanted - estimator.command_offset)
        assert estimator.effective == pytest.approx(wanted, abs=1.0)
        assert plant.tip_pose() == pytest.approx(free_tip(ONE, wanted), abs=1e-5)


def test_to_settle_is_to_rise_slowly_from_rest() -> None:
    history = HYSTERETIC.model_copy(update={"dead_time": 0.1, "lag": 0.1})
    p = BAR * np.array([0.8, 0.03, 0.3])
    risen, begun = make(robot(ONE, history=history)), make(robot(ONE, history=history))
    risen.follow(np.linspace(0, 1, 300)[:, None] * p)
    risen.advance(3.0, p)
    begun.advance(0.3, BAR * np.array([0.0, 0.9, 0.9]))  # which it forgets
    begun.settle(p)
    u = p - [LARGEST, 0.25 * 3e3, LARGEST]  # the second is inside both plays
    assert risen.tip_pose() == pytest.approx(free_tip(ONE, u), abs=1e-6)
    assert begun.tip_pose() == pytest.approx(free_tip(ONE, u), abs=1e-6)
    for plant in (risen, begun):
        plant.advance(0.3, 0.5 * p)
    assert begun.tip_pose() == pytest.approx(risen.tip_pose(), abs=1e-6)


def test_it_does_not_matter_how_a_trace_is_cut() -> None:
    history = HYSTERETIC.model_copy(update={"dead_time": 0.0204, "lag": 0.05})
    trace = np.random.default_rng(3).uniform(0, BAR, (60, 3))
    whole, cut = (make(robot(ONE, history=history), dynamics="full") for _ in range(2))
    whole.follow(trace)
    for part in np.split(trace, [0, 1, 8, 33]):
        cut.follow(part)
    assert cut.tip_pose() == pytest.approx(whole.tip_pose(), abs=1e-9)


def test_a_step_that_fails_has_not_been_taken() -> None:
    history = History(lag=0.02, play=PLAYS)
    good, bad = np.tile(BAR * np.array([0.5, 0.1, 0.0]), (30, 1)), np.full((30, 3), -1e9)
    failed, whole = (make(robot(ONE, history=history)) for _ in range(2))
    with pytest.raises(SimulationError):
        failed.follow(np.vstack([good, bad]))
    done = round(failed.time / failed.step)
    assert done < 60
    whole.follow(np.vstack([good, bad])[:done])
    for plant in (failed, whole):
        plant.follow(0.5 * good)
    assert failed.tip_pose() == pytest.approx(whole.tip_pose(), abs=1e-9)


def test_no_history_changes_nothing() -> None:
    trace = np.random.default_rng(2).uniform(0, BAR, (40, 3))
    tips = []
    for changes in ({}, {"history": History()}, {"corrections": Corrections()}):
        plant = make(robot(ONE, **changes), Silicone(), dynamics="full")
        plant.follow(trace)
        tips.append(plant.tip_pose())
    assert (tips[1] == tips[0]).all()
    assert (tips[2] == tips[0]).all()


def test_history_and_silicone_are_two_things() -> None:
    """Under a lag much shorter than a step, the silicone's own creep and slip are all there is."""
    trace = np.tile(BAR * np.array([0.9, 0.1, 0.0]), (200, 1))
    tips = []
    for history in (None, History(lag=1e-5)):
        plant = make(robot(ONE, history=history), Silicone())
        plant.follow(trace)
        tips.append(plant.tip_pose())
    assert tips[1] == pytest.approx(tips[0], abs=1e-9)
    assert np.abs(tips[0] - settled(plant, trace[0])).max() > 1e-4


# -- corrections ----------------------------------------------------------------------------

GAIN, OFFSET, AZIMUTH = (1.1, 0.9, 1.03), (2e3, -1e3, 500.0), (0.05, -0.1, 0.02)
CORRECTED = Corrections(gain=GAIN, offset=OFFSET, azimuth=AZIMUTH)


@pytest.mark.parametrize("key", ["gain", "offset", "azimuth"])
def test_a_correction_alone_is_that_mismatch(key: str) -> None:
    values = getattr(CORRECTED, key)
    p = BAR * np.array([0.8, 0.2, 0.4])
    corrected = make(robot(Arm((FLOP,)), corrections=Corrections(**{key: values})))
    differs = Mismatch(**{"angle" if key == "azimuth" else key: values})
    other = make(robot(Arm((FLOP,))), mismatch=differs)
    drawn = make(robot(Arm((FLOP,))))
    assert settled(corrected, p) == pytest.approx(settled(other, p), abs=1e-12)
    assert np.abs(settled(corrected, p) - settled(drawn, p)).max() > 1e-3


@pytest.mark.parametrize("history", [None, HYSTERETIC], ids=["at once", "with a history"])
def test_corrections_come_before_the_mismatch(history: History | None) -> None:
    gain, offset, angle = (0.95, 1.2, 1.0), (-700.0, 0.0, 3e3), (0.0, 0.1, -0.03)
    both = make(
        robot(Arm((FLOP,)), corrections=CORRECTED, history=history),
        Silicone(),
        dynamics="full",
        mismatch=Mismatch(gain=gain, offset=offset, angle=angle),
    )
    added = Mismatch(
        gain=[m * g for m, g in zip(gain, GAIN, strict=True)],
        offset=[m * o + n for m, o, n in zip(gain, OFFSET, offset, strict=True)],
        angle=[a + z for a, z in zip(angle, AZIMUTH, strict=True)],
    )
    one = make(robot(Arm((FLOP,)), history=history), Silicone(), dynamics="full", mismatch=added)
    for plant in (both, one):
        plant.advance(0.2, BAR * np.array([0.9, 0.0, 0.5]))
    assert both.tip_pose() == pytest.approx(one.tip_pose(), abs=1e-10)
    p = BAR * np.array([0.3, 0.6, 0.1])
    assert settled(both, p) == pytest.approx(settled(one, p), abs=1e-9)


def test_an_azimuth_turns_what_its_channel_does() -> None:
    p = BAR * np.array([0.0, 0.9, 0.0])
    plant = make(robot(ONE, corrections=Corrections(azimuth=(0.5, 0.3, -0.5))))
    turned = turn_z(0.3) @ free_tip(ONE, p) @ turn_z(-0.3)
    assert settled(plant, p) == pytest.approx(turned, abs=1e-6)


def test_the_model_and_the_plant_read_corrections_alike() -> None:
    """Their arcs, per deformed length and per rest length, differ with corrections or without."""
    p = BAR * np.array([0.5, 0.1, 0.2])
    drawn, corrected = robot(Arm((FLOP,))), robot(Arm((FLOP,)), corrections=CORRECTED)
    of_plant = settled(make(corrected), p) - settled(make(drawn), p)
    of_model = Manipulator(corrected).tip_pose(p) - Manipulator(drawn).tip_pose(p)
    for columns in (slice(0, 3), slice(3, 4)):
        expected = of_model[:3, columns]
        error = np.linalg.norm(of_plant[:3, columns] - expected)
        assert error < 0.1 * np.linalg.norm(expected)


def test_corrections_of_two_segments_are_in_the_order_of_the_channels() -> None:
    mapping = RobotDescription(**TWO.mapping()).model_dump()
    mapping["segments"][1]["corrections"] = {"gain": GAIN, "offset": OFFSET}
    p = BAR * np.array([0.6, 0.1, 0.0, 0.3, 0.8, 0.2])
    acting = p * [1, 1, 1, *GAIN] + [0, 0, 0, *OFFSET]
    tip = settled(make(RobotDescription(**mapping)), p)
    assert tip == pytest.approx(free_tip(TWO, acting), abs=1e-6)
