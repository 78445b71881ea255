"""`stiffopt experiment`: from the rig file to table and figure, and all that may go wrong."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import stiffopt
from experiment_runs import (
    first_row_alone,  # noqa: F401
    golden,
    model,
    quick,
    short,
    stall,
)
from fake_rig import FakeSupply, fake_rig, world_of
from stiffopt.cli import experiment_run
from stiffopt.cli.main import main
from stiffopt.cli.quantities import directions, pressures
from stiffopt.errors import DeviceError, FileError, InputError
from stiffopt.experiments import (
    KinematicsSettings,
    StiffnessSettings,
    evaluate_coverage,
    evaluate_kinematics,
    evaluate_stiffness,
    run_kinematics,
    run_stiffness,
)
from stiffopt.experiments.folder import alone_in, create_folder
from stiffopt.experiments.kinematics_result import read_recordings, read_rounds
from stiffopt.logs import read_log, read_stiffness_table
from stiffopt.rig.config import load_rig_description
from stiffopt.rig.interface import Rig
from stiffopt.safety.rigs import rig_for_programs

pytestmark = pytest.mark.usefixtures("first_row_alone")


SIM = Path(__file__).resolve().parent.parent / "rig" / "sim.yaml"


@pytest.mark.long
def test_on_the_simulated_rig(tmp_path: Path) -> None:
    """Another arm than the model's, with inertia, creep, hysteresis and noise: but not far off."""
    pytest.importorskip("numba")
    from stiffopt.safety.rigs import open_rig

    path = Path(__file__).resolve().parent.parent / "rig" / "sim.yaml"
    kinematics = KinematicsSettings(channels=3, repetitions=2, poses=6)
    stiffness = StiffnessSettings(channels=3, repetitions=2, pressures=(0.0, 0.75e5))
    for name in "ks":
        (tmp_path / name).mkdir()
    with open_rig(path) as rig:
        run_kinematics(rig, tmp_path / "k", kinematics, rate=100.0)
    with open_rig(path) as rig:
        run_stiffness(rig, tmp_path / "s", stiffness, model(), rate=100.0)
    result = evaluate_kinematics(read_recordings(tmp_path / "k", kinematics), model())
    assert result.mean < 0.005
    assert result.repeatability < 0.001
    combined = evaluate_coverage(read_rounds(tmp_path / "k", 1), model())
    assert combined is not None
    assert len(combined.errors) == 6
    assert combined.worst < 0.015  # higher pressures, and it creeps
    for cell in evaluate_stiffness(tmp_path / "s", stiffness, model()).cells:
        assert cell.estimate is not None
        assert cell.estimate.value == pytest.approx(cell.model, rel=0.3)


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Rig], Rig]:
    """Let the command find this rig behind any file."""
    monkeypatch.chdir(tmp_path)

    def put(rig: Rig) -> Rig:
        monkeypatch.setattr(experiment_run, "rig_of", lambda path: (rig, "a rig", 50.0, "runs"))
        return rig

    return put


KINEMATICS = ["experiment", "kinematics", "rig.yaml", "--pressures", "0.5 bar", "--period", "1 s",
              "--repetitions", "2", "--poses", "2"]  # fmt: skip


STIFFNESS = ["experiment", "stiffness", "rig.yaml", "--pressures", "0:1:1 bar", "--directions",
             "x,-z", "--repetitions", "1", "--steps", "3"]  # fmt: skip


