"""Commissioning: faults of a set-up are found and named, usual arms fit, and danger stops it.

Most tests take what the tip does from the simulated arm at rest, without regulators and time: the
explanation is what is tested. Some go through the rig, from the command line to the record.
"""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from simulated_loop import Lab
from stiffopt import lie
from stiffopt.cli import commission_run
from stiffopt.cli.main import main
from stiffopt.commissioning import procedure, settings
from stiffopt.commissioning.correction import corrections, write_corrected
from stiffopt.commissioning.expected import ExpectedSteps, expected_steps, rotation_vectors
from stiffopt.commissioning.explanation import Explainer, SetupExplanation
from stiffopt.commissioning.findings import Finding, findings_of
from stiffopt.commissioning.record import (
    CommissioningRecord,
    RecordedFinding,
    commissioned_control,
    commissioned_robot,
    fingerprints,
    load_record,
    save_record,
)
from stiffopt.commissioning.responses import Responses
from stiffopt.commissioning.timing import Delays, Swing, fit_swing
from stiffopt.control.state import State
from stiffopt.documents import read_document
from stiffopt.errors import InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.robot_files import load_description
from stiffopt.plant.plant import Plant
from stiffopt.plant.settings import Mismatch, PlantLoad, PlantSettings
from stiffopt.registration import Placement, Registration
from stiffopt.rig.config import RigDescription, load_rig_description
from stiffopt.rig.interface import PressureLimits, Rig
from stiffopt.rig.settings import ControlSettings
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


# -- what is explained -----------------------------------------------------------------------------


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


# -- on the rig ------------------------------------------------------------------------------------

PROCEDURE = replace(
    settings.PROCEDURE, rest=1.0, first_hold=0.3, up=1.3, down=1.0, long=9.5, long_down=1.0
)


@pytest.fixture(autouse=True)
def short_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedure, "PROCEDURE", PROCEDURE)


RIG = """\
format: stiffopt-rig/1
name: short
robot: stiff-flop-1
rate: 50 Hz
supply: {{driver: simulated}}
tracker: {{driver: simulated, noise: 0.03 mm}}
log: {{folder: {folder}}}
plant:
  dynamics: quasi-static
  faults: true
  discretisation: {{bending_degree: 1, shear_degree: 0, sub_intervals: 3, step: 10 ms}}
{more}"""


def rig_file(folder: Path, more: str = "") -> Path:
    path = folder / "rig.yaml"
    path.write_text(RIG.format(folder=folder / "runs", more=more), encoding="utf-8")
    return path


def commissioned(path: Path, *options: str) -> int:
    return main(["commission", str(path), "--quick", "-q", *options])


