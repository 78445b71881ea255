"""The documentation is true: its examples load, it names every key, its links lead somewhere."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

import stiffopt
from stiffopt.model.description import (
    Chambers,
    Compensation,
    Material,
    PressureLimits,
    RobotDescription,
    Segment,
)
from stiffopt.optimise.goal import MatchMatrix, MatchValue, StiffnessGoal
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import Load, PressureRange, Task

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
SCHEMAS: list[type[BaseModel]] = [
    *(RobotDescription, Segment, Chambers, Material, Compensation, PressureLimits),
    *(Task, Target, Tolerance, StiffnessGoal, MatchValue, MatchMatrix, Load, PressureRange),
]


def yaml_examples() -> list[object]:
    """Return every YAML block of the pages that is a whole file."""
    found: list[object] = []
    for page in PAGES:
        blocks = re.findall(r"^```yaml\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
        found += [
            pytest.param(block, id=f"{page.name}-{number}")
            for number, block in enumerate(blocks, start=1)
        ]
    return found


@pytest.mark.parametrize("text", yaml_examples())
def test_yaml_example_loads(text: str, tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    path.write_text(text, encoding="utf-8")
    if "stiffopt-robot/" in text:
        robot = stiffopt.load_robot(path)
        assert robot.tip_pose([0.0] * robot.n_pressures).shape == (4, 4)
    elif "stiffopt-task/" in text:
        task = stiffopt.load_task(path)
        lower, upper = task.pressure_bounds(task.resolve_robot())
        assert (lower < upper).all()
    else:
        pytest.fail(f"a YAML example that says nothing of its format:\n{text}")


@pytest.mark.parametrize("schema", SCHEMAS, ids=lambda schema: schema.__name__)
def test_files_page_names_every_key(schema: type[BaseModel]) -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    keys = {name for name, info in schema.model_fields.items() if not info.exclude}
    missing = {key for key in keys if not re.search(rf"[`.]{key}[`.]", page)}
    assert not missing, f"docs/files.md does not describe {sorted(missing)}"


def solve_pressure(*arguments: str) -> str:
    command = Path(sys.executable).with_name("solve-pressure")
    done = subprocess.run(
        [command, *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_command_page_names_every_option() -> None:
    page = (ROOT / "docs" / "command.md").read_text(encoding="utf-8")
    options = set(re.findall(r"^  (?:-\w, )?(--\w+)", solve_pressure("--help"), re.M))
    assert {"--json", "--plot", "--help"} <= options
    missing = {option for option in options if f"`{option}" not in page}
    assert not missing, f"docs/command.md does not describe {sorted(missing)}"


def test_command_page_names_every_key_of_the_json() -> None:
    page = (ROOT / "docs" / "command.md").read_text(encoding="utf-8")
    line = solve_pressure("problems/two_segment_stiff_x.yaml", "--json", "--pareto", "2")
    answer = json.loads(line)
    nested = [answer["confidence"], answer["sensitivities"], answer["pareto"][0]]
    keys = set(answer).union(*nested)
    missing = {key for key in keys if f"`{key}`" not in page}
    assert not missing, f"docs/command.md does not describe {sorted(missing)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+://", target):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file) if file else page
        assert path.exists(), f"{page.name} links to {target}"
        if anchor:
            assert anchor in headings(path), f"{page.name} links to {target}"


def headings(page: Path) -> set[str]:
    """Return the anchors of a page's headings, formed as GitHub forms them."""
    lines = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.*)$", lines, re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
