"""The simulated devices: regulators, tracker, probe, faults, and time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.model.robot_files import load_description
from stiffopt.plant.devices import SimulatedRig, simulated_rig
from stiffopt.plant.plant import Plant, SimulationError
from stiffopt.plant.settings import Discretisation, PlantLoad, PlantSettings
from stiffopt.plant.world import FAULTS
from stiffopt.rig.config import RigDescription, limits_of
from stiffopt.rig.interface import PressureCommand

ROBOT = load_description("stiff-flop-1")
SILENT = {"noise": 0.0, "ripple": 0.0, "resolution": 0.0}
STILL = {"noise": 0.0, "angular_noise": 0.0}


def make(
    supply: dict[str, Any] | None = None,
    tracker: dict[str, Any] | None = None,
    probe: dict[str, Any] | None = None,
    plant: dict[str, Any] | None = None,
    robot: Any = ROBOT,
    armed: bool = True,
) -> SimulatedRig:
    """Return a rig that is armed as soon as it is open."""
    description = RigDescription(
        robot="stiff-flop-1",
        supply={"driver": "simulated", **SILENT, **(supply or {})},
        tracker={"driver": "simulated", **STILL, **(tracker or {})},
        probe={"driver": "simulated", "noise": 0.0, **(probe or {})},
        plant={"dynamics": "quasi-static", "faults": True, **(plant or {})},
    )
    rig = simulated_rig(description, robot, limits_of(description, robot))

    def open_and_arm() -> None:
        SimulatedRig.open(rig)
        rig.supply.arm()

    if armed:
        rig.open = open_and_arm  # type: ignore[method-assign]
    return rig


def readings(rig: SimulatedRig, duration: float, every: float = 0.001) -> np.ndarray:
    values = []
    for _ in range(round(duration / every)):
        rig.clock.sleep(every)
        values.append(rig.supply.read().pressures)
    return np.array(values)


# Regulators --------------------------------------------------------------------------------------


def test_a_set_point_arrives_after_dead_time_and_lag() -> None:
    with make({"dead_time": 0.02, "lag": 0.05, "slew": 1e9}) as rig:
        rig.command([1e5, 0.0, 5e4])
        p = readings(rig, 0.5)
        t = 0.001 * np.arange(1, 501)
        expected = np.where(t > 0.02, 1 - np.exp(-(t - 0.02) / 0.05), 0.0)
        np.testing.assert_allclose(p[:, 0] / 1e5, expected, atol=1e-9)
        np.testing.assert_allclose(p[:, 2] / 5e4, expected, atol=1e-9)
        assert not p[:, 1].any()


def test_slew_and_saturation() -> None:
    with make({"dead_time": 0.0, "lag": 0.0, "slew": 2e5, "saturation": 8e4}) as rig:
        rig.command([1.2e5, 0, 0])
        p = readings(rig, 0.6)[:, 0]
        assert np.diff(p).max() == pytest.approx(200.0)
        assert p.max() == pytest.approx(8e4)
        rig.vent()
        assert np.diff(readings(rig, 0.1)[:, 0]).min() == pytest.approx(-200.0)


def test_a_leak_lowers_the_pressure_that_a_regulator_holds() -> None:
    with make({"lag": 0.06, "leak": 0.6, "slew": 1e9}) as rig:
        rig.command([1e5, 0, 0])
        rig.clock.sleep(3)
        # (wanted - p) / lag = p / leak
        assert rig.supply.read().pressures[0] == pytest.approx(1e5 / 1.1, rel=0.01)


def test_readings_are_rounded_and_noisy() -> None:
    with make({"noise": 150.0, "resolution": 50.0, "lag": 0.0}) as rig:
        rig.command([1e5, 1e5, 1e5])
        rig.clock.sleep(1)
        p = np.array([rig.supply.read().pressures for _ in range(2000)])
        assert (p % 50 == 0).all()
        assert p.std(axis=0) == pytest.approx(150, rel=0.1)
        assert p.mean(axis=0) == pytest.approx(1e5, abs=20)


def test_an_exchange_is_a_command_and_a_reading() -> None:
    noisy = {"noise": 150.0, "resolution": 50.0, "ripple": 100.0}
    with make(noisy) as one, make(noisy) as other:
        for p in ([1.23e4, 0, 5e3], [8e4, 2e4, 0], [0, 0, 0]):
            for rig in (one, other):
                rig.clock.sleep(0.05)
            found = one.supply.exchange(p)
            other.supply.command(p)
            expected = other.supply.read()
            assert found.time == expected.time
            np.testing.assert_array_equal(found.pressures, expected.pressures)
            np.testing.assert_array_equal(one.world.set_point, other.world.set_point)
            np.testing.assert_array_equal(one.supply.commanded, p)
        one.world.inject("supply", "off")
        for p in ([1e4, 0, 0], [0, 0, 0]):
            with pytest.raises(DeviceError, match="does not answer"):
                one.supply.exchange(p)
        one.world.inject("supply", "ok")


def test_the_watchdog_vents_when_commands_stop() -> None:
    with make({"watchdog": 0.2, "lag": 0.01, "slew": 1e9, "dead_time": 0.0}) as rig:
        for _ in range(10):
            rig.command([1e5, 0, 0])
            rig.clock.sleep(0.1)
        assert rig.supply.read().pressures[0] == pytest.approx(1e5, rel=1e-3)
        rig.clock.sleep(0.15)
        assert rig.supply.read().pressures[0] < 1e5 * np.exp(-4)
        rig.clock.sleep(0.2)
        assert rig.supply.read().pressures[0] < 1e-3


@pytest.mark.parametrize("begin", [0.1, 0.3, 0.7, 1.1, 2.3])
def test_the_watchdog_is_never_late(begin: float) -> None:
    """A long sleep vents at the same moment as one that is looked at in every step."""
    ends = []
    for every in (0.001, 0.2):
        with make({"watchdog": 0.1, "lag": 0.02, "dead_time": 0.0}, {"rate": 3.0}) as rig:
            rig.clock.sleep_until(begin)
            rig.command([1e5, 0, 0])
            for _ in range(round(0.2 / every)):
                rig.clock.sleep(every)
            ends.append(rig.world.pressures[0])
    assert ends[0] == pytest.approx(ends[1], rel=1e-9)


def test_a_dump_valve_empties_what_a_stuck_regulator_holds() -> None:
    with make({"dump_valve": True}, armed=False) as rig:
        with pytest.raises(CommandError, match="arm it"):
            rig.command([1e5, 0, 0])
        rig.supply.arm()
        rig.command([1e5, 0, 0])
        rig.clock.sleep(1)
        rig.world.inject("supply", "high", 0)
        rig.clock.sleep(1)
        rig.command([0, 0, 0])
        rig.clock.sleep(1)
        assert rig.supply.read().pressures[0] == pytest.approx(1.5e5, rel=0.01)
        rig.vent()
        rig.clock.sleep(0.3)
        assert rig.world.pressures[0] < 1


# Tracker -----------------------------------------------------------------------------------------


def test_frames_come_at_their_rate_and_late() -> None:
    with make(tracker={"rate": 40.0, "latency": 0.03}) as rig:
        seen: list[Any] = []
        for _ in range(100):
            rig.clock.sleep(0.01)
            seen += rig.tracker.read()  # type: ignore[union-attr]
        assert [s.frame for s in seen] == list(range(1, len(seen) + 1))
        assert len(seen) == 38  # 40 were captured, of which two are on their way
        assert np.diff([s.time for s in seen]) == pytest.approx(0.025)
        assert all(s.received - s.time == pytest.approx(0.03) for s in seen)


def test_a_sample_is_where_the_tip_was_when_it_was_captured() -> None:
    turned = {"position": (0.1, -0.2, 0.3), "orientation": (0.5, -0.5, 0.5, 0.5)}
    sensor = {"position": (0.0, 0.002, -0.005), "orientation": (0.6, 0.0, 0.8, 0.0)}
    registration = {"tracker_in_base": turned, "tip_in_sensor": sensor}
    with make(tracker={"registration": registration, "latency": 0.04}) as rig:
        true = {}
        rig.command([1e5, 0.5e5, 0])
        for step in range(1, 400):
            rig.clock.sleep(0.001)
            true[step] = rig.world.plant.tip_pose()
        for sample in rig.tracker.read():  # type: ignore[union-attr]
            T = true[round(sample.time * 1000)]
            np.testing.assert_allclose(sample.position, T[:3, 3], atol=1e-12)
            w, v = sample.quaternion[0], sample.quaternion[1:]
            assert w >= 0
            assert np.cos(2 * np.arccos(w)) == pytest.approx((np.trace(T[:3, :3]) - 1) / 2)
            np.testing.assert_allclose(T[:3, :3] @ v, v, atol=1e-9)  # the axis stays


def test_noise_dropouts_missing_frames_and_flips_have_their_shares() -> None:
    settings = {"noise": 5e-5, "dropouts": 0.1, "missing": 0.2, "rate": 200.0}
    with make(tracker=settings) as rig:
        rig.clock.sleep(8)
        samples = rig.tracker.read()  # type: ignore[union-attr]
        assert len(samples) == pytest.approx(0.8 * 1600, rel=0.05)
        seen = [s.position for s in samples if s.visible]
        assert len(seen) == pytest.approx(0.9 * len(samples), rel=0.05)
        assert np.std(seen, axis=0) == pytest.approx(5e-5, rel=0.1)


def test_a_wrong_registration_moves_what_is_seen_but_not_the_arm() -> None:
    off = {"registration": {"position": (0.001, 0.0, 0.0)}}
    with make(plant={"mismatch": off}) as rig:
        rig.clock.sleep(0.1)
        sample = rig.tracker.latest  # type: ignore[union-attr]
        assert sample is not None
        np.testing.assert_allclose(sample.position, [-0.001, 0, 0.09], atol=1e-9)


# Probe -------------------------------------------------------------------------------------------


def test_the_plate_feels_the_arm_in_series_with_the_contact() -> None:
    linear = {"silicone": {"law": "linear", "creep": (), "hysteresis": ()}}
    with make(probe={"stiffness": 50.0, "clearance": 0.0005}, plant=linear) as rig:
        probe = rig.probe
        assert probe is not None
        probe.align([1, 0, 0])
        assert probe.sample().force == pytest.approx(0, abs=1e-6)
        forces = []
        for position in (0.0004, 0.0010, 0.0015):
            probe.move_to(position, 0.01)
            rig.clock.sleep(2)
            forces.append(probe.sample().force)
        E, length, inertia, area = 1e5, 0.09, 1.05 * 3.445e-8, 1.2 * 547.8e-6
        arm = 1 / (length**3 / (3 * E * inertia) + length / (E / 3 * area))  # bending and shear
        series = 1 / (1 / arm + 1 / 50.0)
        assert forces[0] == pytest.approx(0, abs=1e-4)
        assert forces[1:] == pytest.approx([series * 0.0005, series * 0.0010], rel=5e-3)
        moved = rig.world.plant.tip_pose()[0, 3]
        assert moved == pytest.approx(forces[-1] / arm, rel=5e-3)


def test_a_stage_moves_at_its_speed_and_stops() -> None:
    with make(probe={"speed": 0.02}) as rig:
        probe = rig.probe
        assert probe is not None
        probe.align([0, 1, 0])
        begin = rig.clock.now()
        probe.move_to(0.004, 0.5)  # faster than it can
        assert rig.clock.now() - begin == pytest.approx(0.2, abs=0.011)
        assert probe.sample().position == 0.004
        with pytest.raises(CommandError, match="finite"):
            probe.move_to(float("nan"), 0.01)
        with pytest.raises(CommandError, match="direction"):
            probe.align([0, 0, 0])


# Faults ------------------------------------------------------------------------------------------


def test_faults_need_leave() -> None:
    with make(plant={"faults": False}) as rig, pytest.raises(InputError, match="faults: true"):
        rig.world.inject("tracker", "off")


@pytest.mark.parametrize(
    ("device", "fault", "channel"),
    [
        ("tracker", "on fire", None),
        ("door", "off", None),
        ("supply", "off", 7),
        ("probe", "off", 0),
    ],
)
def test_unknown_faults_are_refused(device: str, fault: str, channel: int | None) -> None:
    with make() as rig, pytest.raises(InputError, match="there is no"):
        rig.world.inject(device, fault, channel)


def test_each_fault_does_what_it_says_and_goes_away() -> None:
    assert set(FAULTS) == {"supply", "tracker", "probe"}
    with make({"lag": 0.01, "slew": 1e9}) as rig:
        world, tracker = rig.world, rig.tracker
        assert tracker is not None

        def settled(pressures: Any) -> np.ndarray:
            rig.command(pressures)
            rig.clock.sleep(1)
            return rig.supply.read().pressures

        settled([5e4, 5e4, 5e4])
        world.inject("supply", "off")
        with pytest.raises(DeviceError, match="does not answer"):
            rig.supply.read()
        world.inject("supply", "ok")
        world.inject("supply", "stuck", 1)
        assert settled([1e5, 1e5, 1e5]) == pytest.approx([1e5, 5e4, 1e5])
        world.inject("supply", "ok", 1)
        assert settled([1e5, 1e5, 1e5]) == pytest.approx([1e5] * 3)
        world.inject("supply", "wrong", 2)
        assert abs(settled([1e5] * 3) - 1e5) == pytest.approx([0, 0, 1e4], abs=1)
        world.inject("supply", "ok", 2)
        world.inject("supply", "leak", 0)
        assert settled([1e5] * 3)[0] < 0.99e5
        world.inject("supply", "garbage")
        values = np.array([settled([1e5] * 3) for _ in range(4)])
        assert (np.isnan(values) | (values > 1e9)).all()
        world.inject("supply", "slow")
        before = world.pressures.copy()
        rig.vent()
        rig.clock.sleep(0.1)
        assert (world.pressures > 0.7 * before).all()
        world.inject("supply", "ok")

        def samples(fault: str) -> Any:
            world.inject("tracker", fault)
            rig.clock.sleep(0.3)
            tracker.read()
            rig.clock.sleep(1.0)
            return tracker.read()

        assert len(samples("ok")) == 40
        assert samples("off") == ()
        assert not any(s.visible for s in samples("missing"))
        assert not any(s.visible for s in samples("garbage"))
        assert samples("stuck") == ()  # a frame that was seen is not new
        good = samples("ok")[-1]
        assert np.linalg.norm(samples("wrong")[-1].position - good.position) > 0.01
        assert all(s.quaternion[0] >= 0 for s in samples("flip"))
        assert all(s.received - s.time > 0.5 for s in samples("slow"))


# Time --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dynamics", ["full", "quasi-static"])
def test_the_world_is_the_same_in_large_and_small_steps(dynamics: str) -> None:
    noisy = {"noise": 100.0, "ripple": 100.0, "resolution": 10.0}
    ends = []
    for every in (0.5, 0.05, 0.003):
        with make(noisy, {"noise": 1e-4}, plant={"dynamics": dynamics, "seed": 5}) as rig:
            probe = rig.probe
            assert probe is not None
            rig.command([4e4, 1e5, 0])
            rig.clock.sleep_until(0.3)
            probe.align([1, 0, 0])
            rig.world.stage.move(0.004, 0.01)
            while rig.clock.now() < 1.0:
                rig.clock.sleep_until(min(1.0, rig.clock.now() + every))
            ends.append((rig.world.plant.tip_pose(), rig.tracker.latest, rig.world.stage.force()))  # type: ignore[union-attr]
    for tip, sample, force in ends[1:]:
        np.testing.assert_allclose(tip, ends[0][0], atol=1e-9)
        np.testing.assert_allclose(sample.position, ends[0][1].position, atol=1e-9)
        assert force == pytest.approx(ends[0][2], abs=1e-5)


def test_seeds_decide() -> None:
    def tip(seed: int) -> np.ndarray:
        with make({"ripple": 500.0}, plant={"seed": seed, "spread": {}}) as rig:
            rig.command([1e5, 0, 0])
            rig.clock.sleep(0.5)
            return np.asarray(rig.world.plant.tip_pose()[:3, 3])

    assert (tip(3) == tip(3)).all()
    assert np.linalg.norm(tip(3) - tip(4)) > 1e-4


def test_real_time_passes_by_itself() -> None:
    description = RigDescription(robot="stiff-flop-1", supply={"driver": "simulated"})
    rig = simulated_rig(description, ROBOT, limits_of(description, ROBOT), real_time=True)
    with rig:
        rig.supply.arm()
        rig.command([5e4, 0, 0])
        begin = rig.clock.now()
        rig.clock.sleep(0.3)
        assert rig.clock.now() - begin >= 0.3
        assert rig.supply.read().pressures[0] > 2e4
        assert rig.world.time <= rig.clock.now() + 0.01


def test_a_clock_that_was_held_up_does_not_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    description = RigDescription(
        robot="stiff-flop-1", supply={"driver": "simulated"}, tracker={"driver": "simulated"}
    )
    rig = simulated_rig(description, ROBOT, limits_of(description, ROBOT), real_time=True)
    with rig:
        rig.supply.arm()
        rig.world.epoch -= 100.0  # the machine slept
        before = rig.clock.now()
        monkeypatch.setattr("stiffopt.plant.world._LONGEST", 0.2)
        poses = rig.observe().poses
        assert rig.clock.now() >= before
        assert rig.world.time == pytest.approx(rig.clock.now(), abs=0.5)
        rig.command(PressureCommand(np.array([1e4, 0, 0]), rig.clock.now()))
        assert len(poses) < 20  # nobody saw the arm in the time that was skipped
        assert all(pose.time > before - 0.5 for pose in poses)


def test_an_arm_that_cannot_be_followed_is_vented_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def lost(pressures: np.ndarray) -> None:
        raise SimulationError("the simulated arm cannot be followed beyond 1 s")

    rig = make()
    rig.open()
    rig.command([1e5, 0, 0])
    monkeypatch.setattr(rig.world.plant, "follow", lost)
    with pytest.raises(DeviceError, match="beyond"):
        rig.clock.sleep(1)
    rig.close()
    assert not rig.world.set_point.any()


@pytest.mark.parametrize("leak", [0.002, 0.05])
def test_a_fast_leak_only_empties(leak: float) -> None:
    coarse = {"discretisation": {"step": 0.02}}
    with make({"leak": leak}, {"rate": 40.0}, plant=coarse) as rig:
        rig.command([1e4, 1e4, 1e4])
        p = readings(rig, 1.0, 0.02)
        assert (p >= 0).all()
        assert p.max() <= 1e4


def test_the_force_does_not_jump_when_the_stage_stops() -> None:
    with make(probe={"stiffness": 2000.0, "clearance": 0.0}) as rig:
        probe = rig.probe
        assert probe is not None
        probe.align([1, 0, 0])
        probe.move_to(0.003, 0.02)
        rig.world.stage.move(0.0050001, 0.02)
        forces = []
        while rig.world.stage.speed:
            rig.clock.sleep(0.001)
            forces.append(probe.sample().force)
        for _ in range(5):
            rig.clock.sleep(0.001)
            forces.append(probe.sample().force)
        assert rig.world.stage.position == 0.0050001
        assert np.abs(np.diff(forces, 2)).max() < 0.05 * max(forces)  # no kink but the stop itself


def test_frames_never_overtake_each_other() -> None:
    with make() as rig:
        tracker = rig.tracker
        assert tracker is not None
        seen: list[Any] = []
        for fault in ("ok", "slow", "ok"):
            rig.world.inject("tracker", fault)
            for _ in range(20):
                rig.clock.sleep(0.05)
                seen += tracker.read()
        received = [sample.received for sample in seen]
        assert received == sorted(received)
        assert [sample.frame for sample in seen] == sorted(sample.frame for sample in seen)


# Loads somewhere on the arm --------------------------------------------------------------------


def with_connectors() -> Any:
    (segment,) = ROBOT.segments
    link = segment.model_copy(update={"connector": 0.02})
    return ROBOT.model_copy(update={"segments": (link, link)})


def bent(load: PlantLoad | None, plant: dict[str, Any] | None = None) -> np.ndarray:
    silicone = {"law": "linear", "creep": (), "hysteresis": ()}
    arm = Plant(with_connectors(), PlantSettings(silicone=silicone, **(plant or {})))
    arm.settle(np.zeros(6), load)
    return np.asarray(arm.tip_pose())


def test_a_load_at_the_full_length_is_at_the_tip() -> None:
    for frame in ("base", "tip"):
        force = PlantLoad(force=(0.05, 0.02, 0.0), moment=(0.0, 0.001, 0.0005), frame=frame)
        there = force.model_copy(update={"at": 0.22})
        np.testing.assert_allclose(bent(there), bent(force), atol=1e-9)


def test_a_connector_is_a_lever() -> None:
    """A force on a connector is the force at its beginning and a moment."""
    for far in (0.095, 0.105, 0.11):
        lever = far - 0.09
        force = PlantLoad(force=(0.1, 0.0, 0.0), frame="tip", at=far)
        same = PlantLoad(
            force=(0.1, 0.0, 0.0), moment=(0.0, 0.1 * lever, 0.0), frame="tip", at=0.09
        )
        np.testing.assert_allclose(bent(force), bent(same), atol=1e-9)
    a, b = (bent(PlantLoad(force=(0.1, 0, 0), at=at))[0, 3] for at in (0.09, 0.11))
    assert b > a * 1.1


def test_a_load_off_the_arm_is_refused() -> None:
    with pytest.raises(InputError, match="220 mm long"):
        bent(PlantLoad(force=(0.1, 0, 0), at=0.23))
    with pytest.raises(InputError, match="at least 0"):
        PlantLoad(force=(0.1, 0, 0), at=-0.01)


def test_a_load_finds_its_place_on_an_arm_that_is_shorter_than_its_file() -> None:
    short = {"mismatch": {"length": (0.9, 0.9)}}
    tip, there = PlantLoad(force=(0.05, 0, 0)), PlantLoad(force=(0.05, 0, 0), at=0.22)
    np.testing.assert_allclose(bent(there, short), bent(tip, short), atol=1e-9)


@pytest.mark.parametrize("degrees", [(3, 2), (8, 2), (8, 8), (0, 0), (2, 5)])
def test_the_fewest_sub_intervals_that_are_taken_work(degrees: tuple[int, int]) -> None:
    given = {"bending_degree": degrees[0], "shear_degree": degrees[1]}
    for m in range(2, 12):
        try:
            grid = Discretisation(sub_intervals=m, **given)
        except InputError:
            continue
        frequencies, _ = Plant(ROBOT, PlantSettings(discretisation=grid)).modes(2)
        assert frequencies[0] > 1
        return
    pytest.fail("none was taken")
