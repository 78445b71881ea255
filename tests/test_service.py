"""The control interface: who may do what, what is refused, and that refusing changes nothing."""

from __future__ import annotations

import asyncio
import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from fake_control import Hang
from fake_loop import FakeLoop, ManualClock
from running import wait_for
from simulated_loop import Lab
from stiffopt.control.state import Alarm, State
from stiffopt.daemon.messages import MAX_WAYPOINTS
from stiffopt.daemon.service import create_app
from stiffopt.errors import CommandError, DeviceError, InputError
from stiffopt.model.robot_files import load_description

TOKEN = "a-secret-of-the-tests"
ROBOT = load_description("stiff-flop-2")
TARGET = {"position_m": [0.0, None, 0.2]}
TASK_FILE = """
format: stiffopt-task/1
robot: stiff-flop-2
target: {position: [10 mm, free, 190 mm]}
stiffness: {maximise: {direction: [1, 0, 0]}}
"""


class Api:
    """Requests to an application in this process, with what a well-behaved client sends."""

    def __init__(self, loop: Any = None, **options: Any) -> None:
        self.loop = loop or FakeLoop()
        self.clock = ManualClock()
        given = {"robot": ROBOT, "token": TOKEN, "clock": self.clock, "heartbeat": 1.0, **options}
        self.app = create_app(self.loop, **given)
        self.operations = self.app.state.operations
        self.lease: str | None = None

    def __call__(self, *request: Any, **options: Any) -> httpx.Response:
        """Wait for the answer of `ask`."""
        return asyncio.run(self.ask(*request, **options))

    async def ask(
        self,
        method: str,
        path: str,
        body: Any = None,
        token: str | None = TOKEN,
        headers: dict[str, str] | None = None,
        content: bytes | None = None,
    ) -> httpx.Response:
        sent = {} if token is None else {"Authorization": f"Bearer {token}"}
        if self.lease is not None:
            sent["Stiffopt-Lease"] = self.lease
        if content is not None:
            sent["Content-Type"] = "application/json"
        transport = httpx.ASGITransport(self.app, raise_app_exceptions=False)
        async with httpx.AsyncClient(
            transport=transport, base_url="http://127.0.0.1:8470", trust_env=False
        ) as http:
            return await http.request(
                method, path, json=body, content=content, headers={**sent, **(headers or {})}
            )

    def take(self, client: str = "planner") -> httpx.Response:
        answer = self("POST", "/v1/lease", {"client": client})
        if answer.is_success:
            self.lease = answer.json()["lease"]
        return answer


@pytest.fixture
def api() -> Api:
    return Api()


@pytest.fixture
def pilot(api: Api) -> Api:
    """One who has control."""
    assert api.take().status_code == 200
    return api


@pytest.fixture(scope="module")
def idle() -> Api:
    """One who has control, for requests that change nothing."""
    api = Api()
    assert api.take().status_code == 200
    return api


def refused(answer: httpx.Response, status: int, text: str = "") -> None:
    assert answer.status_code == status, answer.text
    error = answer.json()["error"]
    assert set(error) == {"code", "message"}
    assert text in error["message"]


# Reading ----------------------------------------------------------------------------------------


def test_the_state_needs_no_token_and_has_null_for_the_unknown(api: Api) -> None:
    alarm = Alarm("disk", "the disk is full", 3.0)
    api.loop.now = replace(
        api.loop.now, alarms=(alarm,), stiffness=42.0, target_position=np.array([0, np.nan, 0.2])
    )
    answer = api("GET", "/v1/state", token=None)
    assert answer.status_code == 200
    state = json.loads(answer.text, parse_constant=pytest.fail)  # no NaN, no Infinity
    assert state["state"] == "inactive"
    assert state["measured_pa"] == [1.0, 2.0, None, 4.0, 5.0, 6.0]
    assert state["seen_age_s"] is None
    assert state["target_position_m"] == [0.0, None, 0.2]
    assert state["target_pointing"] is None
    assert (state["stiffness_n_per_m"], state["stiffness_nm_per_rad"]) == (42.0, None)
    assert state["alarms"] == [{"kind": "disk", "text": "the disk is full", "since_s": 3.0}]
    assert state["lease"] is None


