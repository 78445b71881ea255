"""The documentation is true: its examples load, it names every key, its links lead somewhere."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

import stiffopt
from examples import run_examples
from made_runs import BEGIN, snapshot
from stiffopt.commissioning.record import CommissioningRecord
from stiffopt.daemon.telemetry import about_run
from stiffopt.daemon.topics import METADATA
from stiffopt.experiments.poses import PosesFile, load_poses
from stiffopt.identify.bench import load_bench
from stiffopt.logs import read_log
from stiffopt.model.calibration import Calibration, ErrorModel, FittedParameter
from stiffopt.model.description import (
    Recordings,
    RegulatorLimits,
    RobotDescription,
    Tolerances,
    TrackedBody,
)
from stiffopt.model.history import Creep, History, Play
from stiffopt.model.obstacles import OBSTACLES
from stiffopt.model.robot_files import load_description
from stiffopt.model.scene import AllowedContact, Scene, SceneObject
from stiffopt.model.segment import Chambers, Compensation, Corrections, Material, Segment
from stiffopt.optimise.brace import Brace
from stiffopt.optimise.goal import MatchMatrix, MatchValue, StiffnessGoal
from stiffopt.optimise.measures.directional import AtLeast
from stiffopt.optimise.press import Press
from stiffopt.optimise.target import Target, Tolerance
from stiffopt.optimise.task import Load, PressureRange, Task
from stiffopt.paths.path import Path as PathDescription
from stiffopt.paths.trajectory import Trajectory, Waypoint
from stiffopt.plant import settings as simulated
from stiffopt.registration import Placement, Registration
from stiffopt.rig.config import (
    LogSettings,
    RigDescription,
    Safety,
    limits_of,
    load_rig_description,
)
from stiffopt.rig.registry import KINDS, driver_class, driver_names
from stiffopt.rig.settings import (
    CommissioningSettings,
    ControlSettings,
    Published,
    RosSettings,
    ServiceSettings,
)

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "rig/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]


def schemas_of(annotation: Any, package: str) -> Iterator[type[BaseModel]]:
    """Yield the schemas of a package that an annotation speaks of, nested ones too."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if annotation.__module__.startswith(package):
            yield annotation
        for field in annotation.model_fields.values():
            yield from schemas_of(field.annotation, package)
    for inner in get_args(annotation):
        yield from schemas_of(inner, package)


def driver_schemas() -> dict[type[BaseModel], None]:
    """Return the settings of all drivers that come with stiffopt, and all that they are made of."""
    return {
        schema: None
        for kind in KINDS
        for name in driver_names(kind)
        for schema in schemas_of(driver_class(kind, name), "stiffopt.")
    }


SCHEMAS: list[type[BaseModel]] = [
    *(RobotDescription, Segment, Chambers, Material, Compensation, RegulatorLimits),
    *(Corrections, History, Play, Creep, Recordings, TrackedBody, Tolerances),
    *(Calibration, FittedParameter, ErrorModel),
    *(Task, Target, Tolerance, StiffnessGoal, AtLeast, MatchValue, MatchMatrix),
    *(Load, PressureRange, Press, Brace, PosesFile),
    *(Scene, SceneObject, AllowedContact, *OBSTACLES.values()),
    *schemas_of(PathDescription, "stiffopt.paths."),
    *(RigDescription, Safety, LogSettings, Registration, Placement),
    *(ControlSettings, CommissioningSettings, Published, RosSettings, ServiceSettings),
    *(Trajectory, Waypoint),
    *schemas_of(CommissioningRecord, "stiffopt.commissioning."),
    *schemas_of(simulated.PlantSettings, "stiffopt.plant"),
    simulated.LabSettings,
    *driver_schemas(),
]
SECTIONS = {  # of files.md, by how the module of a schema begins; the first that fits
    "stiffopt.commissioning": "Commissioning record",
    "stiffopt.experiments.poses": "Poses",
    "stiffopt.rig.drivers.modbus": "Driver modbus",
    "stiffopt.rig.drivers.nidaq": "Driver nidaq",
    "stiffopt.rig.drivers.aurora": "Drivers aurora and openigtlink",
    "stiffopt.rig.drivers.openigtlink": "Drivers aurora and openigtlink",
    "stiffopt.rig.drivers.open_regulator": "Driver open-regulator",
    "stiffopt.rig.drivers": "Driver probe",
    "stiffopt.rig": "Rig file",
    "stiffopt.plant": "Rig file",
    "stiffopt.registration": "Rig file",
    "stiffopt.model.scene": "Scene file",
    "stiffopt.model.obstacles": "Scene file",
    "stiffopt.model": "Robot file",
    "stiffopt.optimise": "Task file",
    "stiffopt.paths.path": "Path file",
    "stiffopt.paths.shapes": "Path file",
    "stiffopt.paths.trajectory": "Trajectory",
}


