"""Names of the project: one class for one name, and what users see is explained."""

import ast
import dataclasses
import inspect
import pkgutil
import re
from collections import defaultdict
from importlib import import_module
from pathlib import Path

import stiffopt

SOURCE = Path(stiffopt.__file__).parent


def test_no_two_classes_share_a_name():
    places = defaultdict(list)
    for file in sorted(SOURCE.rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(file.relative_to(SOURCE)))
    assert len(places) > 300
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


ELSEWHERE = {"LogRow", "Twist", "Wrench"}  # explained as a `Log`, and by their methods


def test_help_explains_each_field_of_what_packages_export():
    """With shapes and units: comments beside fields are not in ``help()``."""
    names = [module.name for module in pkgutil.iter_modules(stiffopt.__path__) if module.ispkg]
    packages = [stiffopt, *(import_module(f"stiffopt.{name}") for name in names)]
    found, missing = set(), set()
    for package in packages:
        for name in getattr(package, "__all__", ()):
            kind = getattr(package, name)
            if inspect.isclass(kind) and dataclasses.is_dataclass(kind) and name not in ELSEWHERE:
                found.add(name)
                words = set(re.findall(r"\w+", inspect.getdoc(kind) or ""))
                fields = {each.name for each in dataclasses.fields(kind)}
                missing |= {f"{name}.{each}" for each in fields - words if each[0] != "_"}
    assert len(found) > 10
    assert missing == set()


def test_the_glossary_has_one_row_for_a_term_and_places_that_exist():
    root = Path(__file__).parents[1]
    page = root / "docs" / "glossary.md"
    terms, places = [], []
    for line in page.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0] != "---" and cells[1] != "meaning":
            terms += cells[0].split(", ")
            places += re.findall(r"`([^`]+)`", cells[-1])
    assert len(terms) > 150
    assert {term for term in terms if terms.count(term) > 1} == set()
    folders = [place.replace("stiffopt", ".", 1).replace("..", "") for place in places]
    known = [[*SOURCE.glob(folder), *root.glob(folder)] for folder in folders]
    assert [place for place, files in zip(places, known, strict=True) if not files] == []