def test_a_stiffness_against_rotation_has_its_own_name(api: Api) -> None:
    api.loop.now = replace(api.loop.now, stiffness=0.3, stiffness_unit="N*m/rad")
    state = api("GET", "/v1/state").json()
    assert (state["stiffness_n_per_m"], state["stiffness_nm_per_rad"]) == (None, 0.3)


def test_events_are_handed_out_from_where_one_left_off(api: Api) -> None:
    answer = api("GET", "/v1/events", token=None).json()
    assert [event["kind"] for event in answer["events"]] == ["armed", "tracker-missing"]
    assert answer["events"][1]["severity"] == "warning"
    assert answer["next"] == 2
    assert api("GET", "/v1/events?since=2").json() == {"events": [], "next": 2}
    refused(api("GET", "/v1/events?since=-1"), 422, "since")


def test_the_robot_says_what_may_be_commanded(api: Api) -> None:
    robot = api("GET", "/v1/robot", token=None).json()
    assert robot["name"] == ROBOT.name
    assert robot["n"] == 6
    assert robot["channels"][3] == "segment 2 channel 1"
    assert robot["high_pa"] == [1.5e5] * 6


def test_metrics_are_there_if_somebody_makes_them() -> None:
    answer = Api(metrics=lambda: b"ticks 3\n")("GET", "/metrics", token=None)
    assert answer.text == "ticks 3\n"
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    refused(Api()("GET", "/metrics"), 404)


def test_the_page_shows_every_call_and_needs_no_network(api: Api) -> None:
    paths = api("GET", "/openapi.json", token=None).json()["paths"]
    for place in ("/", "/docs"):
        page = api("GET", place, token=None)
        assert page.headers["content-type"].startswith("text/html")
        for path, item in paths.items():
            for method in item:
                assert f"{method.upper()} {path}" in page.text
        for outside in ("http:", "https:", "//cdn", "<script", "src="):
            assert outside not in page.text


# Who may ------------------------------------------------------------------------------------------

COMMANDS = [
    ("POST", "/v1/arm", None),
    ("POST", "/v1/disarm", None),
    ("POST", "/v1/reset", None),
    ("POST", "/v1/hold", None),
    ("POST", "/v1/channels", {"without": [2]}),
    ("POST", "/v1/target", TARGET),
    ("POST", "/v1/task", {"target": TARGET}),
    ("POST", "/v1/trajectory", {"waypoints": [{"time_s": 1, "target": TARGET}]}),
]
CONTROL = [
    ("POST", "/v1/lease", {"client": "x"}),
    ("POST", "/v1/lease/renew", None),
    ("DELETE", "/v1/lease", None),
]
VENT = ("POST", "/v1/vent", None)


@pytest.mark.parametrize(("method", "path", "body"), [*COMMANDS, *CONTROL, VENT])
def test_nothing_but_reading_goes_without_the_token(
    idle: Api, method: str, path: str, body: Any
) -> None:
    answer = idle(method, path, body, token=None)
    refused(answer, 401, "token")
    assert answer.headers["www-authenticate"] == "Bearer"
    refused(idle(method, path, body, token="another"), 403, "not this daemon's token")
    refused(idle(method, path, body, token=None, headers={"Authorization": "Basic x"}), 401)
    refused(idle(method, path, content=b"{", token=None), 401)  # before the body is looked at
    assert idle.loop.calls == []
    assert idle.operations.lease.holder.client == "planner"


def test_every_call_that_is_not_reading_is_among_those_tested(api: Api) -> None:
    paths = api("GET", "/openapi.json").json()["paths"]
    there = {(m.upper(), path) for path, item in paths.items() for m in item if m != "get"}
    assert there == {(method, path) for method, path, _ in [*COMMANDS, *CONTROL, VENT]}


