"""Commissioning explains what it sees: faults of a set-up are named and corrected, usual arms fit.

What the tip does is taken from the simulated arm at rest, without regulators and time.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stiffopt import lie
from stiffopt.commissioning.correction import corrections, write_corrected
from stiffopt.commissioning.expected import ExpectedSteps, expected_steps, rotation_vectors
from stiffopt.commissioning.explanation import Explainer, SetupExplanation
from stiffopt.commissioning.findings import Finding, findings_of
from stiffopt.commissioning.responses import Responses
from stiffopt.commissioning.timing import Delays, Swing, fit_swing
from stiffopt.documents import read_document
from stiffopt.model.robot_files import load_description
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import Mismatch, PlantLoad, PlantSettings
from stiffopt.registration import Placement, Registration
from stiffopt.rig.config import RigDescription
from stiffopt.rig.interface import PressureLimits, Rig
from stiffopt.safety.rigs import rig_for_programs

Array = NDArray[np.float64]
COARSE = {"bending_degree": 2, "shear_degree": 1, "sub_intervals": 4}
NOISE, ANGULAR_NOISE, SAMPLES = 5e-5, 1e-3, 80
HANGING, SHORT = "stiff-flop-2-hanging", "stiff-flop-1"


def turned(axis: str, degrees: float) -> Placement:
    twist = np.zeros(6)
    twist[3 + "xyz".index(axis)] = np.radians(degrees)
    return Placement.of(np.asarray(lie.exp(twist)))


@cache
def expected_of(robot: str) -> ExpectedSteps:
    description = load_description(robot)
    low, high = np.array(description.pressure_min), np.array(description.pressure_max)
    return expected_steps(description, PressureLimits(low, high))


@cache
def rig_of(robot: str) -> Rig:
    """A rig for its settings: nothing of it is opened."""
    blocks: dict[str, Any] = {"supply": {"driver": "simulated"}, "tracker": {"driver": "simulated"}}
    description = RigDescription(robot=robot, plant={"dynamics": "quasi-static"}, **blocks)
    return rig_for_programs(description, load_description(robot))


def seen_by(
    robot: str = HANGING,
    *,
    mismatch: Mismatch | None = None,
    sensor: Placement | None = None,
    wiring: dict[int, tuple[int, ...]] | None = None,
    load: PlantLoad | None = None,
    turns: bool = True,
    seed: int = 0,
) -> Responses:
    """What is seen of a simulated arm after each step, with the noise of a tracker.

    `sensor` is where the sensor is in what the rig file takes for the tip; `wiring` says for lines
    which chambers they fill.
    """
    e, mismatch = expected_of(robot), mismatch or Mismatch()
    rng = np.random.default_rng([seed, 20])
    plant = Plant(e.description, PlantSettings(mismatch=mismatch, discretisation=COARSE, load=load))
    to_seen = mismatch.registration.inverse()
    on_tip = (sensor or Placement()).transform()

    def pose(source: tuple[int, ...]) -> Array:
        plant.settle(np.array([e.size * (k in source) for k in range(e.n)]))
        T = to_seen @ plant.tip_pose() @ on_tip
        scale = np.repeat([NOISE, ANGULAR_NOISE], 3) / np.sqrt(SAMPLES)
        return np.asarray(T @ lie.exp(scale * rng.standard_normal(6)))

    rest = pose(())
    poses = np.array([pose((wiring or {}).get(k, (k,))) for k in range(e.n)])
    n, spread = e.n, np.sqrt(2 / SAMPLES)
    unknown = np.full(n, np.nan)
    return Responses(
        rest_position=rest[:3, 3],
        rest_rotation=rest[:3, :3] if turns else None,
        rest_noise=NOISE / np.sqrt(SAMPLES),
        shift=poses[:, :3, 3] - rest[:3, 3],
        turn=rotation_vectors(poses[:, :3, :3] @ rest[:3, :3].T) if turns else None,
        shift_noise=np.full(n, NOISE * spread),
        turn_noise=np.full(n, ANGULAR_NOISE * spread),
        drift=unknown,
        noise=NOISE,
        angular_noise=ANGULAR_NOISE,
        rate=40.0,
        latency=0.025,
        missing=0.0,
        gauge_offset=np.zeros(n),
        gauge_noise=np.full(n, 150.0),
        gauge=np.eye(n),
        gauge_deviation=2e-3,
        size=e.size,
        delays=Delays(*np.broadcast_to([[0.01], [0.06], [0.06], [5e5], [5e5]], (5, n))),
        tip_delay=0.01,
        swing=None,
    )


@cache
def as_modelled() -> Responses:
    """What is seen of the arm of the robot file; nobody changes it."""
    return seen_by()


def explained(seen: Responses, robot: str = HANGING) -> tuple[SetupExplanation, list[Finding]]:
    explainer = Explainer(expected_of(robot), seen)
    best = explainer.best()
    return best, findings_of(rig_of(robot), expected_of(robot), seen, explainer, best)


def only_wrong(findings: list[Finding]) -> Finding:
    (wrong,) = [finding for finding in findings if not finding.fits]
    return wrong


def usual_arm(seed: int, **other: Any) -> Mismatch:
    """An arm as the benchmark of control draws them; it is not at fault."""
    rng = np.random.default_rng([seed, 77])
    axes = rng.standard_normal((2, 3))
    shift, turn = axes / np.linalg.norm(axes, axis=1)[:, None] * [[2e-3], [np.radians(2.0)]]
    base = np.asarray(lie.exp(np.concatenate([np.zeros(3), turn])))
    base[:3, 3] = shift
    return Mismatch(
        gain=tuple(1 + rng.uniform(-0.05, 0.05, 6)),
        modulus=tuple(1 + rng.uniform(-0.2, 0.2, 2)),
        base=Placement.of(base),
        **other,
    )


# -- what is explained ----------------------------------------------------------------------------


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(6))
def test_usual_arms_fit(seed: int) -> None:
    best, findings = explained(seen_by(mismatch=usual_arm(seed), seed=seed))
    assert [finding.text for finding in findings if not finding.fits] == []
    assert best.wiring == tuple((k,) for k in range(6))


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"wiring": {0: (1,), 1: (0,)}}, "channels 1 and 2 seem swapped"),
        pytest.param(
            {"wiring": {0: (3,), 3: (0,)}},
            "channels 1 and 4 seem swapped",
            marks=pytest.mark.long,
        ),
        ({"wiring": {0: (1,), 1: (2,), 2: (0,)}}, "1 drives what 2 should, 2 drives what 3"),
        ({"wiring": {2: ()}}, "channel 3 did not move the tip"),
        ({"wiring": {0: (0, 1), 1: (0, 1)}}, "they share a line"),
        ({"sensor": Placement(position=(0, 0, 0.01))}, "mm further along the arm"),
        ({"sensor": turned("y", 12.0)}, "the sensor is turned on the tip by 1"),
        ({"registration": turned("z", 10.0)}, "the tracker's frame is turned by"),
        pytest.param(
            {"registration": turned("x", 5.0)},
            "the tracker's frame is turned by",
            marks=pytest.mark.long,
        ),
        ({"modulus": (1.9, 1.9)}, "a gain of all its channels that does the same"),
    ],
)
def test_faults_of_the_set_up_are_found(fault: dict[str, Any], text: str) -> None:
    seed = 21
    arm = usual_arm(seed).model_copy(
        update={key: value for key, value in fault.items() if key in Mismatch.model_fields}
    )
    rest = {key: value for key, value in fault.items() if key not in Mismatch.model_fields}
    _, findings = explained(seen_by(mismatch=arm, seed=seed, **rest))
    assert text in only_wrong(findings).text


def test_numbers_are_right() -> None:
    seen = seen_by(mismatch=Mismatch(registration=turned("z", 9.6)))
    _, findings = explained(seen)
    assert only_wrong(findings).text.startswith("the tracker's frame is turned by 9.")
    assert only_wrong(findings).text.endswith("deg about z")
    best, _ = explained(seen_by(sensor=Placement(position=(0, 0, 0.01))))
    assert best.values[8] == pytest.approx(0.01, abs=1.5e-3)


def test_a_frame_that_is_far_off_is_found_with_its_place() -> None:
    """A tracker turned about its own origin, which is away from the base, moves the base too."""
    place = np.asarray(lie.exp(np.array([0.05, -0.08, 0.1, 0.3, 0.9, -1.2])))
    seen = seen_by(mismatch=Mismatch(registration=Placement.of(place)))
    best, findings = explained(seen)
    assert only_wrong(findings).cause == "frame"
    found = rotation_vectors(np.array([place[:3, :3]]))[0]
    np.testing.assert_allclose(-best.values[:3], found, atol=0.02)


def test_positions_alone_do_not_tell_an_order_from_a_turn() -> None:
    """Three like channels in a circle: in another order they are the arm turned by 120 degrees."""
    cycle = {0: (1,), 1: (2,), 2: (0,)}
    seen = seen_by(SHORT, wiring=cycle, turns=False)
    _, findings = explained(seen, SHORT)
    text = only_wrong(findings).text
    assert "another order" in text
    assert "turned by" in text
    assert "not distinguish these" in text
    assert "by hand" in only_wrong(findings).advice
    _, findings = explained(seen_by(SHORT, wiring=cycle), SHORT)
    assert "turned by" not in only_wrong(findings).text
    _, findings = explained(seen_by(SHORT, wiring={0: (1,), 1: (0,)}, turns=False), SHORT)
    assert only_wrong(findings).text == "channels 1 and 2 seem swapped"  # no turn mirrors an arm


def test_steps_tell_a_slipped_sensor_from_a_push() -> None:
    """At rest they look alike to a tracker of positions; a step swings a sensor that is aside."""
    _, findings = explained(seen_by(sensor=Placement(position=(0.007, 0, 0)), turns=False))
    assert only_wrong(findings).cause == "sensor moved"
    push = PlantLoad(force=(0.1, 0.0, 0.0))
    _, findings = explained(seen_by(load=push, turns=False))
    text = only_wrong(findings).text
    assert "the tracker's frame is turned" in text
    assert "or a load of" in text
    assert "or a base tilted by" in text
    assert "sensor" not in text
    assert "spirit level" in only_wrong(findings).advice


def test_nothing_moves() -> None:
    _, findings = explained(seen_by(wiring=dict.fromkeys(range(6), ())))
    assert findings[0].text == "no channel moves the tip"


def with_changes(**changes: Any) -> list[Finding]:
    return explained(replace(as_modelled(), **changes))[1]


def test_gauges_noise_lag_and_swings_are_judged() -> None:
    off = np.eye(6)
    off[2, 2] = 0.9
    assert "channel 3 rises by 90 %" in only_wrong(with_changes(gauge=off)).text
    off[2, 2] = 0.0
    assert "it is dead" in only_wrong(with_changes(gauge=off)).text
    crossed = np.eye(6)[[1, 0, 2, 3, 4, 5]]
    wrong = [finding.text for finding in with_changes(gauge=crossed) if not finding.fits]
    assert wrong[0] == "the gauge of channel 2 follows the command of channel 1"
    dead = {"gauge_offset": np.full(6, np.nan), "gauge": np.full((6, 6), np.nan)}
    assert "read nothing" in only_wrong(with_changes(**dead)).text
    noisy = only_wrong(with_changes(noise=1.5e-4))
    assert noisy.keys == ("control.tracker_noise",)
    assert "400 ms old" in only_wrong(with_changes(latency=0.4)).text
    assert "poses are older than it says" in only_wrong(with_changes(tip_delay=0.12)).text
    slow = Delays(*np.broadcast_to([[0.05], [0.4], [0.4], [5e5], [5e5]], (5, 6)))
    assert "follows after 0.45 s" in only_wrong(with_changes(delays=slow)).text
    swing = Swing(1.7, 0.05, 2e-3, 0.01, 0.001)
    e, seen = expected_of(HANGING), replace(as_modelled(), swing=swing)
    explainer = Explainer(e, seen)
    for modelled, count in ((1.6, 0), (0.9, 1)):
        found = findings_of(rig_of(HANGING), e, seen, explainer, explainer.best(), modelled)
        assert len([each for each in found if not each.fits]) == count
    drift = np.array([np.nan, 0.2, 0.01, np.nan, np.nan, np.nan])
    assert "came back by 20 %" in only_wrong(with_changes(drift=drift)).text


def test_a_swing_is_fitted() -> None:
    time = np.arange(0.35, 3.0, 0.025)
    rng = np.random.default_rng(1)
    omega, damping = 2 * np.pi * 1.7, 0.04
    swing = np.exp(-damping * omega * time) * np.cos(omega * np.sqrt(1 - damping**2) * time)
    windows = [
        (time, np.outer(1 + 2e-3 * swing, way) + 2e-5 * rng.standard_normal((len(time), 3)))
        for way in np.eye(3)
    ]
    found = fit_swing(windows, 2e-5)
    assert found is not None
    assert found.frequency == pytest.approx(1.7, rel=0.01)
    assert found.damping == pytest.approx(0.04, abs=0.005)
    still = [(time, 2e-5 * rng.standard_normal((len(time), 3))) for _ in range(4)]
    assert fit_swing(still, 2e-5) is None


# -- the corrected file ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gauges", "addresses"),
    [
        # tubes, or whole channels, are exchanged: a set-point goes with its reading
        (np.eye(3), [(0x0801, 1), (0x0800, 0), (0x0802, 2)]),
        # only outputs are: the readings say so, and stay
        (np.eye(3)[[1, 0, 2]], [(0x0801, 0), (0x0800, 1), (0x0802, 2)]),
    ],
)
def test_swapped_channels_of_a_register_map(
    gauges: Array, addresses: list[tuple[int, int]], tmp_path: Path
) -> None:
    source = Path(__file__).parent.parent / "rig" / "modbus-aurora.yaml"
    path = tmp_path / "rig.yaml"
    path.write_text(source.read_text(encoding="utf-8"), encoding="utf-8")
    seen = replace(seen_by(SHORT, wiring={0: (1,), 1: (0,)}), gauge=gauges)
    best, findings = explained(seen, SHORT)
    data, changed = corrections(rig_of(SHORT), str(path), best, seen, findings)
    assert changed == ["supply.channels"]
    write_corrected(tmp_path / "better.yaml", str(path), data, changed)
    channels = read_document(tmp_path / "better.yaml").data["supply"]["channels"]
    assert [(each["setpoint"], each["reading"]) for each in channels] == addresses


def test_a_registration_is_corrected() -> None:
    """Whatever the registration was: with the corrected one the tip is where it is."""
    given = Registration(tracker_in_base=turned("y", 80.0), tip_in_sensor=turned("x", 30.0))
    rig = rig_of(HANGING)
    description = rig.settings.model_copy(
        update={"tracker": rig.settings.tracker.model_copy(update={"registration": given})}
    )
    assert rig.tracker is not None
    before = rig.settings, rig.tracker.registration
    try:
        rig.settings, rig.tracker.registration = description, given
        off = Mismatch(registration=turned("z", 10.0))
        best, findings = explained(seen_by(mismatch=off))
        path = Path(__file__).parent.parent / "rig" / "sim-two-segment.yaml"
        data, changed = corrections(rig, str(path), best, as_modelled(), findings)
    finally:
        rig.settings, rig.tracker.registration = before
    assert changed == ["tracker.registration.tracker_in_base"]
    block = data["tracker"]["registration"]["tracker_in_base"]
    found = Placement(position=tuple(block["position"]), orientation=tuple(block["orientation"]))
    wanted = turned("z", 10.0).transform() @ turned("y", 80.0).transform()
    np.testing.assert_allclose(found.transform()[:3, :3], wanted[:3, :3], atol=0.02)
