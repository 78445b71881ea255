"""Settings of the simulated arm and its devices: the rig file's ``plant``, ``lab`` and drivers.

The plant's settings describe how the arm differs from its robot file, and what a robot file does
not contain: how the silicone stretches, creeps and dissipates. By default the arm is a perfect copy
of its robot file except for the material, whose values are typical of soft silicones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from stiffopt.directions import Direction
from stiffopt.errors import FileError, InputError
from stiffopt.model.description import RobotDescription
from stiffopt.model.scene import Scene, SceneOrFile
from stiffopt.registration import Placement
from stiffopt.rig.device import MisfitError, RigSection
from stiffopt.rig.pressure import SupplySettings
from stiffopt.rig.probing import ProbeSettings
from stiffopt.rig.tracking import TrackerSettings
from stiffopt.schema import BadKeyError, Items, Schema, Vector
from stiffopt.units import (
    Acceleration,
    Angle,
    Duration,
    Force,
    Frequency,
    Length,
    Mass,
    Moment,
    Pressure,
    PressureRate,
    Ratio,
    Speed,
    TranslationalStiffness,
)

LINE, TUBE, PLANE, CYLINDER, BOX = 0, 1, 2, 3, 4
TOUCHABLE = {
    "sphere": LINE,
    "capsule": LINE,
    "inside_tube": TUBE,
    "half_space": PLANE,
    "cylinder": CYLINDER,
    "box": BOX,
}
"""Shapes that the simulated arm can touch, by their keys in files, and their codes."""

Positive = Field(gt=0)
NotNegative = Field(ge=0)
Share = Annotated[Ratio, Field(ge=0, le=1)]


class SiliconeCreep(Schema):
    """One Maxwell branch of the silicone, in parallel with its equilibrium modulus.

    Attributes
    ----------
    share : stiffness of the branch, as a share of the equilibrium modulus.
    time : relaxation time, in s.
    """

    share: Share
    time: Annotated[Duration, Positive]


class SiliconeHysteresis(Schema):
    """One elastic, ideally plastic element (Jenkin) of the silicone: Maxwell slip.

    Attributes
    ----------
    share : stiffness of the element, as a share of the equilibrium modulus.
    strain : strain of a fibre at which the element slips.
    """

    share: Share
    strain: Annotated[Ratio, Positive]


class Silicone(Schema):
    """Differences of the material from a linear elastic one.

    Attributes
    ----------
    law : uniaxial law of a fibre at rest, incompressible: ``linear``, ``neo-hookean`` (softens
        as it stretches) or ``yeoh``.
    stiffening : C2 / C1 of the Yeoh law; above 0 it stiffens as it stretches further.
    damping : share of critical damping that the material's viscosity (Kelvin-Voigt) gives to a
        vibration at the frequency of the arm's first bending mode.
    creep : relaxation.
    hysteresis : between loading and unloading.
    """

    law: Literal["linear", "neo-hookean", "yeoh"] = "yeoh"
    stiffening: Annotated[Ratio, Field(ge=0, le=2)] = 0.1
    damping: Annotated[Ratio, Field(ge=0, le=1)] = 0.1
    creep: Items[SiliconeCreep] = (
        SiliconeCreep(share=0.05, time=2.0),
        SiliconeCreep(share=0.05, time=20.0),
    )
    hysteresis: Items[SiliconeHysteresis] = (
        SiliconeHysteresis(share=0.06, strain=0.01),
        SiliconeHysteresis(share=0.06, strain=0.04),
    )


class Mismatch(Schema):
    """Differences of this arm from its robot file.

    Lists have one value per channel or per segment, the proximal segment first.

    Attributes
    ----------
    gain : of each channel: acting pressure per pressure in the chamber.
    offset : of each channel: additional acting pressure, in Pa.
    angle : of each channel: rotation of its chambers about the axis, in rad.
    modulus : of each segment: factor on Young's modulus.
    length : of each segment: factor on the rest length.
    base : the true base frame in the nominal one.
    registration : the base frame that the registered tracker assumes, in the true one.
    """

    gain: Items[Annotated[Ratio, Positive]] = ()
    offset: Items[Pressure] = ()
    angle: Items[Angle] = ()
    modulus: Items[Annotated[Ratio, Positive]] = ()
    length: Items[Annotated[Ratio, Positive]] = ()
    base: Placement = Placement()
    registration: Placement = Placement()

    def check_lengths(self, robot: RobotDescription) -> None:
        """Refuse a list without exactly one value per channel or per segment of a robot.

        Raises `MisfitError` with the name of the list.
        """
        channels, segments = robot.n_pressures, robot.n_segments
        for name, length, noun in (
            *((name, channels, "channel") for name in ("gain", "offset", "angle")),
            *((name, segments, "segment") for name in ("modulus", "length")),
        ):
            values = getattr(self, name)
            if values and len(values) != length:
                raise MisfitError(
                    f"mismatch.{name} has {len(values)} values; expected {length}, one for each "
                    f"{noun} of the robot, the proximal segment first",
                    "plant",
                )


class Spread(Schema):
    """Standard deviations of a random mismatch, in addition to the given one."""

    gain: Share = 0.05
    offset: Annotated[Pressure, NotNegative] = 500.0
    angle: Annotated[Angle, NotNegative] = 0.035
    modulus: Share = 0.1
    length: Share = 0.01
    base_position: Annotated[Length, NotNegative] = 0.001
    base_tilt: Annotated[Angle, NotNegative] = 0.0175
    registration_position: Annotated[Length, NotNegative] = 0.0005
    registration_angle: Annotated[Angle, NotNegative] = 0.005


class PlantLoad(Schema):
    """A wrench on the arm.

    Attributes
    ----------
    force, moment : in N and N m.
    frame : ``base``: keeps its direction; ``tip``: follows the section on which it acts.
    at : arc length of that section at rest, connectors included and as in the robot file, in m;
        the tip by default.
    """

    force: Vector[Force] = (0.0, 0.0, 0.0)
    moment: Vector[Moment] = (0.0, 0.0, 0.0)
    frame: Literal["base", "tip"] = "base"
    at: Annotated[Length, NotNegative] | None = None


class SoftSurface(Schema):
    """A flat soft surface on which the tip may press, without friction.

    Attributes
    ----------
    point : a point on it, in the base frame, in m.
    normal : unit vector out of it.
    stiffness : force per depth of the tip's centre in it, in N/m.
    """

    point: Vector[Length]
    normal: Direction
    stiffness: Annotated[TranslationalStiffness, Positive]


def check_touchable(scene: Scene) -> Scene:
    """Refuse a scene with a shape that the simulated arm cannot touch.

    Raises `InputError` with the name of the object.
    """
    for item in scene.objects:
        if item.shape.key not in TOUCHABLE:
            *most, last = TOUCHABLE
            raise InputError(
                f"the simulated arm cannot touch '{item.name}', a {item.shape.key}; give what it "
                f"meets under plant.scene, as {', '.join(most)} or {last}"
            )
    return scene


class Discretisation(Schema):
    """Discretisation of the rod, per segment.

    Attributes
    ----------
    bending_degree : degree of the Legendre polynomials of curvature.
    shear_degree : degree of those of stretch, shear and twist.
    sub_intervals : number of intervals for integrating the strains to poses.
    step : time step, in s; with inertia, steps above 4 ms are divided.
    """

    bending_degree: Annotated[int, Field(ge=0, le=8)] = 3
    shear_degree: Annotated[int, Field(ge=0, le=8)] = 2
    sub_intervals: Annotated[int, Field(ge=2, le=16)] = 5
    step: Annotated[Duration, Field(gt=0, le=0.02)] = 0.001

    @model_validator(mode="after")
    def _has_enough_nodes(self) -> Self:
        # in each plane, positions and rotations of the nodes must distinguish bending from shear
        least = max(self.shear_degree + 1, -(-(self.bending_degree + self.shear_degree + 2) // 2))
        if self.sub_intervals < least:
            raise BadKeyError(
                "sub_intervals",
                f"{self.sub_intervals} are too few for these degrees; expected at least {least}",
            )
        return self


class PlantSettings(RigSection):
    """The simulated arm.

    Attributes
    ----------
    dynamics : ``full``: the arm has inertia; ``quasi-static``: it has none.
    silicone, mismatch, discretisation : see there.
    spread : standard deviations of a mismatch drawn from the seed; None draws none.
    seed : of the mismatch and of all noise.
    payload : mass at the tip that the robot file does not contain, in kg.
    gravity : acceleration in the base frame, in m/s^2, if it differs from the robot file's.
    load : constant load; None for none.
    surface : surface on which the tip may press while no probe is mounted; None for none.
    scene : all objects that the body really meets; None: those of the rig's scene that it may lean
        on. Friction and stiffness are those under ``contact``.
    faults : whether faults may be injected while the rig runs.
    """

    dynamics: Literal["quasi-static", "full"] = "full"
    silicone: Silicone = Silicone()
    mismatch: Mismatch = Mismatch()
    spread: Spread | None = None
    seed: Annotated[int, NotNegative] = 0
    payload: Annotated[Mass, NotNegative] = 0.0
    gravity: Vector[Acceleration] | None = None
    load: PlantLoad | None = None
    surface: SoftSurface | None = None
    scene: Annotated[SceneOrFile, AfterValidator(check_touchable)] | None = None
    faults: bool = False
    discretisation: Discretisation = Discretisation()

    def check_against(self, rig: Any, robot: RobotDescription) -> None:
        """Refuse a mismatch with a wrong number of channels or segments, or a misplaced scene."""
        self.mismatch.check_lengths(robot)
        if self.scene is not None:
            try:
                self.scene.check_against(robot)
            except FileError:
                raise
            except InputError as error:
                raise MisfitError(str(error), "plant", "scene") from None


def plant_of(description: Any) -> PlantSettings:
    """Return the plant of a `RigDescription`, or the default one if it has none.

    Without a scene of its own it has those objects of the rig's scene that the arm may lean on.

    Raises `InputError`: the simulated arm cannot touch one of them.
    """
    plant, scene = description.plant, description.scene
    plant = plant if isinstance(plant, PlantSettings) else PlantSettings()
    if plant.scene is None and scene is not None:
        met = [item for item in scene.objects if item.may_be_leant_on]
        if met:
            scene = check_touchable(scene.model_copy(update={"objects": tuple(met)}))
            plant = plant.model_copy(update={"scene": scene})
    return plant


class SimulatedSupplySettings(SupplySettings):
    """Regulators, one per channel.

    Attributes
    ----------
    dead_time : time until a set-point has any effect, in s.
    lag : time constant, in s.
    slew : greatest rate of change, in Pa/s.
    resolution : step of the set-points and of the readings, in Pa.
    noise : standard deviation of the readings, in Pa.
    ripple : standard deviation of the pressure itself, in Pa.
    saturation : highest pressure of the supply, in Pa; None: the limits.
    leak : time constant with which a chamber empties through a leak, in s; None: no leak.
    watchdog : time without a command after which it vents, in s; None: never.
    dump_valve : whether there is a valve that empties all chambers, see `PressureSupply.arm`.
    """

    simulated: ClassVar[bool] = True
    simulator: ClassVar[str] = "stiffopt.plant.devices:simulated_rig"

    driver: Literal["simulated"] = "simulated"
    dead_time: Annotated[Duration, Field(ge=0, le=1)] = 0.01
    lag: Annotated[Duration, NotNegative] = 0.06
    slew: Annotated[PressureRate, Positive] = 5e5
    resolution: Annotated[Pressure, NotNegative] = 50.0
    noise: Annotated[Pressure, NotNegative] = 150.0
    ripple: Annotated[Pressure, NotNegative] = 100.0
    saturation: Annotated[Pressure, Positive] | None = None
    leak: Annotated[Duration, Positive] | None = None
    watchdog: Annotated[Duration, Positive] | None = None
    dump_valve: bool = False


class SimulatedTrackerSettings(TrackerSettings):
    """An electromagnetic tracker.

    Attributes
    ----------
    rate : frames a second.
    latency : from capture to arrival, in s.
    noise, angular_noise : standard deviations in each axis, in m and rad.
    dropouts : share of the frames in which the tool is not seen.
    missing : share of the frames that never arrive.
    flips : share of the frames with the other sign of the quaternion.
    """

    simulated: ClassVar[bool] = True

    driver: Literal["simulated"] = "simulated"
    rate: Annotated[Frequency, Positive] = 40.0
    latency: Annotated[Duration, NotNegative] = 0.025
    noise: Annotated[Length, NotNegative] = 3e-5
    angular_noise: Annotated[Angle, NotNegative] = 1e-3
    dropouts: Share = 0.0
    missing: Share = 0.0
    flips: Share = 0.0

    def check_against(self, rig: Any, robot: RobotDescription) -> None:
        """Refuse a frame rate above the rate of simulation steps."""
        fastest = 1 / plant_of(rig).discretisation.step
        if self.rate > fastest * (1 + 1e-9):
            raise MisfitError(
                f"{self.rate:g} Hz is faster than the steps of the simulation, {fastest:g} Hz",
                *("tracker", "rate"),
            )


class SimulatedProbeSettings(ProbeSettings):
    """A flat plate on a linear stage that pushes the tip, and its force sensor.

    Attributes
    ----------
    stiffness : of the contact, in N/m.
    speed : greatest speed of the stage, in m/s.
    clearance : between plate and tip when the probe is aligned, in m.
    noise : standard deviation of the force, in N.
    """

    simulated: ClassVar[bool] = True

    driver: Literal["simulated"] = "simulated"
    stiffness: Annotated[TranslationalStiffness, Positive] = 2000.0
    speed: Annotated[Speed, Positive] = 0.02
    clearance: Annotated[Length, NotNegative] = 0.001
    noise: Annotated[Force, NotNegative] = 0.0005


@dataclass(frozen=True)
class FaultSizes:
    """Errors of the devices while a fault is injected, see `stiffopt.plant.world.FAULTS`."""

    lag: float = 0.5  # added to the time constant of a slow regulator, in s
    leak_time: float = 0.3  # time constant with which a leaking chamber empties, in s
    # reading_gain, reading_offset: of wrong pressure readings, the offset in Pa
    reading_gain: float = 0.7
    reading_offset: float = 2e4
    frame_delay: float = 0.5  # additional delay of a slow tracker's frames, in s
    # error of a wrong tracker (3,), in m
    tracker_offset: tuple[float, float, float] = (0.02, -0.015, 0.01)
    # speed of a drifting tracker (3,), in m/s
    drift: tuple[float, float, float] = (0.004, 0.003, 0.0)
    # angular speed of a turning tracker's frame about its origin (3,), in rad/s
    turn: tuple[float, float, float] = (0.0, 0.05, 0.0)
    # shake, shake_rate: amplitude (3,) and frequency of a shaking tracker, in m and Hz
    shake: tuple[float, float, float] = (0.01, 0.0, 0.0)
    shake_rate: float = 3.0
    lag_growth: float = 0.1  # growth of a lagging tracker's delay per second, in s
    stage_speed: float = 0.1  # speed of a slow stage, as a share of the normal one
    # force_gain, force_offset: of wrong force readings, the offset in N
    force_gain: float = 0.5
    force_offset: float = 0.1


FAULT_SIZES = FaultSizes()


class LabSettings(RigSection):
    """The devices behind the protocols of the virtual lab (`stiffopt lab`).

    Attributes
    ----------
    supply : the regulators.
    tracker : its registration is that of the rig's own tracker.
    probe : stage and force sensor.
    """

    supply: SimulatedSupplySettings = SimulatedSupplySettings()
    tracker: SimulatedTrackerSettings = SimulatedTrackerSettings()
    probe: SimulatedProbeSettings = SimulatedProbeSettings()