@pytest.mark.parametrize(("method", "path", "body"), COMMANDS)
def test_no_command_goes_without_control(api: Api, method: str, path: str, body: Any) -> None:
    refused(api(method, path, body), 409, "needs control")
    api.lease = "made up"
    refused(api(method, path, body), 409, "do not have control")
    assert api.loop.calls == []


@pytest.mark.parametrize(("method", "path", "body"), COMMANDS)
def test_with_token_and_control_the_loop_is_asked(
    pilot: Api, method: str, path: str, body: Any
) -> None:
    answer = pilot(method, path, body)
    assert answer.status_code == 200, answer.text
    name = {"trajectory": "follow_trajectory"}
    name |= {word: f"set_{word}" for word in ("target", "task", "channels")}
    word = path.removeprefix("/v1/")
    assert pilot.loop.names == [name.get(word, word)]
    assert answer.json()["state"] == pilot.loop.now.state


def test_venting_needs_the_token_but_no_control(pilot: Api) -> None:
    pilot.lease = None
    assert pilot("POST", "/v1/vent").status_code == 200
    assert pilot("POST", "/v1/vent", content=b"{not json").status_code == 200  # no time for that
    assert pilot.loop.names == ["vent", "vent"]


def test_two_clients_one_has_control_the_other_reads(pilot: Api) -> None:
    mine, pilot.lease = pilot.lease, None
    refused(pilot.take("other"), 409, "'planner' has control; it ends in 1.00 s")
    assert pilot("GET", "/v1/state").json()["lease"] == {"client": "planner", "expires_in_s": 1.0}
    pilot.lease = mine
    assert pilot("DELETE", "/v1/lease").status_code == 204
    assert pilot.take("other").status_code == 200


@pytest.mark.parametrize("token", ["", "with space", "é", "a\nb"])
def test_a_token_that_protects_nothing_is_refused(token: str) -> None:
    with pytest.raises(InputError, match="token"):
        create_app(FakeLoop(), robot=ROBOT, token=token)


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8470", "localhost", "LOCALHOST:8470", "[::1]:8470", "192.168.1.7:1", "lab.local:9"],
)
def test_requests_to_this_machine_are_answered(host: str) -> None:
    api = Api(hosts=["lab.local"])
    assert api("GET", "/v1/state", headers={"Host": host}).status_code == 200
    headers = {"Host": host, "Origin": f"http://{host}"}
    assert api("POST", "/v1/vent", headers=headers).status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8470", "localhost.evil.example",
                                  "127.0.0.1.evil.example", "", "[::1", "a@b:c"])  # fmt: skip
def test_names_that_a_strangers_name_server_may_hand_out_are_refused(idle: Api, host: str) -> None:
    refused(idle("GET", "/v1/state", headers={"Host": host}), 403, "Host")
    refused(idle("POST", "/v1/vent", headers={"Host": host}), 403, "Host")
    assert idle.loop.calls == []


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:3000", "file://127.0.0.1:8470", ""]
)
def test_pages_of_other_sites_may_not_command(idle: Api, origin: str) -> None:
    refused(idle("POST", "/v1/arm", headers={"Origin": origin}), 403, "other sites")
    assert idle.loop.calls == []


# What is refused --------------------------------------------------------------------------------

