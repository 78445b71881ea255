"""The description of a segment: its part of the robot file, and classes for Python code.

All values are in SI: m, rad, Pa, kg. In code::

    Segment(length=0.09, outer_radius=0.015, inner_radius=0.0045, ...)
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SerializeAsAny,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from stiffopt.errors import InputError, shown
from stiffopt.model.history import History
from stiffopt.schema import BadKeyError, Items, Schema, explain
from stiffopt.units import Angle, Density, Length, Number, Pressure, Ratio

if TYPE_CHECKING:
    from stiffopt.model.actuation import StrainLaw

_SLACK = 1e-9  # m; two circles that touch may overlap by rounding


def _index(value: Any) -> Any:
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise InputError(f"expected a chamber number, counted from 1, not {shown(value)}")
    return value.__index__()


PositiveLength = Annotated[Length, Field(gt=0)]
ChamberNumber = Annotated[int, BeforeValidator(_index)]


class Chambers(Schema):
    """Round chambers that run along a segment, their centres on one circle.

    Attributes
    ----------
    radius : of each chamber, in m.
    offset : of the chambers' centres from the axis, in m.
    angles : of the chambers' centres about the axis from x towards y, in rad.
    """

    radius: PositiveLength
    offset: PositiveLength
    angles: Annotated[Items[Angle], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self) -> Chambers:
        for (i, a), (j, b) in itertools.combinations(enumerate(self.angles, start=1), 2):
            distance = 2 * self.offset * abs(math.sin((a - b) / 2))
            if distance < 2 * self.radius - _SLACK:
                raise BadKeyError("angles", f"chambers {i} and {j} overlap; move them apart")
        return self


class Material(Schema):
    """The silicone, linear and isotropic.

    Attributes
    ----------
    youngs_modulus : E, in Pa.
    poisson_ratio : 0.5 is incompressible.
    density : in kg/m^3, or None; needed only where there is gravity.
    """

    youngs_modulus: Annotated[Pressure, Field(gt=0)]
    poisson_ratio: Annotated[Number, Field(gt=-1, le=0.5)] = 0.5
    density: Annotated[Density, Field(gt=0)] | None = None


class Compensation(Schema):
    """The paper's lambda: corrections of E, A and I that are fitted to an arm.

    Attributes
    ----------
    modulus_per_pressure : change of E per norm of a segment's pressures, Pa/Pa.
    modulus_law : ``linear``, as in the paper: E + modulus_per_pressure |p|; or ``exponential``,
        E exp(modulus_per_pressure |p| / E), which has the same slope at zero and stays positive.
    area : factor on A.
    inertia : factor on I.
    stiffness : factor on E against loads. Free shapes depend on pressure over E alone: with 1.4,
        the arm is 1.4 times as stiff as E and pressure acts 1.4 times as strongly as drawn. 1 in
        the paper.
    softening : share of `modulus_per_pressure` that makes the arm softer against loads; the rest
        makes pressure act more strongly, as in chambers that swell. 1 in the paper.
    bending_radius : least radius to which pressure can bend, in m, of the axis per length as the
        strain law counts it; the silicone stiffens towards it. 0 in the paper: no limit.
    lengthening : stretch of the axis per squared strain ``(outer_radius / bending radius)^2`` of
        the outermost wall under bending. Loads do not lengthen. 0 in the paper.
    """

    modulus_per_pressure: Number = 0.0
    modulus_law: Literal["linear", "exponential"] = "linear"
    area: Annotated[Number, Field(gt=0)] = 1.0
    inertia: Annotated[Number, Field(gt=0)] = 1.0
    stiffness: Annotated[Number, Field(gt=0)] = 1.0
    softening: Annotated[Number, Field(ge=0, le=1)] = 1.0
    bending_radius: Annotated[Length, Field(ge=0)] = 0.0
    lengthening: Number = 0.0


class Corrections(Schema):
    """Corrections of a segment's channels; a list is empty or has one value for each channel.

    Attributes
    ----------
    gain : acting pressure per pressure.
    offset : pressure that acts in addition, in Pa.
    dead_band : pressure up to which the segment hardly moves, for all channels, in Pa. It is
        applied before gain and offset, and needs pressures that are never negative.
    azimuth : turn of the channel's chambers about the axis, from x towards y, in rad.
    """

    gain: Items[Annotated[Ratio, Field(gt=0)]] = ()
    offset: Items[Pressure] = ()
    dead_band: Annotated[Pressure, Field(ge=0)] = 0.0
    azimuth: Items[Angle] = ()


class Segment(Schema):
    """One segment of the arm, followed by a rigid connector.

    Attributes
    ----------
    length, outer_radius, inner_radius : of the tube at rest, in m.
    chambers : positions of the chambers.
    channels : for each regulator the chambers it feeds, counted from 1.
    material : of the tube.
    compensation : the paper's lambda, or None.
    corrections : of the channels, or None.
    history : how the shape lags behind the pressures, or None if it does not.
    connector : rigid length after the segment, in m.
    strain_law : how pressures strain the segment, by the name of a law of `stiffopt.model.laws`:
        ``paper``, linear per deformed length; ``rest-length``, the same per length at rest;
        ``neo-hookean``; ``fibres``, which stretch and bend together; or any other that is
        registered.
    law : the keys that only this law has, or None; of the type `StrainLaw.Keys`.
    """

    length: PositiveLength
    outer_radius: PositiveLength
    inner_radius: Annotated[Length, Field(ge=0)] = 0.0
    chambers: Chambers
    channels: Annotated[
        Items[Annotated[Items[ChamberNumber], Field(min_length=1)]], Field(min_length=1)
    ]
    material: Material
    compensation: Compensation | None = None
    corrections: Corrections | None = None
    history: History | None = None
    connector: Annotated[Length, Field(ge=0)] = 0.0
    strain_law: str = "paper"
    law: SerializeAsAny[Schema] | None = Field(None, exclude_if=lambda keys: keys is None)

    @property
    def n_channels(self) -> int:
        """Number of pressures that act on this segment."""
        return len(self.channels)

    @field_validator("strain_law")
    @classmethod
    def _is_registered(cls, name: str) -> str:
        _law_class(name)
        return name

    @field_validator("law", mode="plain")
    @classmethod
    def _read_law(cls, value: Any, info: ValidationInfo) -> Schema | None:
        """Read the keys of the law by the law's own schema."""
        name = info.data.get("strain_law")
        if name is None:  # there is no such law; the error is reported at that key
            return None
        keys = _law_class(name).Keys
        if value is None:
            return None
        if keys is None:
            raise InputError(f"the strain law {shown(name)} has no keys of its own; remove this")
        if isinstance(value, keys):
            return value
        try:
            return keys.model_validate(value, context=info.context)
        except ValidationError as error:
            loc, reason = explain(keys, error.errors()[0], None)
            wrong = BadKeyError(".".join(map(str, loc)), reason) if loc else InputError(reason)
            raise wrong from None

    @model_validator(mode="after")
    def _check(self) -> Segment:
        self._check_walls()
        self._check_channels()
        memory = self.history.memory if self.history is not None else ()
        if memory and len(memory) != self.n_channels:
            raise BadKeyError(
                "history.memory",
                f"has {len(memory)} values; expected {self.n_channels}, one for each channel",
            )
        for name, values in self.corrections or ():
            if isinstance(values, tuple) and values and len(values) != self.n_channels:
                raise BadKeyError(
                    f"corrections.{name}",
                    f"has {len(values)} values; expected {self.n_channels}, one for each channel",
                )
        _law_class(self.strain_law).check(self)
        return self

    def _check_walls(self) -> None:
        def mm(value: float) -> str:
            return f"{value * 1e3:.6g} mm"

        inner, outer, chambers = self.inner_radius, self.outer_radius, self.chambers
        if inner >= outer:
            raise BadKeyError(
                "inner_radius",
                f"{mm(inner)} must be less than the outer radius of {mm(outer)}",
            )
        if chambers.offset - chambers.radius < inner - _SLACK:
            raise BadKeyError(
                "chambers.offset",
                f"chambers of radius {mm(chambers.radius)} at {mm(chambers.offset)} break through "
                f"the inner wall at {mm(inner)}; expected offset - radius >= inner_radius",
            )
        if chambers.offset + chambers.radius > outer + _SLACK:
            raise BadKeyError(
                "chambers.offset",
                f"chambers of radius {mm(chambers.radius)} at {mm(chambers.offset)} break through "
                f"the outer wall at {mm(outer)}; expected offset + radius <= outer_radius",
            )

    def _check_channels(self) -> None:
        n = len(self.chambers.angles)
        fed: dict[int, int] = {}
        for channel, chambers in enumerate(self.channels, start=1):
            for position, chamber in enumerate(chambers):
                key = f"channels.{channel - 1}.{position}"
                if not 1 <= chamber <= n:
                    raise BadKeyError(
                        key, f"there is no chamber {chamber}; expected a number from 1 to {n}"
                    )
                if chamber in fed:
                    twice = (
                        f"twice by channel {channel}"
                        if fed[chamber] == channel
                        else f"by channel {fed[chamber]} and by channel {channel}"
                    )
                    raise BadKeyError(key, f"chamber {chamber} is fed {twice}; expected one")
                fed[chamber] = channel
        for chamber in range(1, n + 1):
            if chamber not in fed:
                raise BadKeyError(
                    "channels", f"chamber {chamber} is fed by no channel; expected one"
                )


def _law_class(name: str) -> type[StrainLaw]:
    from stiffopt.model.laws import law_class  # avoid a circular import

    return law_class(name)
