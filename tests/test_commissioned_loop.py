"""A loop on a rig that was commissioned: what it asks of the record, and what it takes from it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulated_loop import Lab
from stiffopt.commissioning.record import (
    CommissioningRecord,
    RecordedFinding,
    commissioned_control,
    commissioned_robot,
    fingerprints,
    save_record,
)
from stiffopt.control.state import State
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.rig.settings import ControlSettings


class Armed:
    """A loop that may be armed, on a rig that was commissioned, and its record."""

    def __init__(self, folder: Path, **record: Any) -> None:
        self.path = folder / "record.yaml"
        self.lab = Lab(ready=False, commissioning={"record": str(self.path), "required": True})
        rig_hash, robot_hash = fingerprints(self.lab.rig.robot, self.lab.rig.settings)
        place = tuple(self.lab.world.plant.tip_pose()[:3, 3].tolist())
        tracker = {"position": place, "noise": 3e-5, "rate": 40.0, "latency": 0.025, "missing": 0.0}
        channel = {
            "displacement": (0, 0, 0), "expected": (0, 0, 0), "deviation": 0.0,
            "gauge_offset": 0.0, "gauge_noise": 150.0,
        }  # fmt: skip
        values: dict[str, Any] = {
            "date": datetime.now(UTC).isoformat(), "rig": "rig", "robot": "stiff-flop-1",
            "rig_hash": rig_hash, "robot_hash": robot_hash, "fits": True,
            "tracker": tracker, "channels": [channel] * 3,
        }  # fmt: skip
        for key, value in record.items():
            old = values.get(key)
            values[key] = {**(old or {}), **value} if isinstance(value, dict) else value
        save_record(self.path, CommissioningRecord(**values))

    def refused(self) -> str:
        with pytest.raises(InputError) as refusal:
            self.lab.arm()
        return str(refusal.value)


# -- arming ---------------------------------------------------------------------------------------


def test_arming_asks_for_a_record_that_fits(tmp_path: Path) -> None:
    armed = Armed(tmp_path)
    armed.lab.arm()
    assert armed.lab.state is State.ACTIVE
    armed = Armed(tmp_path)
    armed.path.unlink()
    assert "there is no record" in armed.refused()
    assert "run 'stiffopt commission'" in armed.refused()
    finding = RecordedFinding(text="channels 1 and 2 seem swapped", fits=False)
    assert "seem swapped" in Armed(tmp_path, fits=False, findings=(finding,)).refused()
    old = (datetime.now(UTC) - timedelta(hours=30)).isoformat()
    assert "is 30 h old; at most 24 h" in Armed(tmp_path, date=old).refused()
    assert "another robot file" in Armed(tmp_path, robot_hash="0" * 16).refused()
    assert "another supply, tracker" in Armed(tmp_path, rig_hash="0" * 16).refused()
    armed = Armed(tmp_path)
    armed.path.write_text("format: stiffopt-commissioning/1\n", encoding="utf-8")
    assert "cannot be read" in armed.refused()


def test_arming_without_a_record_says_what_it_does_not_know(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a real rig always; on a simulated one if the vented tip is far from the model's."""

    def warnings(off: float, *, real: bool, commissioned: bool = False) -> list[str]:
        armed = Armed(tmp_path)
        lab, tip = armed.lab, armed.lab.controller.tip
        if not commissioned:
            update = {"required": False, "record": str(tmp_path / "none.yaml")}
            settings = lab.rig.settings
            changed = settings.commissioning.model_copy(update=update)
            lab.rig.settings = settings.model_copy(update={"commissioning": changed})
        if real:
            monkeypatch.setattr(type(lab.rig.settings.supply), "simulated", False)
        lab.controller.tip = tip + np.array([off, 0.0, 0.0])
        lab.arm()
        monkeypatch.undo()
        events, _ = lab.loop.events.since(0)
        return [event.text for event in events if event.kind == "uncommissioned"]

    assert warnings(2e-3, real=False) == []
    assert warnings(6e-3, real=True, commissioned=True) == []
    (told,) = warnings(2e-3, real=True)
    assert "no record of a commissioning fits" in told
    assert "run 'stiffopt commission'" in told.lower()
    assert "is seen" not in told
    for real in (False, True):
        (told,) = warnings(6e-3, real=real)
        assert "the vented tip is seen 6.0 mm from where the model has it" in told


def test_arming_compares_the_vented_arm_with_the_record(tmp_path: Path) -> None:
    assert "from where it was" in Armed(tmp_path, tracker={"position": (0.01, 0, 0.09)}).refused()
    armed = Armed(tmp_path)
    armed.lab.world.camera.settings = armed.lab.world.camera.settings.model_copy(
        update={"noise": 2e-4}
    )
    assert "mm and was 0.030 mm" in armed.refused()
    armed = Armed(tmp_path)
    armed.lab.world.inject("tracker", "slow")
    armed.lab.loop.configure()
    armed.lab.ticks(100)
    assert "ms old when they come" in armed.refused()
    armed = Armed(tmp_path)
    measured = armed.lab.world.measured
    armed.lab.world.measured = lambda: measured() + 6e3
    assert "the gauge of channel 1 reads 0.06" in armed.refused()


