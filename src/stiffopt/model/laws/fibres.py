"""The strain law `fibres`: incompressible hyperelastic fibres that stretch and bend together."""

from __future__ import annotations

from functools import cache
from typing import Annotated, NamedTuple

import casadi as ca
from pydantic import Field

from stiffopt.model.actuation import Section, bending_matrix
from stiffopt.model.calibration import FittedNumber
from stiffopt.model.laws.neo_hookean import NeoHookeanLaw, neo_hookean_stretch
from stiffopt.schema import Schema
from stiffopt.units import Ratio

_STEPS = (6, 5)  # of Newton's method: for the straight section, for the bent one
_LAST_STEP = 1e-3  # of lambda or c, beyond which Newton's method has not converged
_THINNEST = 1e-3  # squared stretch below which the energy of a fibre is cut off


class FibresKeys(Schema):
    """Numbers that only this law has.

    Attributes
    ----------
    stiffening : C2 / C1 of Yeoh's energy; 0 is a neo-Hookean fibre.
    """

    stiffening: Annotated[
        Ratio,
        Field(ge=0, le=2),
        FittedNumber(
            "stiffening by stretch", "", 0.1, low=0.0, high=2.0,
            experiment="several channels at once, to high pressures",
        ),
    ] = 0.0  # fmt: skip


class FibresLaw(NeoHookeanLaw):
    """Incompressible hyperelastic fibres along the arm, at any curvature.

    A fibre at r that is stretched by L has the energy ``mu (S + stiffening S^2) / 2`` per volume,
    ``S = L^2 + 2 / L - 3``, with ``mu = E / 3`` (Yeoh).  Sections stay flat, so
    ``L = lambda + r_y kappa_x - r_x kappa_y``; fibres and chambers keep their places at rest.
    The energy per length, ``mu A w(lambda, D)``, depends on the stretch of the line of centroids
    and on ``D = kappa' B kappa / (A / 2)``, twice the mean square of ``L - lambda``, with the
    bending matrix B of the second moments.  The mean w over the section is that over an annulus
    (mapped to an ellipse) of the same outer radius and second moments.  Force N and moment M of the
    pressures are its derivatives: ::

        N = mu A dw/dlambda,   M = 4 mu dw/dD B kappa.

    So ``kappa = c / (2 mu) B^-1 M`` and ``D = c^2 M' B^-1 M / (2 mu^2 A)`` with
    ``c = 1 / (2 dw/dD)``: two equations for lambda and c, solved by Newton's method.  A bent arm
    is longer than a straight one under the same force, and stiffening makes it bend less.  The
    compliance is the inverse of the second derivatives; stretch and bending are coupled in it.

    Compensation coefficients are those of `LinearLaw`; the shear stiffness is ``mu A``, the
    torsional one ``mu J``, with mu of the loaded modulus.
    """

    name = "fibres"
    words = "incompressible hyperelastic fibres that stretch and bend together"
    complexity = 3
    Keys = FibresKeys
    limit = "the pressure stretches or compresses fibres of this segment too far"

    def margin(self, p: ca.SX) -> ca.SX:
        """Return the least of three margins.

        They are the squared stretch of the most compressed fibre, how far Newton's method has
        converged, and the margin of the neo-Hookean law.
        """
        bent = self._bent_by(p)
        thinnest = bent.stretch**2 - (1 + bent.width) * bent.spread - 10 * _THINNEST
        converged = 1 - ca.sumsqr(bent.last_step / _LAST_STEP)
        return ca.fmin(super().margin(p), ca.fmin(thinnest, converged))

    def radius(self, p: ca.SX) -> ca.SX:
        """Return the outer radius ``r lambda^-1/2`` of the stretched section, in m."""
        return self.segment.outer_radius / ca.sqrt(self._bent_by(p).stretch)

    def section(self, p: ca.SX) -> Section:
        """Return the section about the bent state; see `StrainLaw.section`."""
        bent, area = self._bent_by(p), self.compensation.area * self.geometry.area
        loaded = self._loaded_modulus(self._acting(p)) / 3
        along, coupled, by_spread, rise = _second_derivatives()(
            bent.stretch, bent.spread, self.keys.stiffening, bent.width
        )
        pull = 4 * bent.inertia @ bent.omega / area  # dD/dkappa
        stiffness = ca.vertcat(
            ca.horzcat(along, coupled * pull.T),
            ca.horzcat(coupled * pull, rise * pull @ pull.T + by_spread * 4 / area * bent.inertia),
        )
        omega, soft = self._bent(bent.omega, ca.inv_minor(stiffness) / (loaded * area))
        shear, torsion = loaded * area, loaded * ca.trace(bent.inertia)
        compliance = ca.diagcat(1 / shear, 1 / shear, soft, 1 / torsion)
        c = ca.SX(self.geometry.centroid)
        stretch = self._lengthened(bent.stretch, omega) + omega[1] * c[0] - omega[0] * c[1]
        return Section(ca.vertcat(0, 0, stretch, omega, 0), self._about_axis(compliance, c))

    def _bent_by(self, p: ca.SX) -> _Bent:
        """Return the state in which the fibres balance the pressures p (c,)."""
        geometry, acting = self.geometry, self._acting(p)
        area = self.compensation.area * geometry.area
        inertia = bending_matrix(self.compensation.inertia * ca.SX(geometry.second_moment))
        mean = ca.trace(ca.SX(geometry.second_moment)) / geometry.area  # of the squared distance
        width = self.segment.outer_radius**2 / mean - 1
        turned = ca.inv_minor(inertia) @ self._moment_about_centroid(acting)
        turned /= self._modulus(acting) / 3
        squared = ca.dot(turned, inertia @ turned) / (2 * area)  # D = c^2 times this
        load, stiffening = self._load(acting), self.keys.stiffening
        stretch = neo_hookean_stretch(load)
        straight, bent = _STEPS
        for _ in range(straight):
            stretch = _straight(stretch, load, stiffening)
        stiffened = 3 * (stretch**2 - 1) + 6 * stretch**-3 * (1 / stretch - 1)
        c = 1 / (0.5 + stretch**-3 + stiffening * stiffened)  # of the straight section
        c /= ca.sqrt(1 + (1 + width) * squared * c**2 / stretch**2)  # no fibre is compressed away
        for _ in range(bent):
            before = ca.vertcat(stretch, c)
            stretch, c = _newton()(stretch, c, load, squared, stiffening, width)
        last_step = ca.vertcat(stretch, c) - before
        return _Bent(stretch, c**2 * squared, c / 2 * turned, inertia, width, last_step)