BAD_TARGETS = [
    b"",
    b"{",
    b"[1]",
    b"null",
    b"{}",
    b'"position_m"',
    b'{"position_m": [0, 0]}',
    b'{"position_m": [0, 0, NaN]}',
    b'{"position_m": [0, 0, Infinity]}',
    b'{"position_m": [0, 0, 1e999]}',
    b'{"position_m": [0, 0, 1e300]}',
    b'{"position_m": [0, 0, "0.1"]}',
    b'{"position_m": [0, 0, true]}',
    b'{"position_m": [null, null, null]}',
    b'{"position_m": [0, 0, 0.2], "speed": 3}',
    b'{"position_m": [0, 0, 0.2], "sp\\ud800eed": 3}',
    b'{"pointing": [0, 0, 0]}',
    b'{"orientation_wxyz": [1, 1, 0, 0]}',
    b'{"pointing": [0, 0, 1], "orientation_wxyz": [1, 0, 0, 0]}',
    b'{"position_m": [0, 0, 0.2], "tolerance": {"position_m": 0}}',
    b'{"position_m": [0, 0, ' + b"1" * 5000 + b"]}",
    b"[" * 100_000,
    b'\xff\xfe{"position_m": [0, 0, 0.2]}',
]


@pytest.mark.parametrize("content", BAD_TARGETS, ids=lambda c: c[:40].decode("latin-1"))
def test_malformed_targets_are_refused_and_change_nothing(idle: Api, content: bytes) -> None:
    refused(idle("POST", "/v1/target", content=content), 422)
    assert idle.loop.calls == []


def test_json_must_say_that_it_is_json(pilot: Api) -> None:
    """What a web page can send without asking first, plain text, is no command."""
    body = json.dumps(TARGET).encode()
    headers = {"Content-Type": "text/plain"}
    refused(pilot("POST", "/v1/target", content=body, headers=headers), 422)
    assert pilot.loop.calls == []


def test_long_bodies_are_refused_with_and_without_a_length(pilot: Api) -> None:
    long = b" " * 1_000_001
    refused(pilot("POST", "/v1/target", content=long), 413, "longer")
    refused(pilot("POST", "/v1/vent", headers={"Content-Length": "9" * 30}), 413)

    async def parts() -> Any:
        for _ in range(3):
            yield b" " * 400_000

    refused(pilot("POST", "/v1/target", content=parts()), 413, "longer")
    assert pilot.loop.calls == []


def test_trajectories_have_an_end(pilot: Api) -> None:
    def waypoints(n: int) -> dict[str, Any]:
        return {"waypoints": [{"time_s": k, "target": {"position_m": [0, 0, 0]}} for k in range(n)]}

    assert pilot("POST", "/v1/trajectory", waypoints(MAX_WAYPOINTS)).status_code == 200
    assert len(pilot.loop.calls[0][1].waypoints) == MAX_WAYPOINTS
    refused(pilot("POST", "/v1/trajectory", waypoints(MAX_WAYPOINTS + 1)), 422, "waypoints")
    refused(pilot("POST", "/v1/trajectory", waypoints(0)), 422, "waypoints")
    backwards = {"waypoints": [{"time_s": t, "target": TARGET} for t in (1, 1)]}
    refused(pilot("POST", "/v1/trajectory", backwards), 422, "order of time")
    assert len(pilot.loop.calls) == 1


def test_over_pressure_is_refused_with_a_reason(pilot: Api) -> None:
    asked = {"target": TARGET, "pressure": {"max_pa": 2e5}}
    refused(pilot("POST", "/v1/task", asked), 422, "2 bar is beyond the limits of channel 1")
    asked["pressure"] = {"max_pa": [1e5, None, None, None, None, 1.6e5]}
    refused(pilot("POST", "/v1/task", asked), 422, "channel 6")
    asked["pressure"] = {"min_pa": -1e4}
    refused(pilot("POST", "/v1/task", asked), 422, "pressure.min")
    asked["pressure"] = {"max_pa": [1e5]}
    refused(pilot("POST", "/v1/task", asked), 422, "list of 6")
    over = TASK_FILE + "pressure: {max: 2 bar}\n"
    refused(pilot("POST", "/v1/task", {"text": over}), 422, "beyond the limits")
    assert pilot.loop.calls == []


