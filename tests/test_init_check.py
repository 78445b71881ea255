"""`stiffopt init` and `stiffopt check`: first files, and what is wrong with files."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import stiffopt
from stiffopt.cli import main as entry
from stiffopt.documents import read_document

ROOT = Path(__file__).parent.parent
KINDS = ("robot", "task", "path", "scene", "rig")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(entry.app, arguments)


@pytest.mark.parametrize("kind", KINDS)
def test_a_first_file_is_right_and_says_what_comes_next(kind: str) -> None:
    name = f"a {kind}.yaml"
    made = run("init", kind, name)
    assert made.exit_code == 0, made.output
    assert made.stdout.startswith(f"{name}: written. Next:")
    text = Path(name).read_text(encoding="utf-8")
    schema = text.splitlines()[0].removeprefix("# yaml-language-server: $schema=file://")
    assert json.loads(Path(schema).read_text(encoding="utf-8"))["title"] == f"stiffopt {kind} file"
    found = run("check", name)
    assert (found.exit_code, found.stdout) == (0, f"{name}: a {kind} file without mistakes\n")


UNARMED = """format: stiffopt-rig/1
robot: arm.yaml
rate: 10 Hz
supply:
  driver: modbus
  tcp: {host: localhost}
  scale: {counts: [0, 32767], pressure: [0 bar, 10 bar]}
  channels: [{setpoint: 1}, {setpoint: 2}, {setpoint: 3}]