class _Bent(NamedTuple):
    """A bent section: stretch of its centroid, D, curvature (2,), bending matrix, and width.

    `last_step` (2,) is by how much the last step of Newton's method changed lambda and c. The
    squared distance of its fibres from the centroid is (1 - width) to (1 + width) times its mean.
    """

    stretch: ca.SX
    spread: ca.SX
    omega: ca.SX
    inertia: ca.SX
    width: ca.SX
    last_step: ca.SX


@cache
def _energy() -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return symbols for lambda, D, stiffening and width, and w.

    On a ring of fibres ``L = lambda + sqrt(D) cos t``. The means over t are elementary, those of
    1 / L and 1 / L^2 ``g`` and ``lambda g^3`` with ``g = (lambda^2 - D)^-1/2``; and so are the
    means of these over rings of equal areas between ``D (1 - width)`` and ``D (1 + width)``.
    """
    x, d, a, width = (ca.SX.sym(name) for name in ("stretch", "spread", "stiffening", "width"))
    outer, inner = (ca.sqrt(ca.fmax(x**2 - (1 + sign * width) * d, _THINNEST)) for sign in (1, -1))
    g = 2 / (outer + inner)
    cubed = g / (outer * inner)
    squares = d**2 * (1 + width**2 / 3)  # mean of the rings' D^2
    once = x**2 + d / 2 + 2 * g - 3  # mean of S
    twice = x**4 + 3 * x**2 * d + 3 / 8 * squares + 4 * x * (1 + cubed)  # of S^2, with 4 / L^2
    twice += 9 - 6 * (x**2 + d / 2) - 12 * g
    return x, d, a, width, (once + a * twice) / 2


def _straight(stretch: ca.SX, load: ca.SX, stiffening: ca.SX | float) -> ca.SX:
    """Return the stretch of a straight section after one more step."""
    surplus, stress = stretch**2 + 2 / stretch - 3, stretch - stretch**-2
    rise = 1 + 2 * stiffening * surplus
    slope = (1 + 2 * stretch**-3) * rise + 4 * stiffening * stress**2
    return stretch - (stress * rise - load) / slope


@cache
def _newton() -> ca.Function:
    """Return one step for lambda and c, from ``N / (mu A)`` and ``D / c^2``."""
    x, d, a, width, energy = _energy()
    c, load, squared = (ca.SX.sym(name) for name in ("c", "load", "squared"))
    wrong = ca.vertcat(ca.gradient(energy, x) - load, 2 * c * ca.gradient(energy, d) - 1)
    wrong = ca.substitute(wrong, d, squared * c**2)
    step = ca.inv_minor(ca.jacobian(wrong, ca.vertcat(x, c))) @ wrong
    names = [x, c, load, squared, a, width]
    return ca.Function("newton", names, ca.cse([x - step[0], c - step[1]]))


@cache
def _second_derivatives() -> ca.Function:
    """Return the derivatives of w by lambda twice, by lambda and D, by D, and by D twice."""
    x, d, a, width, energy = _energy()
    by_x, by_d = ca.gradient(energy, x), ca.gradient(energy, d)
    found = [ca.gradient(by_x, x), ca.gradient(by_x, d), by_d, ca.gradient(by_d, d)]
    return ca.Function("second", [x, d, a, width], ca.cse(found))