def yaml_examples() -> list[object]:
    """Return every YAML block of the pages that is a whole file; an indented one is a part."""
    found: list[object] = []
    for page in PAGES:
        blocks = re.findall(r"^```yaml\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
        found += [
            pytest.param(block, id=f"{page.name}-{number}")
            for number, block in enumerate(blocks, start=1)
            if not block.startswith(" ")
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
    elif "stiffopt-rig/" in text:
        rig = load_rig_description(path)
        robot = stiffopt.load_robot(rig.robot)
        assert limits_of(rig, robot.description).n == robot.n_pressures
    elif "stiffopt-path/" in text:
        followed = stiffopt.load_path(path)
        followed.end_pressures(followed.resolve_robot())
    elif "stiffopt-experiment/" in text:
        assert load_poses(path).pressures
    elif "stiffopt-bench/" in text:
        assert load_bench(str(path))[0].arms[0].train
    elif "stiffopt-scene/" in text:
        stiffopt.load_scene(path).check_against(stiffopt.load_robot("stiff-flop-2").description)
    else:
        pytest.fail(f"a YAML example that says nothing of its format:\n{text}")


@pytest.mark.parametrize("schema", SCHEMAS, ids=lambda schema: schema.__name__)
def test_files_page_names_every_key(schema: type[BaseModel]) -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    title = next(title for begin, title in SECTIONS.items() if schema.__module__.startswith(begin))
    found = re.search(rf"^(#+) {title}\n(.*?)(?=^\1 |^## |\Z)", page, re.M | re.S)
    assert found, title
    fields = schema.model_fields.items()
    keys = {info.alias or name for name, info in fields if not info.exclude}
    if title.startswith("Driver"):
        keys.discard("driver")
    missing = {key for key in keys if not re.search(rf"[`.]{key}[`.]", found[2])}
    assert not missing, f"'{title}' of docs/files.md does not describe {sorted(missing)}"


def test_files_page_names_no_key_that_does_not_exist() -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8").partition("\n## Log\n")[0]
    page = re.sub(r"^### Built-in robots\n.*?(?=^## )", "", page, flags=re.M | re.S)
    cells = re.findall(r"^\| (`.*?) \|", page, re.M)
    named = {key.rpartition(".")[2] for cell in cells for key in re.findall(r"`([^`]+)`", cell)}
    known = {info.alias or name for each in SCHEMAS for name, info in each.model_fields.items()}
    assert len(named) > 200
    assert not named - known


def test_files_page_names_all_that_a_recording_says_of_its_run() -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    (part,) = re.findall(r"^## Recording of a run\n(.*?)(?=^## )", page, re.M | re.S)
    about = about_run(load_description("stiff-flop-1"), "rig", snapshot(BEGIN), BEGIN, 0)
    cells = " ".join(re.findall(r"^\| (`.*?) \|", part, re.M))
    assert set(re.findall(r"`(\w+)`", cells)) == set(about)
    assert all(f"`{name}`" in part for name in (METADATA, about["format"]))


@pytest.mark.filterwarnings("ignore:the simulator is compiled")
def test_rig_page_examples_print_what_stands_below_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert run_examples((ROOT / "docs" / "rig.md").read_text(encoding="utf-8"), "rig.md") == 2


def test_files_page_shows_a_log_that_can_be_read(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```text\n(time_s,.*?)^```", page, re.M | re.S)
    (tmp_path / "log.csv").write_text(example, encoding="utf-8")
    log = read_log(tmp_path / "log.csv")
    assert (log.n, len(log)) == (3, 2)
    for column in log.layout.columns:
        assert f"`{column}`" in page or re.match(r"pm?3_pa", column)


def test_contact_page_example_prints_what_stands_below_it() -> None:
    assert run_examples((ROOT / "docs" / "contact.md").read_text(encoding="utf-8"), "contact.md")


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


def test_the_map_names_every_package() -> None:
    page = (ROOT / "docs" / "map.md").read_text(encoding="utf-8")
    names = {
        path.name for path in (ROOT / "src" / "stiffopt").glob("[!_]*") if path.name != "py.typed"
    }
    missing = {name for name in names if f"`{name}`" not in page}
    assert not missing, f"docs/map.md does not name {sorted(missing)}"


def test_the_site_has_a_place_for_every_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration loads, and each page stands in the table of contents once."""
    docs = ROOT / "docs"
    monkeypatch.setattr(os, "environ", os.environ.copy())  # which the configuration changes
    settings: dict[str, Any] = {"__file__": str(docs / "conf.py"), "__name__": "conf"}
    exec(compile((docs / "conf.py").read_text(encoding="utf-8"), "conf.py", "exec"), settings)
    assert callable(settings["setup"])
    assert settings["html_theme"] == "furo"
    listed = ["index"]
    for page in docs.glob("*.md"):
        for tree in re.findall(
            r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S
        ):
            listed += [line for line in tree.splitlines() if line and not line.startswith(":")]
    listed.remove("auto_gallery/index")  # made of docs/gallery
    assert sorted(listed) == sorted(page.stem for page in docs.glob("*.md"))