def test_a_task_file_may_be_sent_as_text(pilot: Api) -> None:
    assert pilot("POST", "/v1/task", {"text": TASK_FILE}).status_code == 200
    task = pilot.loop.calls[0][1]
    assert task.target.position == (0.01, None, 0.19)
    assert task.robot == ROBOT.name
    assert task.source is None
    given = pilot("GET", "/v1/task").json()
    assert given["task"]["target"]["position_m"] == [0.01, None, 0.19]
    assert pilot("POST", "/v1/task", given["task"]).status_code == 200  # and back
    assert pilot.loop.calls[1][1] == task
    assert pilot("POST", "/v1/task", {"text": TASK_FILE.replace("robot", "#")}).status_code == 200
    pilot("POST", "/v1/vent")
    assert pilot("GET", "/v1/task").json()["task"] is None


def test_the_text_of_a_task_makes_the_daemon_read_no_file(
    pilot: Api, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("secret: of another user\n")
    texts = [
        TASK_FILE.replace("robot: stiff-flop-2", f"robot: {robot}")
        for robot in (path, "../robot.yaml", "stiff-flop-3", "[1]", "{a: 1}", "1", "/dev/zero")
    ]
    texts += [f"{TASK_FILE}source: {path}\n", str(path), f"!include {path}", f"@{path}", "a: &x 1"]
    opened: list[str] = []
    monkeypatch.setattr("builtins.open", lambda file, *rest, **more: opened.append(str(file)))
    monkeypatch.setattr(Path, "open", lambda self, *rest, **more: opened.append(str(self)))
    for text in texts:
        answer = pilot("POST", "/v1/task", {"text": text})
        refused(answer, 422)
        assert "secret" not in answer.text
    assert opened == []
    assert pilot.loop.calls == []


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({"text": "x" * 70_000}, "text"),
        ({"text": "a: " + "[" * 1000}, "nested"),
        ({"text": ""}, "text"),
        ({"text": TASK_FILE, "target": TARGET}, "target"),
        ({"text": "target: {position: [10, 0, 0]}\nformat: stiffopt-task/1"}, "no unit"),
        ({"target": TARGET, "robot": "stiff-flop-3"}, "not the robot here"),
        ({"target": TARGET, "stiffness": {}}, "asks for nothing"),
        ({"target": TARGET, "stiffness": {"maximise": [{"direction": [0, 0, 0]}]}}, "zero"),
        ({"target": TARGET, "load": {"force_n": [0, 0, 1e9]}}, "out of range"),
    ],
)
def test_tasks_that_make_no_sense_are_refused(idle: Api, body: Any, says: str) -> None:
    refused(idle("POST", "/v1/task", body), 422, says)
    assert idle.loop.calls == []


def test_all_of_a_task_arrives(pilot: Api) -> None:
    body = {
        "target": {"orientation_wxyz": [1, 0, 0, 0], "tolerance": {"angle_rad": 0.1}},
        "stiffness": {
            "at_least": [{"direction": [0, 0, 1], "kind": "rotation", "value": 0.2}],
            "match": {"matrix_n_per_m": [[9, 0, 0], [0, 9, 0], [0, 0, 99]], "frame": "tip"},
        },
        "load": {"force_n": [0, 0, -0.02], "frame": "tip"},
        "pressure": {"min_pa": 1e3, "max_pa": [1e5, None, 1e5, 1e5, 1e5, 1e5]},
    }
    assert pilot("POST", "/v1/task", body).status_code == 200
    task = pilot.loop.calls[0][1]
    assert task.stiffness.at_least[0].value == 0.2
    assert task.stiffness.match.matrix[2][2] == 99
    assert task.load.force == (0, 0, -0.02)
    assert task.pressure.max == (1e5, None, 1e5, 1e5, 1e5, 1e5)
    assert task.target.tolerance.angle == 0.1


@pytest.mark.parametrize("method", ["PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"])
def test_other_methods_and_places_are_not_there(api: Api, method: str) -> None:
    refused(api(method, "/v1/arm"), 405)
    refused(api(method, "/v1/nothing"), 404)


