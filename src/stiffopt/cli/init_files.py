"""Write the minimal, commented files of `stiffopt init`, and print what to do next."""

from __future__ import annotations

import os
import shlex
import tempfile
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stiffopt.cli.check_run import check_file
from stiffopt.cli.console import report_error, write_line
from stiffopt.cli.outputs import check_ending, check_writable
from stiffopt.cli.quantities import choice, quantity
from stiffopt.documents import to_yaml, write_whole
from stiffopt.errors import FileError, InputError, printable, shown
from stiffopt.files import format_of
from stiffopt.json_schemas import schema_file
from stiffopt.units import format_quantity

Ask = Callable[[str, str], str]
"""Takes a question and the default; returns the answer."""

_CUSTOM = "(built-in, or a robot file)"
_KEYS = {
    "chamber_radius": "chambers.radius",
    "chamber_offset": "chambers.offset",
    "outer_radius": "outer_radius",
    "inner_radius": "inner_radius",
    "length": "length",
    "modulus": "youngs_modulus",
    "max_pressure": "pressure.max",
    "position": "target.position",
    "direction": "direction",
    "from": "line.from",
    "to": "line.to",
    "speed": "timing.speed",
    "clearance": "clearance",
}
"""Names of options, and the ends of the keys at which their values stand in the file."""


def write_first_file(
    kind: str, path: str, given: Mapping[str, Any], ask: Ask | None, *, force: bool
) -> None:
    """Write a minimal file of a kind, and print what to do next.

    Raises `InputError`: an answer is invalid; nothing was written.

    Parameters
    ----------
    kind : robot, task, path, scene or rig.
    path : of the file, which must not exist unless `force`.
    given : answers by the names of the options; None for those to ask for.
    ask : function that asks a question; None to take the defaults.
    """
    check_ending(path, (".yaml", ".yml"))
    check_writable(path)
    if os.path.lexists(path) and not force:
        raise FileError(path, "exists; give another name, or --force to overwrite it")
    answers = _Answers(given, ask, Path(path).parent)
    body, advice = _TEXTS[kind](answers, path)
    typed = shlex.quote(path)
    head = (
        f"# yaml-language-server: $schema={schema_file(kind).as_uri()}\n"
        f"# Editors with a YAML language server complete and check this file by the line above.\n"
        f"# Check it: stiffopt check {printable(typed)}\n"
        f"format: {format_of(kind)}\n"
    )
    _write_checked(path, head + textwrap.dedent(body).lstrip("\n"), answers)
    write_line(f"{path}: written. Next:")
    for line in advice:
        write_line(f"  {line}")


class _Robot(NamedTuple):
    """A robot: its name for a command line, its name for a file, and its model."""

    typed: str
    written: str
    model: Any


class _Answers:
    """Answers to questions, given as options or asked for."""

    def __init__(self, given: Mapping[str, Any], ask: Ask | None, folder: Path) -> None:
        self._given, self._ask, self._folder = given, ask, folder

    def option_of(self, key: str) -> str:
        """Return the option that gave the value of a key; empty if none did."""
        name = next((name for name, end in _KEYS.items() if key.endswith(end)), "")
        return _option(name) if self._given.get(name) is not None else ""

    def text(
        self,
        name: str,
        question: str,
        default: object,
        check: Callable[[str], str] = lambda text: text,
    ) -> str:
        """Return an answer as text; `check` returns it or raises `InputError`."""
        given = self._given.get(name)
        if given is not None or self._ask is None:
            return check(str(default if given is None else given))
        while True:
            answer = self._ask(question, str(default))
            try:
                return check(answer)
            except InputError as error:
                if answer == str(default):
                    raise
                report_error(str(error).removeprefix(f"{_option(name)}: "))

    def quantity(self, name: str, question: str, default: str, unit: str, what: str) -> str:
        """Return a quantity as it was written."""

        def check(text: str) -> str:
            quantity(_option(name), text, unit, what)
            return text

        return self.text(name, question, default, check)

    def count(self, name: str, question: str, default: int) -> int:
        """Return a positive whole number."""

        def check(text: str) -> str:
            if not text.isdecimal() or int(text) < 1:
                raise InputError(
                    f"{_option(name)}: expected a number such as {default}, not {shown(text)}"
                )
            return text

        return int(self.text(name, question, default, check))

    def choice(self, name: str, question: str, *allowed: str) -> str:
        """Return one of several words, the first by default."""

        def check(text: str) -> str:
            choice(_option(name), text, allowed)
            return text

        return self.text(name, f"{question} ({', '.join(allowed)})", allowed[0], check)

    def direction(self) -> str:
        """Return the direction of a stiffness, three numbers."""
        default = "1, 0, 0"

        def check(text: str) -> str:
            parts = text.strip("[] ").replace(",", " ").split()
            try:
                if len(parts) != 3 or not np.linalg.norm([float(part) for part in parts]) > 0:
                    raise ValueError
            except ValueError:
                raise InputError(
                    f"--direction: expected a direction such as '{default}', not {shown(text)}"
                ) from None
            return f"[{', '.join(parts)}]"

        question = "Direction in which the tip should be stiff"
        return self.text("direction", question, default, check)

    def position(self, name: str, question: str, default: str, *, free: bool = False) -> str:
        """Return three lengths; axes may be `free` if allowed."""

        def check(text: str) -> str:
            parts = [part.strip() for part in text.strip("[] ").split(",")]
            if len(parts) != 3:
                raise InputError(f"{_option(name)}: expected a position such as '{default}'")
            for value in parts:
                if not (free and value == "free"):
                    quantity(_option(name), value, "m", "length")
            return f"[{', '.join(parts)}]"

        return self.text(name, question, default, check)

    def robot(self) -> _Robot:
        """Return a robot."""
        from stiffopt.model.manipulator import Manipulator
        from stiffopt.model.robot_files import load_description

        def check(text: str) -> str:
            load_description(text)
            return text

        given = self.text("robot", f"Robot {_CUSTOM}", "stiff-flop-2", check)
        written = given
        if given.endswith((".yaml", ".yml")) and not os.path.isabs(given):
            written = os.path.relpath(given, self._folder)
        return _Robot(shlex.quote(given), _scalar(written), Manipulator(load_description(given)))