tracker: {driver: aurora, rate: 10 Hz}
safety: {guard_timeout: 100 ms, command_timeout: 50 ms, tracker_timeout: 90 ms}
"""


def test_a_rig_that_could_never_be_armed_is_a_mistake() -> None:
    robot = (ROOT / "src/stiffopt/robots/stiff-flop-1.yaml").read_text(encoding="utf-8")
    Path("arm.yaml").write_text(re.sub(r", slew: [^}]*", "", robot), encoding="utf-8")
    Path("rig.yaml").write_text(UNARMED, encoding="utf-8")
    found = run("check", "rig.yaml")
    assert found.exit_code == 2
    expected = [
        "rig.yaml: safety.max_slew: there is no limit",
        "rig.yaml:4: supply: this supply has neither a watchdog nor a dump valve",
        "rig.yaml:10: safety.guard_timeout: 100 ms is not longer than the 100 ms between two comm",
        "rig.yaml:10: safety.command_timeout: 50 ms is not longer",
        "rig.yaml: supply.timeout: 200 ms, its default, is longer than safety.command_timeou",
        "rig.yaml:10: safety.tracker_timeout: 90 ms is shorter than the 100 ms between two frames",
    ]
    lines = found.stdout.splitlines()
    assert len(lines) == len(expected)
    assert all(line.startswith(text) for line, text in zip(lines, expected, strict=True)), lines
    mended = UNARMED.replace("10 Hz", "40 Hz").replace("safety: {", "safety: {max_slew: 1 bar/s, ")
    mended = mended.replace("scale:", "dump_valve: {coil: 0}\n  scale:").replace("50 ms", "0.2 s")
    Path("rig.yaml").write_text(mended, encoding="utf-8")
    assert run("check", "--quiet", "rig.yaml").stdout == ""
    for_scripts = re.sub("tracker: .*\n", "", mended)
    Path("rig.yaml").write_text(for_scripts, encoding="utf-8")
    assert run("check", "--quiet", "rig.yaml").stdout == ""
    Path("rig.yaml").write_text(for_scripts.replace("40 Hz", "600 Hz"), encoding="utf-8")
    assert "rate: 600 Hz is too fast" in run("check", "rig.yaml").stdout


TCP, SERIAL = "tcp: {host: localhost}", "serial: {port: COM3}"


@pytest.mark.parametrize(
    ("supply", "said"),
    [
        (f"{TCP}\n  watchdog: {{address: 9, timeout: 40 ms}}", ""),
        (
            f"{TCP}\n  watchdog: {{address: 9, timeout: 20 ms}}",
            "rig.yaml:7: supply.watchdog.timeout: 20 ms is not longer than the 25 ms between two "
            "commands at a rate of 40 Hz: the device would vent every time",
        ),
        # 6 bytes to the device, 6 read back and 25 of framing at 11 bits a byte and 9600 Bd
        (
            f"{SERIAL[:-1]}, baudrate: 9600}}\n  watchdog: {{address: 9, timeout: 40 ms}}",
            "rig.yaml:7: supply.watchdog.timeout: 40 ms is not longer than the 42.4 ms that a "
            "command takes on the serial line: the device would vent every time",
        ),
        (f"{SERIAL}\n  watchdog: {{address: 9, timeout: 40 ms}}", ""),
        # three requests: 24 and 6, 20 and 6, 20 and 2; and 23 for the trigger
        (
            f"{SERIAL[:-1]}, baudrate: 9600}}\n  watchdog: {{address: 9, timeout: 110 ms, "
            "trigger: 10}",
            "rig.yaml:7: supply.watchdog.timeout: 110 ms is not longer than the 116 ms that a "
            "command takes on the serial line: the device would vent every time",
        ),
    ],
)
def test_a_device_that_would_vent_between_two_commands_is_a_mistake(supply: str, said: str) -> None:
    text = UNARMED.replace("10 Hz", "40 Hz").replace("arm.yaml", "stiff-flop-1")
    text = re.sub("safety: .*", "safety: {max_slew: 1 bar/s}", text).replace(TCP, supply)
    if "trigger" in supply:
        text = text.replace("{setpoint: 3}", "{setpoint: 3, reading: 0}")
    Path("rig.yaml").write_text(text, encoding="utf-8")
    assert run("check", "--quiet", "rig.yaml").stdout.rstrip() == said


def test_a_rig_whose_arm_is_inside_an_object_at_rest_is_a_mistake() -> None:
    text = (ROOT / "rig/brace.yaml").read_text(encoding="utf-8")
    for place, said in [
        ("-20.1 mm", ""),
        (
            "-17 mm",  # the arm's radius is 15 mm, the post's 5 mm
            "rig.yaml:13: scene.objects[0]: without pressures the arm is 3 mm inside 'post', and "
            "the loop would hold it there; correct the place or the size of the object",
        ),
    ]:
        Path("rig.yaml").write_text(text.replace("-35 mm", place), encoding="utf-8")
        assert run("check", "--quiet", "rig.yaml").stdout.rstrip() == said


def test_the_weight_may_hold_an_arm_clear_of_an_object() -> None:
    ball = "  - {name: ball, sphere: {centre: [0 mm, 0 mm, 120 mm], radius: 5 mm}}\n"
    Path("scene.yaml").write_text(f"format: stiffopt-scene/1\nobjects:\n{ball}", encoding="utf-8")
    robot = (ROOT / "src/stiffopt/robots/stiff-flop-2.yaml").read_text(encoding="utf-8")
    rig = "format: stiffopt-rig/1\nrobot: arm.yaml\nscene: scene.yaml\nsupply: {driver: simulated}"
    Path("rig.yaml").write_text(f"{rig}\nsafety: {{max_slew: 5 bar/s}}\n", encoding="utf-8")
    Path("arm.yaml").write_text(robot, encoding="utf-8")
    said = run("check", "--quiet", "rig.yaml").stdout
    assert said.startswith("rig.yaml:3: scene: without pressures the arm is 20 mm inside 'ball'")
    sideways = "gravity: [20 m/s^2, 0 m/s^2, 0 m/s^2]\ntip_mass: 20 g\n"
    Path("arm.yaml").write_text(robot + sideways, encoding="utf-8")
    assert run("check", "--quiet", "rig.yaml").stdout == ""


def test_a_watchdog_of_an_nidaq_device_is_compared_too() -> None:
    text = (ROOT / "rig/nidaq-aurora.yaml").read_text(encoding="utf-8")
    Path("rig.yaml").write_text(re.sub("watchdog: .* ms", "watchdog: 10 ms", text))
    assert "supply.watchdog: 10 ms is not longer" in run("check", "rig.yaml").stdout


def test_a_device_that_keeps_its_pressures_for_longer_than_a_command_lasts_is_a_mistake() -> None:
    """The guard can do nothing while a driver waits; a watchdog in the device can."""
    text = (ROOT / "rig/nidaq-aurora.yaml").read_text(encoding="utf-8")
    assert "timeout: 200 ms" in text
    late = text.replace("timeout: 200 ms", "timeout: 600 ms")
    Path("rig.yaml").write_text(late)
    assert run("check", "--quiet", "rig.yaml").stdout == ""
    Path("rig.yaml").write_text(re.sub("  watchdog: .* ms.*\n", "", late))
    said = "supply.timeout: 600 ms is longer than safety.command_timeout, 500 ms"
    assert said in run("check", "rig.yaml").stdout
    Path("rig.yaml").write_text(re.sub("watchdog: .* ms", "watchdog: 0.6 s", late))
    assert said in run("check", "rig.yaml").stdout
    unsaid = re.sub("  (timeout|watchdog): .* ms.*\n", "", text)
    Path("rig.yaml").write_text(unsaid)
    assert "supply.timeout: 1000 ms, its default, is longer" in run("check", "rig.yaml").stdout
    board = (ROOT / "rig/open-regulator.yaml").read_text(encoding="utf-8")
    board = board.replace("driver: open-regulator\n", "driver: open-regulator\n  timeout: 0.6 s\n")
    Path("rig.yaml").write_text(board)
    assert "timeout: 0.6 s" in board
    assert "supply.timeout" not in run("check", "rig.yaml").stdout  # it always vents by itself


def test_a_task_beside_a_rig_is_compared_with_its_scene() -> None:
    """By place and shape: what the object is called in the task does not matter."""
    rig, task = ROOT / "rig/brace.yaml", ROOT / "problems/braced/post.yaml"
    assert run("check", "--quiet", str(rig), str(task)).exit_code == 0
    Path("task.yaml").write_text(task.read_text(encoding="utf-8"), encoding="utf-8")
    scene = task.with_suffix(".scene.yaml").read_text(encoding="utf-8")
    Path("post.scene.yaml").write_text(scene.replace("radius: 5", "radius: 6"), encoding="utf-8")
    assert run("check", "--quiet", "task.yaml").exit_code == 0
    found = run("check", "--quiet", "task.yaml", str(rig))
    assert found.exit_code == 2
    assert "task.yaml" in found.stdout
    assert "'post' has another place or shape in the rig's scene" in found.stdout
    other = RIG + "robot: stiff-flop-1\n"
    Path("rig.yaml").write_text(other, encoding="utf-8")
    assert run("check", "--quiet", "task.yaml", "rig.yaml").exit_code == 0


@pytest.mark.parametrize(("highest", "says"), [("0 bar", True), ("[0 bar, 1 bar, 0 bar]", False)])
def test_a_rig_in_which_nothing_can_move_is_a_mistake(highest: str, says: bool) -> None:
    """A rig with a channel out of use, or two, is none."""
    Path("rig.yaml").write_text(
        f"{RIG}robot: stiff-flop-1\nsafety: {{max_pressure: {highest}}}\n", encoding="utf-8"
    )
    said = "rig.yaml:4: safety.max_pressure: leaves every channel at one pressure: the arm could"
    assert run("check", "--quiet", "rig.yaml").stdout.startswith(said) == says


def test_first_files_lead_to_an_answer() -> None:
    """The way of a new user: one's own arm, a task, a path, a scene, a rig."""
    assert run("init", "robot", "arm.yaml", "--segments", "2", "--length", "60 mm").exit_code == 0
    robot = stiffopt.load_robot("arm.yaml")
    assert (robot.n_pressures, robot.length) == (6, pytest.approx(0.12))
    os.mkdir("tasks")
    assert run("init", "task", "tasks/task.yaml", "--robot", "arm.yaml").exit_code == 0
    task = stiffopt.load_task("tasks/task.yaml")
    assert task.robot == f"..{os.sep}arm.yaml"
    assert stiffopt.solve_pressure(robot, task).found
    assert run("init", "path", "--robot", "arm.yaml", "--direction", "0 1 0").exit_code == 0
    path = stiffopt.load_path("my-path.yaml")
    targets = path.points().targets
    assert len(targets) > 10
    solver = stiffopt.PressureSolver(robot, task)
    assert all(solver.reachable(targets[k]) for k in (0, -1))
    assert run("init", "scene", "--robot", "arm.yaml", "--clearance", "1 mm").exit_code == 0
    assert robot.clearance([0.0] * 6, stiffopt.load_scene("my-scene.yaml")) > 1e-3
    assert run("init", "rig", "--robot", "arm.yaml").exit_code == 0
    with stiffopt.open_rig("my-rig.yaml") as rig:
        assert rig.supply.limits.n == 6