# The loop's answers -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (CommandError("the arm is in fault; reset it first"), 409, "refused"),
        (DeviceError("the supply does not answer"), 409, "refused"),
        (InputError("the target is 12 mm out of reach"), 422, "input"),
        (ZeroDivisionError("oops"), 500, "internal"),
    ],
)
def test_what_the_loop_says_is_passed_on(
    pilot: Api, error: Exception, status: int, code: str
) -> None:
    pilot.loop.refusal = error
    answer = pilot("POST", "/v1/target", TARGET)
    refused(answer, status, "" if status == 500 else str(error))
    assert answer.json()["error"]["code"] == code
    assert "oops" not in answer.text


def test_a_loop_that_does_not_answer_is_given_up_but_may_still_be_vented() -> None:
    api = Api(patience=0.05)
    api.take()
    gate = threading.Event()
    api.loop.gate = lambda name: None if name == "vent" else gate.wait(20) and None

    async def many() -> list[httpx.Response]:
        stuck = [api.ask("POST", "/v1/arm") for _ in range(8)]
        answers = await asyncio.gather(*stuck)
        answers.append(await api.ask("POST", "/v1/arm"))
        answers.append(await api.ask("POST", "/v1/vent"))
        gate.set()
        return answers

    *stuck, busy, vented = asyncio.run(many())
    for answer in stuck:
        refused(answer, 503, "did not answer within 0.05 s")
    refused(busy, 503, "too much to do")
    assert vented.status_code == 200


@pytest.mark.parametrize(
    ("path", "body", "call"),
    [
        ("target", TARGET, "set_target"),
        ("task", {"target": {"position_m": [0.0, 0.0, 0.1]}}, "set_task"),
    ],
)
def test_what_the_loop_has_not_begun_in_time_it_never_does_but_it_vents(
    path: str, body: Any, call: str
) -> None:
    lab = Lab()
    api = Api(lab.loop, robot=lab.rig.robot, patience=0.05)
    api.take()
    lab.controller.accident = busy = Hang("compute")
    stop = threading.Event()
    loop = threading.Thread(target=lab.loop.run, args=(stop,))
    loop.start()
    assert busy.begun.wait(30)
    try:
        refused(api("POST", f"/v1/{path}", body), 503, "0.05 s; it will not do this any more")
        refused(api("POST", "/v1/vent"), 503, "0.05 s; this is done as soon as it can be")
        busy.go_on.set()
        wait_for(lambda: lab.state is State.INACTIVE)
    finally:
        busy.go_on.set()
        stop.set()
        loop.join(60)
    assert call not in lab.controller.calls
    told = [event.text for event in lab.loop.events.since(0)[0]]
    assert "vented: a client asked for it" in told


def test_of_what_was_begun_the_outcome_is_not_known() -> None:
    lab = Lab()
    api = Api(lab.loop, robot=lab.rig.robot, patience=0.05)
    api.take()
    lab.controller.accident = slow = Hang("set_target")
    refused(api("POST", "/v1/target", TARGET), 503, "whether it will still do this is not known")
    slow.go_on.set()
    wait_for(lambda: "set_target" in lab.controller.calls)


def test_a_daemon_that_starts_answers_at_once() -> None:
    lab = Lab(ready=False)
    api = Api(lab.loop, robot=lab.rig.robot, patience=5.0)
    api.take()
    lab.controller.accident = compiling = Hang("check")
    starting = threading.Thread(target=lab.loop.configure)
    starting.start()
    try:
        assert compiling.begun.wait(30)
        for path, body in (("arm", None), ("target", TARGET), ("hold", None)):
            refused(api("POST", f"/v1/{path}", body), 409, "still starting")
        assert api("POST", "/v1/vent").json() == {"state": "unconfigured", "reason": ""}
    finally:
        compiling.go_on.set()
        starting.join(60)
    assert lab.kinds == ["configured"]  # and nothing that was asked for before


# Losing control -----------------------------------------------------------------------------------


