"""`stiffopt log export` and `stiffopt log plot`: from a recording to a table and a page."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made_runs import BEGIN, PERIOD, FakeLoop, N, event, samples_between, snapshot, ticks, tip_at
from stiffopt.cli.main import main
from stiffopt.control.state import Alarm, Severity, State
from stiffopt.daemon import run_log
from stiffopt.daemon.run_errors import ErrorStatistics, RunStages
from stiffopt.daemon.run_log import RecordedRun, RunSpan, read_run
from stiffopt.daemon.topics import FORMAT, METADATA
from stiffopt.errors import FileError
from stiffopt.logs import LogLayout, LogRow, McapLogWriter, read_log
from stiffopt.logs.mcap_file import McapContents
from stiffopt.plots.run import error_lines
from test_telemetry import recorded

pytest.importorskip("foxglove")
make_reader = pytest.importorskip("mcap.reader").make_reader


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    loop = FakeLoop()
    loop.events.all += [
        event(0.0, "armed", "The arm is armed."),
        event(2.0, "tracker-missing", "The tracker sees nothing: $x$ [1].", Severity.WARNING),
    ]
    given = ticks(200)
    missing = Alarm("tracker-missing", "The tracker sees nothing.", BEGIN + 2.0)
    given += [
        snapshot(BEGIN + 2.0 + k * PERIOD, state=State.HOLDING, reason="lost", alarms=(missing,))
        for k in range(50)
    ]
    given += [
        snapshot(BEGIN + t, samples=samples_between(BEGIN + t - PERIOD, BEGIN + t))
        for t in np.arange(2.5, 4, PERIOD)
    ]
    return recorded(tmp_path_factory.mktemp("runs"), loop, given)


def test_export_writes_log_v1_beside_the_run(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run.mcap"
    run.write_bytes(run_file.read_bytes())
    assert main(["log", "export", str(run), "--csv"]) == 0
    log = read_log(tmp_path / "run.csv")
    seen = np.isfinite(log.tip_position).all(axis=1)
    assert f"{len(log)} rows, {seen.sum()} with a tip" in capsys.readouterr().out
    assert log.n == N
    assert seen.sum() > 100
    for i in np.flatnonzero(seen):
        np.testing.assert_allclose(log.tip_position[i], tip_at(BEGIN + log.time[i]), atol=1e-7)
    # while the tracker saw nothing, and the frames on their way when it began
    assert not seen[(log.time > 2.01) & (log.time < 2.46)].any()
    assert ((log.time > 2.01) & (log.time < 2.46)).sum() > 5


def test_a_recording_of_a_run_can_be_checked_but_is_no_log(run_file: Path, capsys: Any) -> None:
    assert main(["check", str(run_file)]) == 0
    assert "a log file without mistakes" in capsys.readouterr().out
    assert main(["validate", "--robot", "stiff-flop-1", str(run_file)]) == 2
    assert "'stiffopt log export' reads those of runs" in " ".join(capsys.readouterr().err.split())


def test_export_overwrites_nothing(run_file: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.csv"
    assert main(["log", "export", str(run_file), "--csv", "--out", str(out), "--quiet"]) == 0
    before = out.read_bytes()
    assert capsys.readouterr().out == ""
    assert main(["log", "export", str(run_file), "--csv", "--out", str(out)]) == 2
    assert "exists" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_a_recording_that_was_cut_short_is_exported_as_far_as_it_goes(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    data = run_file.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    assert main(["log", "export", str(cut), "--csv"]) == 0
    assert "truncated" in capsys.readouterr().err
    assert 10 < len(read_log(tmp_path / "cut.csv")) < 150
    assert main(["check", str(cut)]) == 2
    assert "was truncated or damaged" in " ".join(capsys.readouterr().out.split())
    assert main(["log", "plot", str(cut)]) == 0
    assert (tmp_path / "cut.png").stat().st_size > 10_000


def test_a_recording_of_an_experiment_is_exported_too(tmp_path: Path) -> None:
    path = tmp_path / "experiment.mcap"
    with McapLogWriter(path, LogLayout(n=3, measured=True, tip_quaternion=True)) as writer:
        for k in range(30):
            tip = [0.001 * k, 0, 0.09]
            writer.append(LogRow(k * 0.025, [1e4 * k, 0, 0], [1e4 * k, 0, 0], tip, [1, 0, 0, 0]))
    assert main(["log", "export", str(path), "--csv"]) == 0
    log = read_log(tmp_path / "experiment.csv")
    np.testing.assert_allclose(log.tip_position[:, 0], 0.001 * np.arange(30), atol=1e-9)


def test_a_message_that_is_no_object_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    about = {"format": FORMAT, "start_s": "0", "channels": "3"}
    found = McapContents({METADATA: about}, [("/pressure", [])])
    monkeypatch.setattr(run_log, "read_mcap", lambda _: found)
    with pytest.raises(FileError, match="is damaged"):
        read_run("odd.mcap")


def test_bad_input_is_one_sentence(
    run_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = run_file.read_bytes()
    with run_file.open("rb") as stream:
        first = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    other = tmp_path / "other.mcap"
    with McapLogWriter(other, LogLayout(n=3)) as writer:
        writer.append(LogRow(0.0, [0, 0, 0], position=[0, 0, 0.09]))
    files = {
        "nothing.mcap": (b"", "no recording"),
        "text.mcap": (b"time_s,p1_pa\n0,0\n", "no recording"),
        "noise.mcap": (np.random.default_rng(0).bytes(5000), "no recording"),
        "head.mcap": (data[:60], "no recording"),
        "early.mcap": (data[: first + 100], "truncated too early"),
    }
    for name, (content, _) in files.items():
        (tmp_path / name).write_bytes(content)
    cases = [(name, words) for name, (_, words) in files.items()]
    cases += [("missing.mcap", "no such file"), (".", "is a folder")]
    for command in (["export", "--csv", "--out", str(tmp_path / "x.csv")],
                    ["plot", "--out", str(tmp_path / "x.png")]):  # fmt: skip
        for name, words in cases:
            assert main(["log", *command, str(tmp_path / name)]) == 2, name
            told = capsys.readouterr()
            assert words in told.err, name
            assert told.err.count("\n") == 1
            assert not told.out
    assert main(["log", "plot", str(other)]) == 2
    assert "experiment" in capsys.readouterr().err
    assert main(["log", "plot", str(tmp_path / "no" / "run.mcap")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert main(["log", "plot", str(run_file), "--out", str(tmp_path / "x.doc")]) == 2
    assert ".png" in capsys.readouterr().err
    assert main(["log", "export", str(run_file), "--out", str(tmp_path / "no" / "x.csv")]) == 2
    assert not (tmp_path / "x.csv").exists()
    assert not (tmp_path / "x.png").exists()


def test_without_mcap_it_says_how_to_get_it(
    run_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mcap", None)
    assert main(["log", "plot", str(run_file)]) == 2
    assert "stiffopt[log]" in capsys.readouterr().err


def test_damage_inside_is_told_or_passed_over(run_file: Path, tmp_path: Path, capsys: Any) -> None:
    data = bytearray(run_file.read_bytes())
    random = np.random.default_rng(1)
    broken = tmp_path / "broken.mcap"
    for place in random.integers(8, len(data), 12):
        changed = bytearray(data)
        changed[place] ^= 0xFF
        broken.write_bytes(changed)
        (tmp_path / "broken.csv").unlink(missing_ok=True)
        assert main(["log", "export", str(broken), "--csv"]) in (0, 2)
        assert "Traceback" not in capsys.readouterr().err


def test_help_waits_for_no_numerics() -> None:
    script = (
        "import sys\nfrom stiffopt.cli.main import main\n"
        "assert main(['log', 'plot', '--help']) == 0\n"
        "assert not {'numpy', 'matplotlib', 'mcap', 'foxglove'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


# The page -----------------------------------------------------------------------------------------


def page(run: RecordedRun) -> Any:
    pytest.importorskip("matplotlib")
    from stiffopt.plots.run import plot_run

    return plot_run(run)


def test_the_page_shows_what_happened(run_file: Path) -> None:
    run = read_run(run_file)
    figure = page(run)
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == [
        "tip x (mm)", "tip y (mm)", "tip z (mm)", "error (mm)", "segment 1\n(bar)",
        "segment 2\n(bar)", "stiffness\n(N/m)", "",
    ]  # fmt: skip
    x = figure.axes[0]
    drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in x.lines}
    np.testing.assert_allclose(drawn["estimate"], run.tip_position[:, 0] * 1e3)
    np.testing.assert_allclose(drawn["target"], 20.0)
    assert "target" not in {line.get_label() for line in figure.axes[1].lines}  # that axis is free
    timeline = [text.get_text() for text in figure.axes[-1].get_yticklabels()]
    assert timeline == ["state", "tracker-missing", "events"]
    texts = [text.get_text() for text in figure.texts]
    assert "a rig" in texts
    assert "The arm is armed." in texts
    assert r"The tracker sees nothing: \$x\$ [1]." in texts


def stepped(run: RecordedRun) -> RecordedRun:
    """A run of 10 s: two targets, of which the first is reached after 1 s, and a pause."""
    time = np.arange(1000) * 0.01
    target = np.tile([0.02, np.nan, 0.19], (1000, 1))
    target[600:, 0] += 0.01
    error = np.full(1000, 8e-3)
    error[100:600] = 2e-4
    error[200] = 3e-3  # pushed: it is held all the same
    error[600:] = 5e-3
    nothing = np.full((1000, 4), np.nan)
    fields = {
        "position_error": error, "angle_error": np.full(1000, np.nan), "target_position": target,
        "target_pointing": nothing[:, :3], "target_quaternion": nothing,
    }  # fmt: skip
    states = (RunSpan(0.0, 8.0, "active", ""), RunSpan(8.0, 10.0, "holding", ""))
    return replace(run, time=time, fields=fields, states=states)


def test_errors_on_the_way_and_at_the_target_are_told_apart(run_file: Path) -> None:
    run = stepped(read_run(run_file))
    approach, hold = RunStages.of(run)
    assert np.flatnonzero(hold).tolist() == list(range(100, 600))
    assert np.flatnonzero(approach).tolist() == [*range(100), *range(600, 800)]
    held = ErrorStatistics.of(run.position_error[hold])
    assert held == pytest.approx(((499 * 2e-4 + 3e-3) / 500, 2e-4, 3e-3, 500))
    assert error_lines(run) == [
        "on the way to a target:   error mean 6, 95 % below 8, at most 8 mm",
        "at a target:   error mean 0.206, 95 % below 0.2, at most 3 mm",
    ]


def test_a_target_that_moves_on_slowly_is_held(run_file: Path) -> None:
    run = stepped(read_run(run_file))
    moving = np.tile([0.02, np.nan, 0.19], (1000, 1))
    moving[:, 0] += np.linspace(0, 0.03, 1000)  # 3 mm/s
    run = replace(run, fields={**run.fields, "target_position": moving})
    assert np.flatnonzero(RunStages.of(run).hold).tolist() == list(range(100, 800))
    far = replace(run, fields={**run.fields, "position_error": np.full(1000, 4e-3)})
    assert error_lines(far)[1] == "no target was reached to 1 mm and 1 deg"
    unknown = np.full(1000, np.nan)
    none = replace(run, fields={**run.fields, "position_error": unknown})
    assert error_lines(none) == ["no target was set"]
    assert ErrorStatistics.of(unknown) is None
    angle = {"position_error": unknown, "angle_error": np.where(run.time < 1, 0.1, 0.01)}
    turned = replace(run, fields={**run.fields, **angle})
    assert error_lines(turned)[1].startswith("at a target:   error mean 0.573, ")


def test_nothing_leaves_the_page(run_file: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    run = read_run(run_file)
    kinds = "an-alarm-with-quite-a-long-name", "b", "c", "d", "e", "f", "g", "h"
    crowd = tuple(replace(run.alarms[0], kind=kind) for kind in kinds)
    long = tuple(replace(run.events[0], text="word " * 80, time=k * 0.1) for k in range(40))
    figure = page(replace(run, alarms=crowd, events=long))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    box = figure.bbox
    texts = [*figure.texts]
    for axes in figure.axes:
        texts += [axes.yaxis.label, axes.xaxis.label, *axes.get_yticklabels(), *axes.texts]
        legend = axes.get_legend()
        texts += legend.get_texts() if legend else []
    for text in texts:
        if text.get_text() and text.get_visible():
            place = text.get_window_extent()
            assert place.x0 >= 0, text
            assert place.x1 <= box.x1, text
            assert place.y0 >= 0, text
            assert place.y1 <= box.y1, text


def test_a_run_in_which_nothing_was_asked_can_be_drawn(tmp_path: Path) -> None:
    blank = snapshot(BEGIN, state=State.INACTIVE)
    blank = replace(
        blank, target_position=None, target_pointing=None, position_error=np.nan,
        stiffness=np.nan, best_stiffness=np.nan, measured=np.full(N, np.nan),
        tip_position=np.full(3, np.nan),
    )  # fmt: skip
    figure = page(read_run(recorded(tmp_path, FakeLoop(), [blank])))
    figure.savefig(tmp_path / "blank.png")


def test_a_long_run_is_thinned_and_keeps_its_extremes() -> None:
    from stiffopt.plots.style import thinned

    time = np.linspace(0, 100, 50_000)
    values = np.sin(time)
    values[23_456], values[31_000] = 7.0, np.nan
    moments, kept = thinned(time, values)
    assert len(moments) <= 4001
    assert np.nanmax(kept) == 7.0
    assert np.all(np.diff(moments) > 0)
    assert (moments[0], moments[-1]) == (pytest.approx(0, abs=0.1), 100)
