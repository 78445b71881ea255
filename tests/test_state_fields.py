"""Each field of the loop's state is defined once: a new line in one file is seen everywhere.

Run as a program, this writes the table of the fields into docs/daemon-api.md.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from stiffopt.control.state import Snapshot, Timing
from stiffopt.control.state_fields import entries

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs" / "daemon-api.md"
BEGIN, END = "<!-- fields of the state -->\n", "<!-- end of the fields -->\n"


def table() -> str:
    """Return the fields of the state as Markdown."""
    rows = ["| field | is | topic | metric |", "| --- | --- | --- | --- |"]
    for prefix, record in (("", Snapshot), ("timing.", Timing)):
        for entry in entries(record):
            names = ", ".join(f"`{prefix}{name}`" for name in entry.json)
            shown, size = entry.shown, f" [{entry.shown.size}]" if entry.shown.size else ""
            topic = f"`{shown.topic}`" if shown.topic else ""
            if topic and entry.key not in entry.json:
                topic += f" `{entry.key}`"
            metric = shown.metric + ("_total" if shown.metric in ("ticks", "overruns") else "")
            label = f'{{kind="{shown.label}"}}' if shown.label else ""
            metric = f"`stiffopt_{metric}{label}`" if metric else ""
            if names:
                rows.append(f"| {names}{size} | {shown.about} | {topic} | {metric} |")
    return "\n".join(rows) + "\n"


def test_the_docs_have_every_field() -> None:
    text = DOCS.read_text()
    inside = text.partition(BEGIN)[2].partition(END)[0]
    assert inside == table(), "run 'python tests/test_state_fields.py'"


CHILD = """
import importlib.util, json, sys
from pathlib import Path

sys.path.insert(0, {tests!r})
folder = Path({folder!r})
import stiffopt.control
there = Path(stiffopt.control.__path__[0], "state.py").read_text()
last = "    samples: tuple[PoseSample, ...] = ()\\n"
assert there.count(last) == 1
line = '''    mood: Annotated[float, Shown("how it feels", "m", topic="/tip", metric="mood_meters",
        row="mood", armed_only=False, line=True)] = 0.25
    wet: Annotated[bool, Shown("whether it is wet", topic="/tip", metric="wet", row="wet",
        armed_only=False, line=True)] = True
    open: Annotated[Flags, Shown("open valves", topic="/tip", metric="open_valves", row="open",
        armed_only=False)] = field(default_factory=lambda: np.arange(6) < 2)
    volts: Annotated[tuple[float, ...], Shown("of its batteries", "V", topic="/tip",
        row="volts", armed_only=False)] = (1.5, 9.0)\\n'''
(folder / "state.py").write_text(there.replace(last, line + last))
spec = importlib.util.spec_from_file_location("stiffopt.control.state", folder / "state.py")
module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

import numpy as np
from rich.console import Console
from made_runs import BEGIN, FakeLoop as FakeRun, ticks
from fake_loop import FakeLoop
from stiffopt.cli.run_display import Lines, status
from stiffopt.daemon.client import Client
from stiffopt.daemon.metrics import Metrics
from stiffopt.daemon.run_log import read_run
from stiffopt.daemon.service import create_app
from stiffopt.daemon.server import Server
from stiffopt.daemon.topics import topic_schemas
from stiffopt.model.robot_files import load_description
from test_state_fields import table
from test_telemetry import recorded

loop = FakeLoop()
app = create_app(loop, robot=load_description("stiff-flop-2"), token="x" * 20)
assert "mood_m" in app.openapi()["components"]["schemas"]["StateReport"]["properties"]
server = Server(app)
server.start()
with Client(server.url) as client, client.stream(rate=50) as stream:
    assert client._ask("GET", "state")["mood_m"] == 0.25
    assert client.state().mood == 0.25
    assert stream.state().mood == 0.25
    assert stream.state().wet is True and stream.state().volts == (1.5, 9.0)
    assert stream.state().open.tolist() == loop.now.open.tolist()
server.stop()
assert topic_schemas()["/tip"]["properties"]["mood_m"] == dict(type="number")
run = read_run(recorded(folder, FakeRun(), ticks(5)))
np.testing.assert_array_equal(run.mood, 0.25)
assert run.wet.all() and (run.open == loop.now.open).all() and len(run.open) == len(run)
again = next(run.snapshots())
assert again.mood == 0.25 and again.wet is True
assert b'stiffopt_mood_meters{{rig="a rig"}} 0.25' in Metrics("a rig", loop).render()
assert b'stiffopt_open_valves{{channel="2",rig="a rig"}} 1.0' in Metrics("a rig", loop).render()
console = Console(width=100)
with console.capture() as captured:
    console.print(status(loop.now, "a rig", list("abcdef")))
lines = [" ".join(line.split()) for line in captured.get().splitlines()]
for row in ("mood 250.00 mm", "wet yes", "open 1, 2", "volts (1.500, 9.000) V"):
    assert row in lines
assert "| `mood_m` | how it feels | `/tip` | `stiffopt_mood_meters` |" in table()
Lines(as_json=True).update(loop.now, [])
"""


def test_a_new_field_is_a_line_in_one_file(tmp_path: Path) -> None:
    script = CHILD.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert '"mood_m": 0.25' in done.stdout


if __name__ == "__main__":
    before, _, rest = DOCS.read_text().partition(BEGIN)
    DOCS.write_text(before + BEGIN + table() + END + rest.partition(END)[2])
