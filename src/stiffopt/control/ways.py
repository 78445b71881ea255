"""Checks that the arm's body keeps clear of the rig's scene: on a planned way, and in each tick.

A way is a line of straight pieces in the space of pressures. The model decides, at effective
pressures; an arm that differs from its model is nearer or farther by that difference.
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stiffopt.arrays import Array
from stiffopt.errors import StiffoptError
from stiffopt.model.body import COMPILED_FREE_FROM
from stiffopt.model.compiled import compiling_at_once
from stiffopt.model.manipulator import Manipulator
from stiffopt.model.scene import Scene

_PIECE = 1e4  # Pa, longest initial piece of a way, over which points of the body go straight
_CURVED = 1.1  # bound of the length of a point's way over the straight distance between two states
_STATE_SLACK = 1e-4  # m, by which a state may be nearer than the clearance
_BETWEEN_SLACK = 2e-4  # m, by which the body may be nearer between two states
_ACCURACY = 5e-4  # m, accuracy of a shortfall
_STATIONS = 13  # along the body, whose ways are measured
_SAMPLES = 64  # pressures at which the body's speed is measured
_SPEED_FACTOR = 1.5  # safety factor on that speed
_STATES_DOWN = 5  # states on each piece of a way down
_TIMED = 5  # measurements of the cost; the least counts, as other programs interrupt
_MAX_COST = 5e-3  # s, of choosing a way down, for which a tick has to wait


class Ways:
    """Checks an arm's ways through a scene."""

    def __init__(self, robot: Manipulator, scene: Scene) -> None:
        self._robot, self._scene = robot, scene

    def blocked(self, way: Array, *, waypoints: bool = False) -> str:
        """Return why the body does not keep its clearance on a way (k, n), in Pa; empty if it does.

        An arm that is nearer to the scene at the beginning of the way must not come nearer still.
        The way is divided until the body cannot come nearer between two states by more than 0.2 mm
        than is accepted.

        `way`: its corners. `waypoints`: whether all corners but the first are waypoints, to be
        named in the reason.
        """
        robot = self._robot
        states, legs = _divided(np.clip(way, robot.pressure_min, robot.pressure_max))
        try:
            clearance, lines = self._clearance(states), self._lines(states)
            least = min(self._scene.clearance, float(clearance[0]))
            while True:
                worst = int(np.argmin(clearance))
                is_clear = clearance[worst] >= least - _STATE_SLACK
                limit = least - _BETWEEN_SLACK if is_clear else clearance[worst] - _ACCURACY
                motion = np.linalg.norm(np.diff(lines, axis=0), axis=-1).max(axis=1)
                between = (clearance[:-1] + clearance[1:] - _CURVED * motion) / 2
                open_ = np.flatnonzero(between < limit)
                if not len(open_):
                    break
                middle = (states[open_] + states[open_ + 1]) / 2
                found = self._clearance(middle), self._lines(middle)
                states = np.insert(states, open_ + 1, middle, axis=0)
                legs = np.insert(legs, open_ + 1, legs[open_ + 1])
                clearance = np.insert(clearance, open_ + 1, found[0])
                lines = np.insert(lines, open_ + 1, found[1], axis=0)
            if is_clear:
                return ""
            where = f"to waypoint {legs[worst]}" if waypoints else "there"
            return f"on the way {where} {shortfall(robot, self._scene, states[worst])}"
        except StiffoptError as error:
            return f"the model has no answer on the way: {error}"

    def _clearance(self, states: Array) -> Array:
        return np.asarray(self._robot.clearance(states, self._scene))

    def _lines(self, states: Array) -> Array:
        """Return positions (N, stations, 3) along the body."""
        return np.asarray(self._robot.backbone(states, n=_STATIONS)[..., :3, 3])


