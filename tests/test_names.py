"""Names of the project: one class for one name."""

import ast
from collections import defaultdict
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
