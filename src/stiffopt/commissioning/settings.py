"""Tuning of a commissioning: the procedure, the priors, and the limits of what fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ProcedureTuning:
    """How the arm is moved."""

    motion: float = 4e-3  # predicted displacement of the tip by the most effective channel, in m
    share: float = 0.15  # largest step, as a share of a channel's range
    first: float = 0.35  # share of the step that is commanded first, to reveal danger early
    # rest, first_hold, up, down: duration of the initial rest, of the first part of a step, of a
    # step and of the rest after it, in s
    rest: float = 3.0
    first_hold: float = 0.7
    up: float = 3.0
    down: float = 2.6
    # long, long_down: duration of a step and of the rest after it in a full commissioning, which
    # reveals leaks and creep, in s
    long: float = 15.0
    long_down: float = 5.0
    # danger, slack: the arm is vented if the tip moves farther than `danger` times the largest
    # prediction for any channel or pair, plus `slack` in m
    danger: float = 2.0
    slack: float = 5e-4
    restless: float = 8e-3  # largest motion of the vented arm, in m, with which the steps may begin


@dataclass(frozen=True)
class Belief:
    """Priors of a sound set-up: standard deviations, in SI."""

    # tilt, turn: of the tracker's frame about the base's x and y, and about its z
    tilt: float = float(np.radians(0.5))
    turn: float = float(np.radians(1.0))
    move: float = 1e-3  # of the tracker's frame
    # sensor, sensor_angle: of the sensor on the tip
    sensor: float = 6e-4
    sensor_angle: float = float(np.radians(0.8))
    # of the base against gravity; covers a load of the same effect
    base_tilt: float = float(np.radians(0.5))
    # displacement of the tip at rest due to an unknown load or the arm's own shape
    sag: float = 3e-4
    # length, modulus, gain: of segments and channels, relative; less after a calibration
    length: float = 0.008
    modulus: float = 0.17
    gain: float = 0.05
    # model_share, model_floor: remaining model error, as a share of the step's own displacement and
    # of the largest of all steps
    model_share: float = 0.04
    model_floor: float = 0.015
    # rest_position, rest_angle: remaining model error at rest
    rest_position: float = 5e-4
    rest_angle: float = float(np.radians(0.4))


@dataclass(frozen=True)
class Limits:
    """Limits beyond which a set-up does not fit, and the evidence needed to say so; in SI.

    Attributes
    ----------
    clear : smallest gain in log evidence of a cause that is reported.
    same : causes whose log evidence differs by less cannot be distinguished.
    swapped, lines : log prior of tubes in another order, and of dead or shared ones.
    tilt, turn, move, sensor, sensor_angle : of tracker frame and sensor, as in `Belief`.
    bend : displacement of the tip at rest due to a load or a tilt of the base.
    length, gain, soft, weak : relative error of a length and of a channel's gain; largest and
        smallest response of the arm or a segment, as a factor on the model's.
    dead : share of the expected response below which a channel or gauge is dead.
    gauge, gauge_least : error of a gauge, as a share of a step and in Pa.
    unexplained : unexplained share of a step's displacement.
    noise : factor on the tracker's noise in the rig file.
    latency : excess over the tracker's latency in the rig file, in s.
    tip_delay : of the tip behind the gauges, by the tracker's own times, in s.
    slower : excess of the regulators' delay over that in the rig file, in s.
    frequency : factor between measured and modelled frequency of the swing.
    drift : share of its displacement that the tip may lose while a pressure is held.
    """

    clear: float = 0.5
    same: float = 6.0
    swapped: float = -7.0
    lines: float = -5.0
    tilt: float = float(np.radians(2.8))
    turn: float = float(np.radians(6.0))
    move: float = 6e-3
    sensor: float = 5e-3
    sensor_angle: float = float(np.radians(6.0))
    bend: float = 8e-3
    length: float = 0.03
    gain: float = 0.25
    soft: float = 1.35
    weak: float = 0.68
    dead: float = 0.2
    gauge: float = 0.04
    gauge_least: float = 400.0
    unexplained: float = 0.5
    noise: float = 1.7
    latency: float = 0.05
    tip_delay: float = 0.08
    slower: float = 0.1
    frequency: float = 1.4
    drift: float = 0.1


PROCEDURE = ProcedureTuning()
BELIEF = Belief()
LIMITS = Limits()