@pytest.fixture
def touched(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Change the rig of the next command by a function."""

    def by(change: Any) -> None:
        plain = commission_run.rig_of

        def changed(path: str) -> Any:
            rig, *rest = plain(path)
            change(rig)
            return (rig, *rest)

        monkeypatch.setattr(commission_run, "rig_of", changed)

    return by


def swapped(rig: Any) -> None:
    """Exchange the tubes of channels 1 and 2; the gauges are those of the regulators."""
    world = rig.tracker._world
    command, measured = world.command, world.measured
    world.command = lambda p: command(np.asarray(p)[[1, 0, 2]])
    world.measured = lambda: measured()[[1, 0, 2]]


def test_a_rig_that_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path)
    assert commissioned(path, "--json", "--folder", str(tmp_path / "first")) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["fits"]
    assert told["findings"] == []
    assert told["channels"][0]["lag_up_s"] == pytest.approx(0.06, abs=0.01)
    assert told["channels"][0]["displacement_m"][0] == pytest.approx(-3.2e-3, rel=0.1)
    assert told["tracker"]["tip_delay_s"] == pytest.approx(0.01, abs=0.02)
    assert told["tracker"]["noise_m"] == pytest.approx(3e-5, rel=0.2)
    files = {each.name for each in (tmp_path / "first").iterdir()}
    assert files >= {"record.yaml", "report.md", "commissioning.csv", "commissioning.png"}
    assert main(["check", str(tmp_path / "rig.commissioning.yaml"), "-q"]) == 0
    record = load_record(tmp_path / "rig.commissioning.yaml")
    assert record.fits
    assert record.age() < 600
    description = load_rig_description(path)
    robot = load_description("stiff-flop-1")
    assert (record.rig_hash, record.robot_hash) == fingerprints(robot, description)


def test_a_full_one_sees_slow_leaks(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    assert main(["commission", str(path), "--no-plot", "-q"]) == 0
    record = load_record(tmp_path / "rig.commissioning.yaml")
    assert not record.quick
    drifts = [channel.drift for channel in record.channels]
    assert all(drift is not None and -0.2 < drift < 0.02 for drift in drifts)  # it creeps on


def test_a_swap_on_the_rig(
    tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rig_file(tmp_path)
    touched(swapped)
    assert main(["commission", str(path), "--quick", "--no-plot"]) == 6
    told = capsys.readouterr().out
    assert "channels 1 and 2 seem swapped" in told
    assert "does NOT fit" in told
    assert not load_record(tmp_path / "rig.commissioning.yaml").fits


def test_set_points_that_are_swapped_are_no_leak(
    tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each gauge reads its own chamber, which has shown the other channel's step."""

    def crossed(rig: Any) -> None:
        command = rig.tracker._world.command
        rig.tracker._world.command = lambda p: command(np.asarray(p)[[1, 0, 2]])

    touched(crossed)
    path = rig_file(tmp_path)
    assert main(["commission", str(path), "--no-plot"]) == 6
    told = capsys.readouterr().out
    assert "channels 1 and 2 seem swapped" in told
    assert "the gauge of channel 2 follows the command of channel 1" in told


def test_the_corrected_rig_file_fits(
    tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """The whole first day: a turned frame is found, corrected, and then nothing is wrong."""
    more = (
        "  mismatch: {registration: {orientation: [0.996194698, 0, 0, 0.087155743]}}\n"
        "control: {tracker_noise: 0.01 mm}\n"
    )
    path, better = rig_file(tmp_path, more), tmp_path / "better.yaml"
    assert commissioned(path, "--no-plot", "--out", str(better)) == 6
    assert "tracker.registration.tracker_in_base, control.tracker_noise" in better.read_text()
    # a simulated sensor is placed by the file, and would move with it
    there = load_rig_description(path).tracker
    touched(lambda rig: setattr(rig.tracker._world.camera, "settings", there))
    folder = str(tmp_path / "again")
    code = main(["commission", str(better), "--quick", "--no-plot", "--folder", folder])
    assert code == 0, capsys.readouterr().out


def test_danger_ends_it(tmp_path: Path, touched: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """An arm that moves much farther than any model of it, and one whose tracker jumps."""
    path = rig_file(tmp_path, "  mismatch: {gain: [5, 5, 5]}\n")
    assert commissioned(path, "--no-plot") == 5
    told = capsys.readouterr().err
    assert "the tip has moved by" in told
    assert "the arm is vented" in told
    (finding,) = load_record(tmp_path / "rig.commissioning.yaml").findings
    assert "was stopped: the tip has moved" in finding.text

    def jumping(rig: Any) -> None:
        capture, camera = rig.tracker._world.camera.capture, rig.tracker._world.camera
        camera.capture = lambda fault: capture("wrong" if camera.count > 100 else fault)

    path = rig_file(tmp_path)
    touched(jumping)
    assert commissioned(path, "--no-plot", "--folder", str(tmp_path / "second")) == 5
    assert "jumped by" in capsys.readouterr().err


def test_a_shaken_arm_is_not_moved(tmp_path: Path, touched: Any) -> None:
    touched(lambda rig: rig.tracker._world.inject("tracker", "shaking"))
    assert commissioned(rig_file(tmp_path), "--no-plot") == 5
    finding = load_record(tmp_path / "rig.commissioning.yaml").findings[0]
    assert "though the arm is vented" in finding.text


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path)
    assert commissioned(path, "--out", str(path)) == 2
    (tmp_path / "elsewhere").mkdir()
    assert commissioned(path, "--out", str(tmp_path / "elsewhere" / "better.yaml")) == 2
    assert "expected a place beside" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()  # nothing has moved
    nowhere = f"commissioning: {{record: {tmp_path / 'nowhere' / 'record.yaml'}}}\n"
    path.write_text(path.read_text() + nowhere, encoding="utf-8")
    assert commissioned(path) == 2
    assert "the record cannot be written" in capsys.readouterr().err
    path = rig_file(tmp_path)
    (tmp_path / "experiment.yaml").touch()  # 'stiffopt commission' cannot continue one
    assert commissioned(path, "--folder", str(tmp_path)) == 2
    assert "is not empty" in capsys.readouterr().err
    path.write_text(path.read_text().replace("tracker:", "# tracker:"), encoding="utf-8")
    assert commissioned(path) == 2
    assert "no tracker" in capsys.readouterr().err
    bad = tmp_path / "bad.yaml"
    bad.write_text("format: stiffopt-commissioning/1\ndate: today\n", encoding="utf-8")
    assert main(["check", str(bad)]) == 2
    assert "time zone" in capsys.readouterr().out


# -- the corrected file ----------------------------------------------------------------------------


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


# -- arming ----------------------------------------------------------------------------------------


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