@pytest.mark.parametrize("segments", ["1", "2"])
def test_the_default_arm_is_the_papers(segments: str) -> None:
    """Without its compensation, which nobody knows of an arm of one's own."""
    assert run("init", "robot", "--segments", segments).exit_code == 0
    data = read_document("my-arm.yaml").data
    paper = read_document(ROOT / f"src/stiffopt/robots/stiff-flop-{segments}.yaml").data
    for one in paper["segments"]:
        del one["compensation"], one["connector"]
    assert data["segments"] == paper["segments"]
    assert data["pressure"] == paper["pressure"]


@pytest.mark.parametrize(
    ("mounting", "gravity"),
    [("hanging", (0, 0, 9.81)), ("standing", (0, 0, -9.81)), ("horizontal", (-9.81, 0, 0))],
)
def test_gravity_is_that_of_the_mounting(mounting: str, gravity: tuple[float, ...]) -> None:
    assert run("init", "robot", "--mounting", mounting, "--segments", "1").exit_code == 0
    assert stiffopt.load_robot("my-arm.yaml").description.gravity == gravity


@pytest.mark.parametrize("supply", ["modbus", "nidaq", "open-regulator"])
@pytest.mark.parametrize("tracker", ["aurora", "openigtlink", "none"])
def test_rigs_with_devices(supply: str, tracker: str) -> None:
    options = ("--robot", "stiff-flop-2", "--supply", supply, "--tracker", tracker)
    made = run("init", "rig", *options)
    assert made.exit_code == 0, made.output
    data = read_document("my-rig.yaml").data
    assert len(data["supply"]["channels"]) == 6
    assert data.get("tracker", {"driver": "none"})["driver"] == tracker