def _scalar(text: str) -> str:
    """Return text as a YAML scalar on one line, quoted where needed."""
    folded = to_yaml({"text": text}).removeprefix("text: ")
    return " ".join(line.strip() for line in folded.splitlines())


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _write_checked(path: str, text: str, answers: _Answers) -> None:
    """Check a text and write it to a file; an existing file stays if the text is invalid."""
    folder = Path(path).absolute().parent  # the draft's relative paths must resolve as the file's
    handle, draft = tempfile.mkstemp(dir=folder, prefix=".", suffix=".yaml")
    try:
        with open(handle, "wb") as stream:
            stream.write(text.encode())
        _, mistakes = check_file(draft)
    finally:
        os.unlink(draft)
    if mistakes:
        first = mistakes[0]
        where = answers.option_of(first.key or "") or first.key or path
        raise InputError(f"{where}: {first.own_reason}; nothing was written")
    write_whole(path, text.encode())


# The kinds of files ------------------------------------------------------------------------------

_GRAVITY = {
    "hanging": ("9.81", "the base is above: z, along the arm, points down"),
    "standing": ("-9.81", "the base is below: z, along the arm, points up"),
    "horizontal": ("", "the arm lies along the horizon: x points up"),
}


def _robot(answers: _Answers, path: str) -> tuple[str, list[str]]:
    segments = answers.count("segments", "Segments in series", 2)
    length = answers.quantity("length", "Length of a segment at rest", "90 mm", "m", "length")
    outer = answers.quantity("outer_radius", "Outer radius", "15 mm", "m", "length")
    inner = answers.quantity(
        "inner_radius", "Radius of the central channel (0 mm: none)", "4.5 mm", "m", "length"
    )
    chambers = answers.count("chambers", "Chambers around a segment", 6)
    channels = answers.count("channels", "Regulators that feed a segment", 3)
    if chambers % channels:
        raise InputError(
            f"--channels: {channels} regulators cannot feed {chambers} chambers alike; change the "
            "key channels in the file for other wirings"
        )
    radius = answers.quantity("chamber_radius", "Radius of a chamber", "2.25 mm", "m", "length")
    offset = answers.quantity(
        "chamber_offset", "Distance of a chamber from the arm's axis", "10.1 mm", "m", "length"
    )
    modulus = answers.quantity(
        "modulus", "Young's modulus of the silicone", "100 kPa", "Pa", "pressure"
    )
    highest = answers.quantity(
        "max_pressure", "Highest pressure that the arm bears", "1.5 bar", "Pa", "pressure"
    )
    mounting = answers.choice("mounting", "Mounting", "weightless", *_GRAVITY)
    each = chambers // channels
    step = 360 / chambers
    angles = [
        channel * 360 / channels + (index - (each - 1) / 2) * step
        for channel in range(channels)
        for index in range(each)
    ]
    groups = [[channel * each + 1 + index for index in range(each)] for channel in range(channels)]
    segment = f"""\
  - length: {length}                    # at rest
    outer_radius: {outer}
    inner_radius: {inner}
    chambers:                         # all alike, round; angles from the x axis about the arm's
      radius: {radius}
      offset: {offset}
      angles: [{", ".join(f"{round(angle, 6):g} deg" for angle in angles)}]
    channels: {groups}    # chambers that each regulator feeds
    material: {{youngs_modulus: {modulus}, poisson_ratio: 0.5, density: 1070 kg/m^3}}
"""
    text = (
        f"name: {_scalar(Path(path).stem)}\n"
        "# The base frame is at the middle of the arm's base; z points along the straight arm.\n"
        f"segments:                             # from the base to the tip\n{segment * segments}"
    )
    if mounting != "weightless":
        along, words = _GRAVITY[mounting]
        vector = (
            f"[0 m/s^2, 0 m/s^2, {along} m/s^2]" if along else "[-9.81 m/s^2, 0 m/s^2, 0 m/s^2]"
        )
        text += f"gravity: {vector}    # {words}\n# tip_mass: 20 g\n"
    text += f"pressure: {{min: 0 bar, max: {highest}, slew: 5 bar/s}}    # gauge; of the arm\n"
    return text, [
        f"stiffopt init task --robot {shlex.quote(path)}     # a task for this arm",
        f"stiffopt map arm {shlex.quote(path)}               # its stiffness along the arm",
        "measure lengths and radii of your arm and correct them in the file;",
        "`stiffopt calibrate --help`: how the moduli are found from recordings",
    ]