def test_a_client_that_is_not_heard_loses_control_and_the_arm_is_held(pilot: Api) -> None:
    pilot("POST", "/v1/arm")
    pilot.clock.time += 0.9
    assert pilot("POST", "/v1/target", TARGET).status_code == 200  # commands are heard
    pilot.clock.time += 0.9
    assert pilot("POST", "/v1/lease/renew").status_code == 204
    pilot.clock.time += 0.9
    asyncio.run(pilot.operations.watch())
    assert pilot.loop.names == ["arm", "set_target"]
    pilot.clock.time += 0.2
    refused(pilot("POST", "/v1/target", TARGET), 409, "control was lost")
    asyncio.run(pilot.operations.watch())
    assert pilot.loop.calls[2:] == [("hold", "nothing was heard from 'planner', which had control")]
    assert pilot.loop.now.state is State.HOLDING
    refused(pilot("POST", "/v1/lease/renew"), 409, "take it first")
    pilot.take("other")
    assert pilot("POST", "/v1/target", TARGET).status_code == 200


def test_a_bad_request_does_not_keep_control(pilot: Api) -> None:
    pilot.clock.time += 0.9
    refused(pilot("POST", "/v1/target", {"position_m": 3}), 422)
    pilot.clock.time += 0.2
    refused(pilot("POST", "/v1/lease/renew"), 409, "control was lost")


def test_the_next_client_gets_control_only_after_the_arm_is_held(pilot: Api) -> None:
    pilot.clock.time += 2
    pilot.loop.gate = lambda name: pilot.loop.calls.append(("waited", name))
    assert pilot.take("other").status_code == 200
    assert pilot.loop.names == ["waited", "hold"]


def test_an_arm_that_cannot_be_held_is_tried_again(
    pilot: Api, caplog: pytest.LogCaptureFixture
) -> None:
    pilot.clock.time += 2
    pilot.loop.refusal = ZeroDivisionError("oops")
    refused(pilot.take("other"), 409, "being held")
    assert "could not be held" in caplog.text
    pilot.loop.refusal = None
    assert pilot.take("other").status_code == 200
    assert pilot.loop.names == ["hold"]


def test_where_there_is_nothing_to_hold_control_is_free_again(pilot: Api) -> None:
    pilot.clock.time += 2
    pilot.loop.refusal = CommandError("the arm is vented")
    assert pilot.take("other").status_code == 200


# The real loop on a simulated rig -----------------------------------------------------------------


def test_the_real_loop_is_commanded_held_when_nobody_is_heard_and_vented() -> None:
    lab = Lab(ready=False)
    api = Api(lab.loop, robot=lab.rig.robot, clock=lab.rig.clock, heartbeat=1.0)
    api.take()
    refused(api("POST", "/v1/target", TARGET), 409, "unconfigured")
    lab.loop.configure()
    for _ in range(6):
        lab.ticks(10)
        api("POST", "/v1/lease/renew")
    assert api("POST", "/v1/arm").json() == {"state": "active", "reason": ""}
    task = {"target": {"position_m": [0.0, 0.0, 0.1]}}
    assert api("POST", "/v1/task", task).status_code == 200
    lab.controller.wanted = np.array([8e4, 4e4, 0.0])
    lab.ticks(90)
    assert lab.world.pressures.max() > 5e4
    asyncio.run(api.operations.watch())
    assert api("GET", "/v1/state").json()["state"] == "active"
    lab.ticks(20)
    asyncio.run(api.operations.watch())
    state = api("GET", "/v1/state").json()
    assert state["state"] == "holding"
    assert "nothing was heard from 'planner'" in state["reason"]
    before = api("GET", "/v1/events").json()
    refused(api("POST", "/v1/target", TARGET), 409, "take it first")
    api.take("other")
    assert api("POST", "/v1/target", TARGET).json()["state"] == "active"
    assert api("POST", "/v1/vent").json()["state"] == "inactive"
    lab.ticks(100)
    assert lab.world.pressures.max() < 1e3
    assert api("GET", f"/v1/events?since={before['next']}").json()["events"]