class ClearanceWatch:
    """Checks in each tick that a command keeps half of the clearance that the scene asks for."""

    def __init__(self, robot: Manipulator, scene: Scene) -> None:
        self._robot, self._scene = robot, scene
        self._min_clearance = scene.clearance / 2
        self._speed = np.full(robot.n_pressures, np.inf)  # of the body per pressure, in m/Pa
        self._ways_down = _ways_down(robot)
        self._cost = np.inf  # of the clearance at one state, in s
        self.begin()

    def prepare(self) -> None:
        """Compile the model's clearance, and measure how fast pressures move the body."""
        robot = self._robot
        with compiling_at_once():
            robot._body.machine_code(COMPILED_FREE_FROM)
            robot.clearance(robot.pressure_min, self._scene)  # the distances to the scene too
        low, high = robot.pressure_min, robot.pressure_max
        samples = np.random.default_rng(0).uniform(low, high, (_SAMPLES, len(low)))
        at = np.linspace(0.0, robot.length, _STATIONS)
        jacobians = robot.body_jacobian(samples, at)[:, :, :3]  # (N, stations, 3, n)
        self._speed = _SPEED_FACTOR * np.linalg.norm(jacobians, axis=2).max(axis=(0, 1))
        self._measure_cost()

    def begin(self) -> None:
        """Restart: forget where the body is."""
        self._at = np.zeros(self._robot.n_pressures)
        self._clearance = -np.inf

    def _measure_cost(self) -> None:
        robot = self._robot
        states = np.linspace(robot.pressure_min, robot.pressure_max, _STATES_DOWN)
        times = []
        for _ in range(_TIMED):
            begin = time.perf_counter()
            robot.clearance(states, self._scene)
            times.append(time.perf_counter() - begin)
        self._cost = min(times) / _STATES_DOWN

    def too_near(self, pressures: Array) -> str:
        """Return why the body must not go to effective pressures (n,), in Pa; empty if it may.

        It may go where it has half of the clearance, or no less than it has now, so that it can
        leave a place too near to the scene. The clearance is computed again only if the body can
        have come too near since the last time.
        """
        robot = self._robot
        moved = float(np.abs(pressures - self._at) @ self._speed)
        if moved <= self._clearance - self._min_clearance:
            return ""
        within = np.clip(pressures, robot.pressure_min, robot.pressure_max)
        try:
            clearance = float(robot.clearance(within, self._scene))
        except StiffoptError as error:
            return f"the model has no answer at the next pressures: {error}"
        if not clearance >= min(self._min_clearance, self._clearance):
            return shortfall(robot, self._scene, within)
        self._at, self._clearance = pressures.copy(), clearance
        return ""

    def way_down(self, pressures: Array) -> tuple[Array, str]:
        """Choose how to let pressures (n,), in Pa, down past the scene.

        The candidates let down all channels together, or one segment after the other. The first one
        is chosen on which the body keeps half of the clearance, or its present one; otherwise the
        one on which it keeps farthest away.

        Returns
        -------
        shares :
            Of the pressures (k, n), from 1 to 0.
        warning :
            That the body comes too near all the same, or that this was not checked; may be empty.
        """
        ways = self._ways_down
        if self._cost * _STATES_DOWN * sum(len(way) - 1 for way in ways) > _MAX_COST:
            return ways[0], "whether the body keeps clear on the way down was not looked at"
        best = ways[0], -np.inf, np.zeros_like(pressures)
        robot = self._robot
        try:
            for way in ways:
                steps = np.linspace(0, len(way) - 1, _STATES_DOWN * (len(way) - 1) + 1)
                shares = np.stack([np.interp(steps, np.arange(len(way)), c) for c in way.T], axis=1)
                states = np.clip(shares * pressures, robot.pressure_min, robot.pressure_max)
                clearance = np.asarray(robot.clearance(states, self._scene))
                if clearance.min() >= min(self._min_clearance, float(clearance[0])) - _STATE_SLACK:
                    return way, ""
                if clearance.min() > best[1]:
                    best = way, float(clearance.min()), states[int(clearance.argmin())]
        except StiffoptError as error:
            return ways[0], f"the model has no answer on the way down: {error}"
        return best[0], f"on the way down {shortfall(robot, self._scene, best[2])}"


def _ways_down(robot: Manipulator) -> list[Array]:
    """Return shares of the pressures (k, n): all at once, distal segment first, or last."""
    segments = robot.description.segments
    owner = np.repeat(np.arange(len(segments)), [s.n_channels for s in segments])
    ways = [np.array([np.ones(len(owner)), np.zeros(len(owner))])]
    if len(segments) > 1:
        up = np.array([owner >= k for k in range(len(segments) + 1)], dtype=float)
        ways += [1 - up[::-1], up]
    return ways


def shortfall(robot: Manipulator, scene: Scene, pressures: Array) -> str:
    """Report which object an arm at pressures (n,) is too near to, and by how much."""
    found = robot.clearances(pressures, scene)
    distance, asked = 1e3 * float(found.distances.min()), 1e3 * scene.clearance
    near = f"be {distance:.1f} mm from" if distance >= 0 else f"go {-distance:.1f} mm into"
    return (
        f"the body would {near} '{found.nearest}', {asked - distance:.1f} mm short of the "
        f"{asked:g} mm that the rig's scene asks for"
    )


def _divided(way: Array) -> tuple[Array, NDArray[np.intp]]:
    """Divide a way (k, n) into states (N, n); also return the piece (N,) of each, from 1."""
    states, legs = [way[:1]], [np.ones(1, dtype=np.intp)]
    for number, (start, end) in enumerate(pairwise(way), start=1):
        count = max(1, int(np.ceil(np.abs(end - start).max() / _PIECE)))
        states.append(start + np.arange(1, count + 1)[:, None] / count * (end - start))
        legs.append(np.full(count, number))
    return np.concatenate(states), np.concatenate(legs)