def _task(answers: _Answers, path: str) -> tuple[str, list[str]]:
    name, written, robot = answers.robot()
    position = answers.position(
        "position", "Tip position in the base frame", _middle(robot), free=True
    )
    direction = answers.direction()
    text = f"""
    robot: {written}
    target:
      position: {position}    # of the tip, in the base frame; an axis may be `free`
      # pointing: [0, 0, 1]                # where the tip's axis should point
    stiffness:
      maximise: {{direction: {direction}}}    # newtons for each metre of displacement that way
    """
    return text, [
        f"solve-pressure {shlex.quote(path)} --plot {shlex.quote(Path(path).stem)}.png",
        f"stiffopt init path --robot {name}    # a path for the tip",
    ]


def _path(answers: _Answers, path: str) -> tuple[str, list[str]]:
    _, written, robot = answers.robot()
    begin = answers.position("from", "Start of the line", _middle(robot, -0.06))
    end = answers.position("to", "End of the line", _middle(robot, 0.06))
    speed = answers.quantity("speed", "Speed of the tip", "10 mm/s", "m/s", "speed")
    direction = answers.direction()
    text = f"""
    robot: {written}
    path:
      line: {{from: {begin}, to: {end}}}    # or arc, circle, spline, through, csv
    spacing: 1 mm
    timing: {{speed: {speed}}}               # or {{fastest: true}}
    tolerance: {{position: 0.5 mm}}
    stiffness:
      maximise: {{direction: {direction}, over: worst}}    # or over: mean
    """
    return text, [f"stiffopt path {shlex.quote(path)} --plot {shlex.quote(Path(path).stem)}.png"]


def _scene(answers: _Answers, path: str) -> tuple[str, list[str]]:
    *_, robot = answers.robot()
    clearance = answers.quantity(
        "clearance", "Distance that the whole arm keeps from objects", "2 mm", "m", "length"
    )
    least = quantity("--clearance", clearance, "m", "length")
    away = max(segment.outer_radius for segment in robot.description.segments) + least + 0.02
    text = f"""
    clearance: {clearance}    # that the whole body keeps, with its radius
    objects:
      - name: post
        sphere:
          centre: [0 mm, {_mm(away)}, {_mm(robot.length / 2)}]
          radius: 5 mm
      # or capsule, cylinder {{from, to, radius}}, box {{centre, size}}, mesh {{file}},
      # half_space {{point, normal}}, inside_tube {{points, radius}},
      # trocar {{centre, axis, radius}}
    """
    return text, [f"name it in a task, path or rig file:  scene: {_scalar(path)}"]