def test_kinematics_from_the_rig_to_the_figure(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig(slew=3e5))
    assert main(KINEMATICS) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("kinematics_a-rig_20")
    assert {path.name for path in folder.iterdir()} == {
        "experiment.yaml", "figure.png", "poses.png", "report.md", "kinematics_1.csv",
        "kinematics_1.mcap", "kinematics_2.csv", "kinematics_2.mcap", "kinematics_poses_1.csv",
        "kinematics_poses_1.mcap",
    }  # fmt: skip
    for name in ("figure.png", "poses.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr()
    assert "95th percentile" in said.out
    report = (folder / "report.md").read_text()
    assert "| tip error | mm | % of length | combined: mm | % of length |" in report
    assert "combined poses: 2 of 2, all channels, 0 to 1.5 bar" in report
    assert not said.err
    assert not world_of(rig).commanded.any()
    # complete: nothing moves, the report is made again
    rig = use(fake_rig())
    assert main(["experiment", "kinematics", "rig.yaml", "--resume", str(folder)]) == 0
    assert "nothing was left to do" in capsys.readouterr().err
    assert not world_of(rig).writes


def test_kinematics_as_json(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, shift = model(), np.array([0.0, 0.0, 0.003])
    use(fake_rig(lambda p: arm.tip_pose(p)[:3, 3] + shift, slew=3e5))
    assert main([*KINEMATICS, "--json", "--no-plot", "--out", "run", "--max", "1.2 bar"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    found = json.loads(line)
    assert (found["model"], found["length_m"], found["folder"]) == ("stiff-flop-1", 0.09, "run")
    assert found["repetitions"] == 2
    assert found["mean_error_m"] == pytest.approx(0.003, rel=0.03)
    combined = found["combined"]
    assert combined["poses"] == 2
    for key in ("mean_error_m", "p95_error_m", "max_error_m", "errors_m"):
        assert combined[key] == pytest.approx([0.003] * 2 if key == "errors_m" else 0.003, rel=1e-3)
    assert np.max(combined["pressures_pa"], axis=0) == pytest.approx(1.2e5, abs=20)
    (tmp_path / "run" / "kinematics_poses_1.csv").write_text(
        "time_s,p1_pa,p2_pa,p3_pa,tip_x_m,tip_y_m,tip_z_m\n"
        + "".join(f"{0.1 * k:.1f},{k < 20},0,0,,,\n".replace("True", "1e5").replace("False", "0")
                  for k in range(30))
    )  # fmt: skip
    resume = ["experiment", "kinematics", "rig.yaml", "--resume", "run", "--no-plot"]
    assert main([*resume, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["combined"] is None
    assert main(resume) == 0
    assert "no combined pose was held with the tip in sight" in " ".join(
        capsys.readouterr().out.split()
    )


def test_a_folder_from_before_there_were_combined_poses_is_complete(
    use: Callable[[Rig], Rig], tmp_path: Path
) -> None:
    use(fake_rig(slew=3e5))
    assert main([*KINEMATICS, "--poses", "0", "--no-plot", "-q", "--out", "run"]) == 0
    path = tmp_path / "run" / "experiment.yaml"
    lines = path.read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("poses", "settle"))]
    assert len(kept) == len(lines) - 2
    path.write_text("\n".join(kept) + "\n")
    rig = use(fake_rig())
    command = ["experiment", "kinematics", "rig.yaml", "--resume", "run", "--no-plot", "-q"]
    assert main(command) == 0
    assert not world_of(rig).writes


def test_stiffness_from_the_rig_to_the_table(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    use(fake_rig(stiffness=golden))
    assert main([*STIFFNESS, "--out", "k"]) == 0
    table = read_stiffness_table(tmp_path / "k" / "stiffness.csv")
    assert table.pressures[:, 0].tolist() == [0, 0, 1e5, 1e5]
    assert table.directions[:2].tolist() == [[1, 0, 0], [0, 0, -1]]
    np.testing.assert_allclose(table.stiffness, [14.03, 730.42, 13.91, 31.89], rtol=1e-3)
    np.testing.assert_allclose(table.others["model_n_per_m"], table.stiffness, rtol=2e-3)
    assert (tmp_path / "k" / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "95 % confidence" in capsys.readouterr().out


def test_quiet_is_quiet(use: Callable[[Rig], Rig], capsys: pytest.CaptureFixture[str]) -> None:
    use(fake_rig(slew=3e5))
    assert main([*KINEMATICS, "--quiet", "--no-plot", "--out", "a"]) == 0
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "")
    assert not Path("a/figure.png").exists()


def test_ctrl_c_vents_and_keeps_and_can_be_resumed(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig(slew=3e5))
    world, supply = world_of(rig), rig.bare  # type: ignore[attr-defined]
    assert isinstance(supply, FakeSupply)
    pressed: list[float] = []

    def press() -> None:
        pressed.append(world.commanded.max())
        signal.raise_signal(signal.SIGINT)

    def impatient() -> None:
        if pressed:  # a second time, while the arm is vented
            signal.raise_signal(signal.SIGINT)

    world.at.append((6.3, press))
    supply.on_write = impatient
    assert main([*KINEMATICS, "--out", "run"]) == 130
    assert pressed[0] > 0
    assert not world.commanded.any()
    assert not supply.is_open
    assert world.t - 100 < 6.4
    said = capsys.readouterr().err
    assert "rig.yaml --resume run" in said
    assert "interrupted" in said
    assert (tmp_path / "run" / "kinematics_1.csv").exists()
    assert len(read_log(tmp_path / "run" / "kinematics_2.part.csv")) > 10
    use(fake_rig(slew=3e5))
    assert main(["experiment", "kinematics", "rig.yaml", "--resume", "run"]) == 0
    assert (tmp_path / "run" / "kinematics_2.csv").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_fault_of_the_rig(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig())
    world_of(rig).at.append((4.0, lambda: setattr(world_of(rig), "seen", False)))
    assert main([*KINEMATICS, "--out", "run"]) == 5
    said = capsys.readouterr().err
    assert "has not seen the tip for 0.5 s; the arm is vented" in said
    assert "--resume run" in said
    assert not world_of(rig).commanded.any()


def test_a_supply_that_dies_is_said_to_be_dangerous(
    use: Callable[[Rig], Rig], capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig())
    world_of(rig).at.append((3.0, lambda: setattr(rig.bare, "dead", True)))
    assert main([*KINEMATICS, "--out", "run"]) == 5
    assert "MAY STILL BE UNDER PRESSURE" in capsys.readouterr().err


def test_no_device_leaves_no_folder(
    use: Callable[[Rig], Rig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = use(fake_rig())
    rig.bare.dead = True  # type: ignore[attr-defined]
    assert main([*KINEMATICS, "--out", "run"]) == 5
    assert "does not answer" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*KINEMATICS, "--pressures", "2 bar"], "cannot have 2 bar"),
        ([*KINEMATICS, "--pressures", "0.4,0.8"], "is no list of pressures"),
        ([*KINEMATICS, "--pressures", "1 mm"], "--pressures: '1 mm'"),
        ([*KINEMATICS, "--pressures", "0 bar"], "must be greater than 0"),
        ([*KINEMATICS, "--period", "5"], "--period: '5' has no unit"),
        ([*KINEMATICS, "--poses", "-1"], "'--poses'"),
        ([*KINEMATICS, "--max", "0 bar"], "max: must be greater than 0"),
        ([*KINEMATICS, "--max", "1 s"], "--max: '1 s'"),
        ([*KINEMATICS, "--settle", "0 s"], "settle: must be greater than 0"),
        ([*KINEMATICS, "--model", "stiff-flop-2"], "has 6 channels, the rig has 3"),
        ([*KINEMATICS, "--resume", "none"], "--pressures cannot be changed"),
        (["experiment", "kinematics", "rig.yaml", "--resume", "none"], "holds no experiment"),
        ([*KINEMATICS, "--out", "full"], "is not empty"),
        ([*STIFFNESS, "--directions", "x,w"], "'w' is no direction"),
        ([*STIFFNESS, "--directions", "x,x"], "a direction is given twice"),
        ([*STIFFNESS, "--channel", "7"], "there is no channel 7"),
        ([*STIFFNESS, "--displacement", "3 s"], "--displacement: '3 s'"),
    ],
)
def test_bad_input_moves_nothing(
    use: Callable[[Rig], Rig],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    rig = use(fake_rig())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").touch()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said
    assert not world_of(rig).writes
    assert not (tmp_path / "runs").exists()


def test_an_experiment_of_another_kind_or_robot_is_not_resumed(
    use: Callable[[Rig], Rig], capsys: pytest.CaptureFixture[str]
) -> None:
    use(fake_rig(slew=3e5))
    assert main([*KINEMATICS, "--out", "run", "--no-plot", "-q"]) == 0
    assert main([*KINEMATICS, "--out", "run"]) == 2
    assert "continue it with --resume run" in capsys.readouterr().err
    assert main(["experiment", "stiffness", "rig.yaml", "--resume", "run"]) == 2
    assert "experiment.yaml" in capsys.readouterr().err
    use(fake_rig(robot="stiff-flop-2"))
    assert main(["experiment", "kinematics", "rig.yaml", "--resume", "run"]) == 2
    assert "begun with the robot stiff-flop-1, not stiff-flop-2" in capsys.readouterr().err


@pytest.mark.parametrize(("module", "extra"), [("matplotlib", "plot"), ("foxglove", "log")])
def test_what_is_not_installed_is_said_before_anything_moves(
    use: Callable[[Rig], Rig],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    module: str,
    extra: str,
) -> None:
    rig = use(fake_rig())
    monkeypatch.setitem(sys.modules, module, None)
    assert main(KINEMATICS) == 2
    assert f"pip install 'stiffopt[{extra}]'" in capsys.readouterr().err
    assert not world_of(rig).writes
    assert not Path("runs").exists()


def test_lists_and_ranges_of_pressures() -> None:
    assert pressures("-p", "0.4,0.8,1.0 bar") == (0.4e5, 0.8e5, 1e5)
    assert pressures("-p", "0:1.5:0.25 bar") == tuple(0.25e5 * k for k in range(7))
    assert pressures("-p", "0:0.3:0.1 bar") == pytest.approx((0, 1e4, 2e4, 3e4))
    assert pressures("-p", " 50 kPa ") == (5e4,)
    for text in ("", "bar", "1,,2 bar", "0:1 bar", "1:0:0.1 bar", "0:1:0 bar", "1,1 bar",
                 "0:1:0.0001 bar", "nan bar", "1;2 bar"):  # fmt: skip
        with pytest.raises(InputError, match=r"^-p: "):
            pressures("-p", text)
    assert directions("-d", "x, -z") == ((1, 0, 0), (0, 0, -1))


def test_the_settings_are_read_back(tmp_path: Path) -> None:
    from stiffopt.experiments.folder import create_folder, open_folder

    for number, settings in enumerate(
        (KinematicsSettings(channels=3), quick(directions=((0.0, 0.6, -0.8),)))
    ):
        folder = tmp_path / str(number)
        create_folder(folder, settings)
        assert open_folder(folder, type(settings)) == settings
    with pytest.raises(FileError, match="holds an experiment"):
        create_folder(tmp_path / "0", KinematicsSettings(channels=3))


def test_help_waits_for_no_numerics() -> None:
    script = (
        "import sys\nfrom stiffopt.cli.main import main\n"
        "assert main(['experiment', 'stiffness', '--help']) == 0\n"
        "found = {'numpy', 'casadi', 'matplotlib', 'mcap', 'numba'} & set(sys.modules)\n"
        "assert not found, found"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_an_alignment_that_takes_long_ends_with_a_vented_arm(tmp_path: Path) -> None:
    """Nobody commands while this probe is aligned, so the arm is let down; no jump back up."""
    rig = fake_rig(stiffness=golden)
    world, probe = world_of(rig), rig.probe
    assert probe is not None
    align = probe.align

    def slowly(direction: tuple[float, ...]) -> None:
        stall(rig, 60)
        align(direction)

    probe.align = slowly  # type: ignore[method-assign, assignment]
    settings = quick(directions=((1.0, 0.0, 0.0),))
    with rig, pytest.raises(DeviceError, match=r"stalled for 60 s.*--resume"):
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    late = [value for time, value in world.writes if time > 100 + 60]
    assert late
    assert not np.any(late)


class _ByHand:
    """A probe that a person mounts: `align` lasts until the rig has been spoken to for a while."""

    def __init__(self, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rig, self.writes = rig, [0]
        self.fail: Exception | None = None
        align = rig.probe.align  # type: ignore[union-attr]

        def by_hand(direction: tuple[float, ...]) -> None:
            world = world_of(rig)
            before, began = len(world.writes), world.t
            world.seen = False  # a hand before the sensor
            while world.t < began + 30 and not self.fail:
                time.sleep(0.001)
            world.seen = True
            if self.fail:
                raise self.fail
            self.writes.append(len(world.writes) - before)
            align(direction)

        monkeypatch.setattr(rig.probe, "align", by_hand)
        monkeypatch.setattr(type(rig.probe), "needs_a_person", True)


def test_pressures_are_held_while_a_person_mounts_the_probe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = fake_rig(stiffness=golden)
    person = _ByHand(rig, monkeypatch)
    with rig:
        run_stiffness(rig, tmp_path, quick(directions=((1.0, 0.0, 0.0),)), model(), rate=50.0)
    assert person.writes[-1] > 1000  # 30 s at 50 Hz: no watchdog would have run out
    _, pressures_then = world_of(rig).alignments[-1]
    assert pressures_then[0] == pytest.approx(0.4e5, abs=20)


def test_what_goes_wrong_while_the_probe_is_mounted_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = fake_rig(stiffness=golden)
    _ByHand(rig, monkeypatch).fail = DeviceError("nobody is at the terminal")
    settings = quick(directions=((1.0, 0.0, 0.0),))
    with rig, pytest.raises(DeviceError, match="nobody is at"):
        run_stiffness(rig, tmp_path, settings, model(), rate=50.0)
    assert not world_of(rig).commanded.any()


def test_two_processes_do_not_share_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    create_folder(folder, short(rig="sim", robot="stiff-flop-1"))
    with alone_in(folder):
        code = main(["experiment", "kinematics", str(SIM), "--resume", str(folder), "--no-plot"])
    assert code == 2
    assert "another process is at work" in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in folder.iterdir()] == ["experiment.yaml"]


def test_a_probe_that_is_mounted_by_hand_needs_somebody(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stiffopt.plant.devices.SimulatedProbe.needs_a_person", True, raising=False)
    folder = tmp_path / "run"
    code = main(["experiment", "stiffness", str(SIM), "--out", str(folder), "--no-plot"])
    assert code == 2
    assert "at a terminal" in " ".join(capsys.readouterr().err.split())
    assert not folder.exists()


def test_readings_that_cannot_be_end_the_experiment(tmp_path: Path) -> None:
    description = load_rig_description(SIM)
    plant = description.plant.model_copy(update={"faults": True, "dynamics": "quasi-static"})
    rig = rig_for_programs(
        description.model_copy(update={"plant": plant}),
        stiffopt.load_robot("stiff-flop-1").description,
    )
    world = rig.world  # type: ignore[attr-defined]

    def spoil(done: float, total: float, text: str) -> None:
        if world.time > 3 and world.faults["supply"] == "ok":
            world.inject("supply", "garbage", 1)

    with rig, pytest.raises(DeviceError, match=r"channel 2 reads .*, which cannot be"):
        run_kinematics(rig, tmp_path, short(), rate=50.0, progress=spoil)
    assert not world.set_point.any()
