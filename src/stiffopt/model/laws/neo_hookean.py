"""The strain law `neo-hookean`: incompressible silicone that softens as it stretches."""

from __future__ import annotations

import casadi as ca

from stiffopt.model.actuation import Section, StrainLaw, bending_matrix
from stiffopt.model.segment import Segment
from stiffopt.schema import BadKeyError


class NeoHookeanLaw(StrainLaw):
    """Incompressible neo-Hookean section, per reference length.

    With ``mu = E / 3`` and chambers of constant bore (fibre-reinforced), the pressure force N
    stretches the section by the positive root of ``lambda - lambda^-2 = N / (mu A)``.  The
    section shrinks by ``a = lambda^-1/2``, and the lever arms of the chambers with it.  About that
    state the section has (per reference length, in shrunk axes)

    * axial stiffness ``E_t A`` with the tangent modulus ``E_t = mu (1 + 2 lambda^-3)``,
    * bending stiffness ``E_t I a^2``, moment ``a sum P A_c r``,
    * shear stiffness ``mu A`` and torsional stiffness ``mu J a^2``,

    exact for the strain to first order in curvature, and for the compliance where the segment
    is straight; the coupling of stretch and bending that grows with curvature is neglected.

    Compensation coefficients are those of `LinearLaw`: E, A and I are the compensated
    ones, the stiffnesses against loads use mu of the loaded modulus, the bending radius limits
    the curvature per reference length, and lengthening affects only the stretch of the shape.
    """

    name = "neo-hookean"
    words = "incompressible neo-Hookean silicone"
    complexity = 2
    limit = "the pressure brings this segment beyond the neo-Hookean law's range"
    _lowest_load = -1.8  # the closed-form root below is real down to -3 / 2^(2/3) = -1.89

    @classmethod
    def check(cls, segment: Segment) -> None:
        """Require an incompressible material; see `StrainLaw.check`."""
        super().check(segment)
        if segment.material.poisson_ratio != 0.5:
            raise BadKeyError(
                "material.poisson_ratio",
                f"the {cls.name} law is incompressible; expected 0.5, "
                f"not {segment.material.poisson_ratio:g}",
            )

    def _load(self, acting: ca.SX) -> ca.SX:
        """Return the axial load N / (mu A) of the acting pressures."""
        mu = self._modulus(acting) / 3
        return self._axial_force(acting) / (mu * (self.compensation.area * self.geometry.area))

    def margin(self, p: ca.SX) -> ca.SX:
        """Return the distance of the load from the largest compression, or the modulus margin."""
        margin = self._load(self._acting(p)) - self._lowest_load
        if ca.SX(self.compensation.modulus_per_pressure).is_zero():
            return margin
        return ca.fmin(margin, self._modulus_margin(p))

    def radius(self, p: ca.SX) -> ca.SX:
        """Return the outer radius ``r lambda^-1/2`` of the stretched section, in m."""
        return self.segment.outer_radius / ca.sqrt(neo_hookean_stretch(self._load(self._acting(p))))

    def section(self, p: ca.SX) -> Section:
        """Return the section about the stretched state; see `StrainLaw.section`."""
        geometry = self.geometry
        area = self.compensation.area * geometry.area
        inertia = self.compensation.inertia * ca.SX(geometry.second_moment)
        acting = self._acting(p)
        stretch = neo_hookean_stretch(self._load(acting))
        rise = 1 + 2 * stretch**-3  # E_t / mu
        shrink = 1 / ca.sqrt(stretch)
        mu, loaded = self._modulus(acting) / 3, self._loaded_modulus(acting) / 3
        omega, flexibility = self._bent(
            ca.inv_minor(mu * rise * bending_matrix(inertia) / stretch)
            @ (shrink * self._moment_about_centroid(acting)),
            ca.inv_minor(loaded * rise * bending_matrix(inertia) / stretch),
        )
        centroid = shrink * ca.SX(geometry.centroid)
        compliance = self._about_axis(
            self._compliance_about_centroid(
                shear=loaded * area,
                axial=loaded * rise * area,
                flexibility=flexibility,
                torsion=loaded * ca.trace(inertia) / stretch,
            ),
            centroid,
        )
        along = self._lengthened(stretch, omega) + omega[1] * centroid[0] - omega[0] * centroid[1]
        return Section(ca.vertcat(0, 0, along, omega, 0), compliance)


def neo_hookean_stretch(load: ca.SX) -> ca.SX:
    """Return the stretch of an incompressible neo-Hookean bar: ``lambda - lambda^-2 = load``.

    The one positive root of ``lambda^3 - load lambda^2 - 1 = 0`` by Cardano's formula, real
    for ``load > -3 / 2^(2/3)``.
    """
    third = load / 3
    half_q = third**3 + 0.5
    root = half_q + ca.sqrt(third**3 + 0.25)
    u = root ** (1 / 3)
    return third + u + third**2 / u