def test_nobody_arms_with_dead_gauges(tmp_path: Path) -> None:
    lab = Lab(ready=False)
    lab.world.measured = lambda: np.full(3, np.nan)
    with pytest.raises(InputError, match="gauges of channels 1, 2, 3 read nothing"):
        lab.arm()
    lab = Lab(ready=False)
    lab.world.measured = lambda: np.full(3, 1234.5)
    with pytest.raises(InputError, match="the very same number 60 times"):
        lab.arm()
    lab = Lab(ready=False, supply={"noise": 0.0, "ripple": 0.0})
    lab.arm()  # reads exactly 0, as a converter does that cannot say less
    armed = Armed(tmp_path)
    armed.lab.world.measured = lambda: np.zeros(3)
    assert "the very same number" in armed.refused()  # it had noise when it was commissioned


def test_a_record_that_is_not_required_counts_if_it_is_of_this_rig(tmp_path: Path) -> None:
    for hashes, is_refused in (({}, True), ({"rig_hash": "0" * 16}, False)):
        armed = Armed(tmp_path, fits=False, **hashes)
        free = armed.lab.rig.settings.commissioning.model_copy(update={"required": None})
        armed.lab.rig.settings = armed.lab.rig.settings.model_copy(update={"commissioning": free})
        if is_refused:
            assert "did not fit" in armed.refused()
        else:
            armed.lab.arm()


# -- what the loop takes from the record ----------------------------------------------------------


def test_the_loop_gets_the_swing_that_was_found(tmp_path: Path) -> None:
    swing = {
        "frequency": 1.7, "frequency_deviation": 1e-3, "damping": 0.035,
        "damping_deviation": 1e-3, "amplitude": 3e-3,
    }  # fmt: skip

    def settings_with(armed: Armed, **control: Any) -> tuple[float | None, float]:
        rig = armed.lab.rig
        update = {"control": ControlSettings(**control)}
        found = commissioned_control(rig.settings.model_copy(update=update), rig.robot)
        return found.frequency, found.damping

    assert settings_with(Armed(tmp_path, swing=swing)) == (1.7, 0.035)
    # the rig file's own word counts more
    assert settings_with(Armed(tmp_path, swing=swing), damping=0.06) == (1.7, 0.06)
    assert settings_with(Armed(tmp_path, swing=swing), frequency=2.0) == (2.0, 0.035)
    for changes in ({"fits": False}, {"robot_hash": "0" * 16}, {"swing": None}):
        assert settings_with(Armed(tmp_path, **{"swing": swing} | changes)) == (None, 0.06)
    armed = Armed(tmp_path)
    armed.path.write_text("format: stiffopt-commissioning/1\n", encoding="utf-8")
    assert settings_with(armed) == (None, 0.06)
    armed.path.unlink()
    assert settings_with(armed) == (None, 0.06)


def test_the_loop_gets_the_modulus_and_the_gains_that_were_measured(tmp_path: Path) -> None:
    """Elongation has no say."""
    ways, factors = np.array([(4.0, 0.0), (-2.0, 3.0), (-2.0, -3.0)]) * 1e-3, (0.7, 0.8, 0.9)
    channels = [
        {"displacement": (*(f * way), 0.0), "expected": (*way, 5e-4), "deviation": 1e-5}
        for f, way in zip(factors, ways, strict=True)
    ]

    def model_with(**record: Any) -> tuple[RobotDescription, RobotDescription]:
        rig = Armed(tmp_path, **record).lab.rig
        return rig.robot, commissioned_robot(rig.settings, rig.robot)

    robot, found = model_with(channels=channels)
    (before,), (after,) = robot.segments, found.segments
    ratio = after.material.youngs_modulus / before.material.youngs_modulus
    assert ratio == pytest.approx(1 / 0.8)
    assert after.corrections is not None
    assert after.corrections.gain == pytest.approx((7 / 8, 1.0, 9 / 8))
    assert found.tolerances is not None
    assert found.tolerances.youngs_modulus == 0.1
    for changes in ({"fits": False}, {"robot_hash": "0" * 16}, {"channels": ()}):
        robot, found = model_with(**{"channels": channels} | changes)
        assert found is robot
    still = [{**each, "expected": (0.0, 0.0, 5e-4)} for each in channels]
    back = [{**channels[0], "displacement": (-1e-4, 0.0, 0.0)}, *channels[1:]]
    for other in (still, back):
        robot, found = model_with(channels=other)
        assert found is robot