@pytest.mark.parametrize(
    ("robot", "safety"),
    [
        ("stiff-flop-2", {"tracker_timeout": "0.5 s"}),
        ("ucl-stiff-flop", {"max_slew": "5 bar/s", "tracker_timeout": "0.5 s"}),
    ],
)
def test_a_rig_limits_the_slew_where_its_robot_does_not(robot: str, safety: dict[str, str]) -> None:
    made = run("init", "rig", "--robot", robot)
    assert made.exit_code == 0, made.output
    assert read_document("my-rig.yaml").data["safety"] == safety


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("robot", "--length", "90"), "--length: '90' has no unit"),
        (("robot", "--length", "-90 mm"), "--length: must be greater than 0"),
        (("robot", "--outer-radius", "2 mm"), "segments[0].inner_radius: 4.5 mm must be less"),
        (("robot", "--chambers", "7"), "--channels: 3 regulators cannot feed 7 chambers alike"),
        (("robot", "--chamber-offset", "14 mm"), "--chamber-offset: chambers of radius 2.25 mm"),
        (("robot", "--mounting", "upside"), "--mounting: expected weightless or hanging"),
        (("task", "--robot", "stiff-flop-9"), "there is no robot 'stiff-flop-9'"),
        (("task", "--position", "1 mm, 2 mm"), "--position: expected a position such as"),
        (("task", "--direction", "0 0 0"), "--direction: expected a direction such as"),
        (("path", "--from", "0 mm, free, 1 mm"), "--from: "),
        (
            ("rig", "--supply", "steam"),
            "--supply: expected simulated or modbus or nidaq or open-regulator",
        ),
        (("rig", "--supply", "modbus", "--tracker", "simulated"), "--tracker: expected aurora"),
        (("scene", "x.txt"), "x.txt"),
    ],
)
def test_wrong_answers_write_nothing(arguments: tuple[str, ...], message: str) -> None:
    made = run("init", *arguments)
    assert made.exit_code == 2, made.output
    assert message in made.stderr.replace("\n", " ")
    assert os.listdir() == []


