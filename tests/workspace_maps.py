"""What the tests of maps share: a robot, a whole map, and blocks that are small."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

import stiffopt
from conftest import is_long
from stiffopt.model.manipulator import Manipulator
from stiffopt.workspace import WorkspaceMap
from stiffopt.workspace.plan import TUNING

BLOCK = TUNING.block if is_long() else TUNING.block // 8


@pytest.fixture(autouse=True, scope="module")
def _blocks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stiffopt.workspace.plan.TUNING", replace(TUNING, block=BLOCK))
        yield


@pytest.fixture(name="robot", scope="module")
def robot_fixture() -> Manipulator:
    return stiffopt.load_robot("stiff-flop-1")


def assert_same(one: WorkspaceMap, other: WorkspaceMap) -> None:
    """Require that two maps agree to the last bit."""
    assert one.lost == other.lost
    assert one.low.tobytes() == other.low.tobytes()
    assert one.high.tobytes() == other.high.tobytes()
    for name, column in one.table.arrays.items():
        same = other.table.arrays[name]
        assert column.dtype == same.dtype, name
        assert column.shape == same.shape, name
        assert column.tobytes() == same.tobytes(), name


class Stop(Exception):  # noqa: N818
    pass


def _raise_at(sample: int) -> Any:
    def report(done: int, total: int) -> None:
        if done >= sample:
            raise Stop

    return report
