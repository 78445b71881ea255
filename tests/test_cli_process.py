"""`solve-pressure` as a process: pictures, help, interrupts, terminals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import stiffopt
from cli_tasks import FAR, ONE, TWO, Write, lines, process, run
from cli_tasks import write_fixture as write_fixture
from stiffopt.cli import batch, exits, solve_run
from stiffopt.cli import main as entry
from stiffopt.documents import read_document
from stiffopt.errors import EquilibriumError, FileError
from stiffopt.optimise.general_search import GeneralSearch


@pytest.mark.parametrize("view", ["20 deg", "120 deg, 0 deg", "1 mm, 2 mm"])
def test_no_view(view: str, write: Write) -> None:
    result = run(write("a.yaml", ONE), "--view", view)
    assert result.exit_code == 2
    assert result.stderr.startswith("error: --view: ")
    assert result.stdout == ""


def test_plot_of_one_and_of_several(tmp_path: Path, write: Write) -> None:
    (tmp_path / "sub").mkdir()
    one, far = write("one.yaml", ONE), write("far.yaml", FAR)
    view = ("--view", "10 deg, -0.5 rad")
    assert run("-q", one, "--plot", str(tmp_path / "p.png"), *view).exit_code == 0
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    again = write("sub/one.yaml", ONE)
    assert run("-q", one, far, again, "--plot", str(tmp_path / "q.png")).exit_code == 3
    for name in ("q-one.png", "q-far.png", "q-one-2.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_plot_of_a_failure_is_no_second_failure(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    def falls_over(self: Any, *args: Any) -> None:
        raise EquilibriumError("the arm falls over")

    monkeypatch.setattr(GeneralSearch, "_solve", falls_over)
    result = run(write("one.yaml", ONE), "--plot", str(tmp_path / "p.png"))
    assert result.exit_code == 4
    assert "no picture of" in result.stderr
    assert not (tmp_path / "p.png").exists()


def test_without_matplotlib_a_helpful_error(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = run(write("one.yaml", ONE), "--plot", str(tmp_path / "p.png"))
    assert result.exit_code == 2
    assert "pip install 'stiffopt[plot]'" in result.stderr
    assert result.stdout == ""


def test_no_file_is_2_and_the_usage() -> None:
    done = process()
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Usage: solve-pressure" in done.stderr


def test_unknown_option_is_2() -> None:
    done = process("--jason")
    assert done.returncode == 2
    assert "--json" in done.stderr


def test_help_shows_examples_and_exit_codes() -> None:
    text = process("--help").stdout
    assert text.count("\n    solve-pressure ") >= 5
    for option in (
        "--json",
        "--out",
        "--plot",
        "--view",
        "--pareto",
        "--seed",
        "--quiet",
        "--version",
    ):
        assert option in text
    assert "Exit codes" in text
    assert "  format: stiffopt-task/1" in text
    assert max(map(len, text.splitlines())) <= 80


def test_version() -> None:
    for command in ("stiffopt", "solve-pressure"):
        done = process("--version", command=command)
        assert done.stdout == f"stiffopt {stiffopt.__version__}\n"
        assert done.returncode == 0


def test_stiffopt_solve_is_solve_pressure(write: Write) -> None:
    path = write("one.yaml", ONE)
    both = [
        lines(process(*words, "--json", path, command=command).stdout)[0]
        for command, words in (("stiffopt", ["solve"]), ("solve-pressure", []))
    ]
    for record in both:
        record.pop("solve_time_s")
    assert both[0] == both[1]


def test_robots_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["robots"]) == 0
    text = capsys.readouterr().out
    for name in stiffopt.builtin_robots():
        assert name in text
    assert "270 mm" in text


def test_entry_points_return_the_code(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.solve_pressure_main(["-q", write("one.yaml", ONE)]) == 0
    assert entry.main(["solve", "-q", write("far.yaml", FAR)]) == 3
    assert entry.main([]) == 2
    assert "Usage: stiffopt" in capsys.readouterr().err


def test_json_and_help_load_no_matplotlib_and_no_scipy(write: Write) -> None:
    script = (
        "import sys\n"
        "from stiffopt.cli.main import solve_pressure_main\n"
        "code = solve_pressure_main(sys.argv[1:])\n"
        "found = {'matplotlib', 'scipy.optimize', 'scipy.sparse'} & set(sys.modules)\n"
        "sys.exit(f'loads {found}' if found else code)\n"
    )
    for arguments in (["--help"], ["--json", write("one.yaml", ONE)]):
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr


def test_a_reader_that_leaves_is_no_error(tmp_path: Path, write: Write) -> None:
    script = Path(sys.executable).with_name("solve-pressure")
    paths = [write("a.yaml", ONE), write("b.yaml", ONE)]
    out = tmp_path / "out.yaml"
    for extra in ([], ["--out", str(out)]):
        with subprocess.Popen(
            [script, *paths, *extra], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            child.stdout.close()
            assert child.stderr is not None
            assert child.stderr.read() == ""
            assert child.wait() == exits.CLOSED_PIPE
    assert len(read_document(out).data["results"]) == 2  # the files are written all the same


def test_no_error_is_written_into_the_progress_bar(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []  # what the bar says now
    errors = []

    class Bar(batch.ProgressBar):
        def report(self, done: float, total: float | None, text: str) -> None:
            shown[:] = [text]

        def hide(self) -> None:
            shown.clear()

    def report_error(message: str) -> None:
        assert not shown
        errors.append(message)

    def fail(*_: object) -> None:
        assert "drawing" in shown[0]
        raise FileError("one.png", "cannot be written")

    monkeypatch.setattr(batch, "ProgressBar", Bar)
    monkeypatch.setattr(batch, "report_error", report_error)
    monkeypatch.setattr(solve_run.solve_files, "draw", fail)
    paths = [write("bad.yaml", "format: stiffopt-task/1"), write("one.yaml", ONE)]
    assert entry.main(["solve", *paths, "--plot", str(tmp_path / "x.png")]) == exits.BAD_INPUT
    assert len(errors) == 2


def test_ctrl_c_is_130(write: Write) -> None:
    script = Path(sys.executable).with_name("solve-pressure")
    paths = [write("a.yaml", ONE)] + [write(f"b{k}.yaml", TWO) for k in range(60)]
    with subprocess.Popen(
        [script, "--json", *paths],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # as in a terminal
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()  # it is at work
        time.sleep(0.1)
        child.send_signal(signal.SIGINT)
        _, error = child.communicate(timeout=30)
    assert child.returncode == exits.INTERRUPTED
    assert error == "interrupted\n"


def test_a_terminal_without_unicode(write: Write) -> None:
    path = write("größe.yaml", ONE)
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = process(path, path, env=environment)
    assert done.returncode == 0
    assert "gr\\xf6\\xdfe.yaml" in done.stdout