@pytest.mark.parametrize(
    "stem", ["a #1", "a: b", "[x]", "it's", 'a "b"', "1e3", "free", "ä ö", "long name " * 15 + "1"]
)
def test_names_that_yaml_would_read_as_something_else(stem: str) -> None:
    robot = f"{stem}.yaml"
    assert run("init", "robot", robot, "--segments", "1").exit_code == 0
    assert stiffopt.load_robot(robot).description.name == stem
    made = run("init", "task", "t.yaml", "--robot", robot)
    assert made.exit_code == 0, made.output
    assert stiffopt.load_task("t.yaml").robot == robot
    command = next(line for line in made.stdout.splitlines() if "init path" in line)
    assert shlex.split(command, comments=True)[-1] == robot


def test_a_robot_in_another_folder() -> None:
    os.mkdir("tasks")
    assert run("init", "robot", "arm.yaml", "--segments", "1").exit_code == 0
    made = run("init", "task", "tasks/t.yaml", "--robot", "arm.yaml")
    assert "stiffopt init path --robot arm.yaml" in made.stdout  # as it is seen from here
    assert stiffopt.load_task("tasks/t.yaml").resolve_robot().n_pressures == 3


def test_a_file_that_is_there_stays() -> None:
    Path("my-task.yaml").write_text("mine", encoding="utf-8")
    made = run("init", "task")
    assert made.exit_code == 2
    assert "exists" in made.stderr
    assert Path("my-task.yaml").read_text(encoding="utf-8") == "mine"
    assert run("init", "task", "--force", "--direction", "x y z").exit_code == 2
    assert Path("my-task.yaml").read_text(encoding="utf-8") == "mine"
    assert run("init", "task", "--force").exit_code == 0
    assert stiffopt.load_task("my-task.yaml").robot == "stiff-flop-2"


def test_on_a_terminal_it_asks() -> None:
    """Answers are typed on a pseudo-terminal; return alone takes the default."""
    mine, theirs = pty.openpty()
    command = [sys.executable, "-m", "stiffopt", "init", "scene", "--clearance", "3 mm"]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        seen = _until(mine, r"stiff-flop-2\]: ")
        os.write(mine, b"stiff-flop-9\n")  # a wrong answer is asked for again
        seen += _until(mine, r"there is no robot 'stiff-flop-9'.*stiff-flop-2\]: ")
        os.write(mine, b"stiff-flop-1\n")
        seen += _until(mine, "scene: my-scene.yaml")
        assert process.wait(timeout=60) == 0
    os.close(mine)
    assert "Robot (built-in, or a robot file)" in seen
    assert "Distance" not in seen  # it was given
    sphere = read_document("my-scene.yaml").data["objects"][0]["sphere"]
    assert sphere["centre"][2] == "45 mm"


def _until(terminal: int, pattern: str) -> str:
    seen = ""
    while not re.search(pattern, seen, re.S):
        assert select.select([terminal], [], [], 60.0)[0], f"nothing more came after: {seen}"
        seen += os.read(terminal, 4096).decode()
    return seen


TASK = "format: stiffopt-task/1\ntarget: {position: [0 mm, 0 mm, 1 mm]}\n"
BENCH = "format: stiffopt-bench/1\narms:\n- name: one\n  train: [a.csv]\n  "
RIG = "format: stiffopt-rig/1\nsupply: {driver: simulated}\n"
BAD = """\
format: stiffopt-task/1
robot: stiff-flop-2
targt: 1
target: {position: [1, 2 mm, 3 kg]}
stiffness: {maximise: {directon: [1, 0, 0]}}
"""


