"""Requests to the control loop: when they take effect, and that a refused one changes nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from simulated_loop import Lab
from stiffopt.control.state import State
from stiffopt.control.steering import Move
from stiffopt.errors import DeviceError, GuardTripped
from test_loop_properties import PERIOD, N, World

NONE = np.zeros(N, dtype=bool)


def steered_to(pressures: tuple[float, ...], low: float) -> World:
    """Return an armed loop whose arm has arrived at some pressures."""
    world = World(seed=1, low=low)
    world.loop.configure()
    for _ in range(100):
        world.tick()
    world.loop.arm()
    world.steering.move = lambda now: Move(np.array(pressures), True, NONE)  # type: ignore[method-assign]
    for _ in range(200):
        world.tick()
    assert world.loop.snapshot().state is State.ACTIVE
    np.testing.assert_array_equal(world.supply.set_points, pressures)
    return world


@contextmanager
def served_in_the_next_tick(world: World, request: Callable[[], None]) -> Iterator[None]:
    """Have another thread ask for something that the tick in the body serves."""
    requests = world.loop._requests
    requests.begin()
    client = threading.Thread(target=request)
    client.start()
    while not requests._queue:
        pass
    yield
    client.join()
    requests.end()


@pytest.mark.parametrize(
    ("pressures", "low"),
    [
        ((1.5e5, 0.0, 0.0), 0.0),
        ((1.5e5, 0.0, 0.0), -3e4),
        ((0.0, 1.2e5, -3e4), -3e4),
        ((2e4, 2e4, 1.0e5), 2e4),
    ],
)
def test_disarming_at_a_limit_lets_the_pressures_down(
    pressures: tuple[float, ...], low: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request is served, and its ramp begins, some time after the tick has begun."""
    world = steered_to(pressures, low)
    clock = world.clock

    def creeping() -> float:
        clock.t += 1e-5
        return clock.t

    monkeypatch.setattr(clock, "now", creeping)
    with served_in_the_next_tick(world, world.loop.disarm):
        world.tick()
    assert world.loop.snapshot().state is State.HOLDING
    np.testing.assert_array_equal(world.supply.set_points, pressures)
    for _ in range(round(0.1 / PERIOD)):
        world.tick()
    assert world.loop.snapshot().state is State.HOLDING
    halfway, begun = np.abs(world.supply.set_points), np.abs(pressures)
    assert (halfway[begun > 0] < begun[begun > 0]).all()
    assert halfway.any()
    for _ in range(round(0.15 / PERIOD)):
        world.tick()
    snapshot = world.loop.snapshot()
    assert snapshot.state is State.INACTIVE
    assert world.supply.vented
    kinds = [event.kind for event in world.loop.events.since(0)[0]]
    assert "disarming" in kinds
    assert "refused" not in kinds


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (GuardTripped("no command came for 0.1 s"), "guard", "no command came for 0.1 s"),
        (DeviceError("no answer"), "device", "a device fails: no answer"),
    ],
)
def test_a_guard_that_vented_by_itself_is_no_device_that_fails(
    error: DeviceError, kind: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab().under_pressure()

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(lab.gate, "apply", fail)
    lab.tick()
    snapshot = lab.loop.snapshot()
    assert snapshot.state is State.FAULT
    assert snapshot.reason == text
    assert lab.kinds[-1] == kind
    assert lab.is_vented()