def _rig(answers: _Answers, path: str) -> tuple[str, list[str]]:
    _, written, robot = answers.robot()
    supply = answers.choice("supply", "Regulators", *_SUPPLIES)
    devices = ["simulated"] if supply == "simulated" else ["aurora", "openigtlink"]
    tracker = answers.choice("tracker", "Tracker", *devices, "none")
    n = robot.n_pressures
    text = f"robot: {written}\nrate: 100 Hz\nsupply:\n{_SUPPLIES[supply](n)}"
    if tracker != "none":
        text += f"tracker:\n{_TRACKERS[tracker]}"
    slew = "" if robot.description.pressure_slew else "max_slew: 5 bar/s, "  # the arm's is unknown
    text += f"safety: {{{slew}tracker_timeout: 0.5 s}}    # what may happen; what is a fault\n"
    text += "log: {folder: runs}\n"
    if supply == "simulated":
        text += "# how the simulated arm differs from its robot file\n"
        text += "plant: {seed: 1, spread: {gain: 3 %, modulus: 5 %}}\n"
        return text, [f"stiffopt run {shlex.quote(path)} --task my-task.yaml --arm"]
    return text, [
        "put in the addresses and ranges of your devices; rig/ has examples with their wiring",
        f"stiffopt lab {shlex.quote(path)}     # rehearse with a virtual arm behind these devices",
    ]


def _modbus(n: int) -> str:
    lines = "".join(f"    - {{setpoint: {2048 + k}, reading: {k}}}\n" for k in range(n))
    return (
        "  driver: modbus\n"
        "  tcp: {host: 192.168.1.10, port: 502}\n"
        "  # counts and pressures of the regulators, at two points\n"
        "  scale: {counts: [0, 32767], pressure: [0 bar, 10 bar]}\n"
        "  table: holding\n"
        f"  channels:                            # register addresses, counted from 0\n{lines}"
        "  dump_valve: {coil: 0, energised: closed}    # empties the arm without power\n"
        "  # watchdog: the device's own; without one or a dump valve the arm is not armed\n"
    )


def _nidaq(n: int) -> str:
    lines = "".join(
        f"    - output: {{channel: Dev1/ao{k}, volts: [0 V, 10 V], pressures: [0 bar, 3 bar]}}\n"
        f"      input: {{channel: Dev1/ai{k}, volts: [0 V, 10 V], pressures: [0 bar, 3 bar]}}\n"
        for k in range(n)
    )
    return (
        "  driver: nidaq\n  timeout: 200 ms    # well below safety.command_timeout\n"
        f"  channels:\n{lines}"
        "  # empties the arm without power\n"
        "  dump_valve: {line: Dev1/port0/line0, closed_when: high}\n"
    )


def _open_regulator(n: int) -> str:
    lines = "".join(f"    - {{output: {k + 1}}}\n" for k in range(n))
    return (
        "  driver: open-regulator\n"
        "  port: /dev/ttyUSB0                   # better: /dev/serial/by-id/...\n"
        "  board: 1                             # another one is refused\n"
        f"  channels:                            # outputs of the board\n{lines}"
    )


_SUPPLIES = {
    "simulated": lambda _: "  driver: simulated\n",
    "modbus": _modbus,
    "nidaq": _nidaq,
    "open-regulator": _open_regulator,
}
_REGISTRATION = """\
  registration:                        # where the tracker and its sensor are: measure both
    tracker_in_base: {position: [0 mm, 0 mm, 0 mm], orientation: [1, 0, 0, 0]}
    tip_in_sensor: {position: [0 mm, 0 mm, 0 mm], orientation: [1, 0, 0, 0]}
"""
_TRACKERS = {
    "simulated": "  driver: simulated\n",
    "aurora": f"  driver: aurora\n  port: /dev/ttyUSB0\n{_REGISTRATION}",
    "openigtlink": (
        "  driver: openigtlink\n  host: 127.0.0.1\n  port: 18944\n  name: TipToTracker\n"
        f"  latency: 25 ms\n{_REGISTRATION}"
    ),
}
_TEXTS: dict[str, Callable[[_Answers, str], tuple[str, list[str]]]] = {
    "robot": _robot,
    "task": _task,
    "path": _path,
    "scene": _scene,
    "rig": _rig,
}


def _middle(robot: Any, aside: float = 0.0) -> str:
    """Return a position in the middle of the workspace, in mm, shifted along y.

    `aside`: the shift, as a share of the arm's length.
    """
    lower, upper = (np.array(limit) for limit in (robot.pressure_min, robot.pressure_max))
    share = np.resize([0.5, 0.25, 0.15], robot.n_pressures)
    tip = robot.tip_pose(lower + share * (upper - lower))[:3, 3]
    tip[1] += aside * robot.length
    return ", ".join(_mm(round(value, 3)) for value in tip)


def _mm(value: float) -> str:
    return format_quantity(float(round(value, 4) + 0.0), "m", "mm")