def test_all_mistakes_are_told_one_a_line() -> None:
    Path("bad.yaml").write_text(BAD, encoding="utf-8")
    found = run("check", "bad.yaml", "missing.yaml", str(ROOT / "rig/sim.yaml"))
    assert found.exit_code == 2
    lines = found.stdout.splitlines()
    assert [line.partition(": ")[0] for line in lines] == [
        "bad.yaml:3",
        *(["bad.yaml:4"] * 2),
        *(["bad.yaml:5"] * 2),
        "missing.yaml",
        str(ROOT / "rig/sim.yaml"),
    ]
    assert "targt: unknown key; did you mean 'target'?" in lines[0]
    assert lines[-1].endswith("a rig file without mistakes")
    assert run("check", "--quiet", str(ROOT / "rig/sim.yaml")).stdout == ""


def test_more_mistakes_than_one_message_tells() -> None:
    rows = "".join(f"  wrong_{k}: 1\n" for k in range(14))
    Path("bad.yaml").write_text(f"format: stiffopt-task/1\ntarget:\n{rows}", encoding="utf-8")
    assert len(run("check", "bad.yaml").stdout.splitlines()) == 15  # and the missing robot


def test_mistakes_for_programs() -> None:
    Path("bad.yaml").write_text(BAD, encoding="utf-8")
    record = json.loads(run("check", "--json", "bad.yaml").stdout)
    assert (record["file"], record["kind"], len(record["mistakes"])) == ("bad.yaml", "task", 5)
    assert record["mistakes"][0]["line"] == 3
    assert record["mistakes"][0]["key"] == "targt"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "robot: x\n", "has no 'format'; expected one of stiffopt-robot/1"),
        ("a.yaml", "format: stiffopt-tsk/1\n", "did you mean 'stiffopt-task/1'?"),
        ("a.yaml", "format: [1]\n", "is no format that can be checked; expected one of"),
        ("a.yaml", "format: stiffopt-bench/1\narms: 3\n", "a.yaml:2: arms: expected a list"),
        ("a.yaml", f"{BENCH}robot: stiff-flop-9\n", "there is no robot"),
        ("a.csv", "time_s,p1_pa\nx,y\n", "a.csv"),
        ("a.yaml", f"{TASK}robot: none.yaml\n", "there is no file"),
        ("a.yaml", f"{TASK}robot: stiff-flop-1\npressure: {{max: [1 bar]}}\n", "pressure.max"),
        ("a.yaml", f"{RIG}robot: stiff-flop-9\n", "there is no robot"),
    ],
)
def test_each_kind_of_mistake(name: str, text: str, message: str) -> None:
    Path(name).write_text(text, encoding="utf-8")
    found = run("check", name)
    assert found.exit_code == 2
    assert message in found.stdout


def test_every_shipped_file_is_without_mistakes() -> None:
    files = [
        str(path)
        for folder in ("problems", "rig", "src/stiffopt/robots")
        for path in sorted((ROOT / folder).rglob("*.yaml"))
        if "golden" not in path.parts
    ]
    found = run("check", "--quiet", *files)
    assert (found.exit_code, found.stdout) == (0, "")


def test_completion_and_python_m() -> None:
    environment = os.environ | {
        "_STIFFOPT_COMPLETE": "complete_bash",
        "COMP_WORDS": "stiffopt ini",
        "COMP_CWORD": "1",
    }
    command = [sys.executable, "-m", "stiffopt"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["init"]
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == f"stiffopt {stiffopt.__version__}"


def test_a_pipe_that_nobody_writes_is_not_waited_for() -> None:
    os.mkfifo("pipe.yaml")
    os.mkfifo("pipe.csv")
    reader, writer = os.pipe()
    found = run("check", "pipe.yaml", "pipe.csv", f"/dev/fd/{reader}")  # as a shell's <(...)
    os.close(reader)
    os.close(writer)
    assert found.exit_code == 2
    assert found.stdout.count("is a pipe; expected a file") == 3
