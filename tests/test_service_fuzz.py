"""The control interface under requests made from its own schema: schemathesis.

No request makes the daemon fail, all answers are as the schema says, and one that is refused
changes nothing.
"""

from __future__ import annotations

from typing import Any

import hypothesis
import pytest
import schemathesis
from schemathesis import GenerationMode
from schemathesis.checks import (
    content_type_conformance,
    not_a_server_error,
    response_schema_conformance,
    status_code_conformance,
)
from schemathesis.config import GenerationConfig, ProjectConfig, ProjectsConfig, SchemathesisConfig

from fake_loop import FakeLoop, ManualClock
from stiffopt.daemon.service import create_app
from stiffopt.model.robot_files import load_description

TOKEN = "a-secret-of-the-tests"
EXAMPLES = 15  # of each call, valid and invalid ones
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]

LOOP = FakeLoop()
CLOCK = ManualClock()
APP = create_app(
    LOOP,
    robot=load_description("stiff-flop-2"),
    token=TOKEN,
    clock=CLOCK,
    hosts=["testserver"],  # so schemathesis calls what it tests in this process
)


def fuzzed_schema() -> Any:
    generation = GenerationConfig(
        deterministic=True,
        max_examples=EXAMPLES,
        with_security_parameters=False,  # the token and the lease come from the test
        database="none",
    )
    config = SchemathesisConfig(
        projects=ProjectsConfig(default=ProjectConfig(generation=generation))
    )
    return schemathesis.openapi.from_asgi("/openapi.json", APP, config=config)


SCHEMA = fuzzed_schema()


SEEN: dict[str, set[int]] = {}


def standing() -> Any:
    holder = APP.state.operations.lease.holder
    return list(LOOP.names), LOOP.now, holder


OPERATIONS = {found.ok().label: found.ok() for found in SCHEMA.get_all_operations()}


def requests(label: str) -> Any:
    """Requests that the schema allows, and where it forbids any, those too."""
    operation = OPERATIONS[label]
    good = operation.as_strategy(generation_mode=GenerationMode.POSITIVE)
    good = hypothesis.strategies.one_of(good, *operation.get_strategies_from_examples())
    if not operation.body and not operation.query:
        return good
    return good | operation.as_strategy(generation_mode=GenerationMode.NEGATIVE)


@pytest.mark.parametrize("label", sorted(OPERATIONS))
def test_no_request_does_harm(label: str) -> None:
    @hypothesis.given(case=requests(label))
    @hypothesis.settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    def ask(case: schemathesis.Case) -> None:
        does_no_harm(case)

    ask()


def does_no_harm(case: schemathesis.Case) -> None:
    lease = APP.state.operations.lease
    wants_control = case.operation.label == "POST /v1/lease"
    if lease.holder is None and not wants_control:
        lease.take("planner")
    elif lease.holder is not None and wants_control:
        lease.release(lease._grant.identity)
    before = standing()
    headers = {"Authorization": f"Bearer {TOKEN}"}
    if lease.holder is not None:
        headers["Stiffopt-Lease"] = lease._grant.identity
    response = case.call(headers=headers)
    case.validate_response(response, checks=CHECKS)
    if response.status_code >= 400:
        assert standing() == before
    SEEN.setdefault(case.operation.label, set()).add(response.status_code // 100)


def test_there_were_good_and_bad_requests() -> None:
    """Else the test above, which must have run, shows nothing."""
    assert [name for name, answers in SEEN.items() if 2 not in answers] == []
    for name in ("lease", "target", "task", "trajectory", "channels", "hold"):
        assert SEEN[f"POST /v1/{name}"] == {2, 4}, name
