"""The strain law `paper`: linear fibres, per deformed length (eqs 8-10)."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca

from stiffopt.model.actuation import Section, StrainLaw, bending_matrix


class LinearLaw(StrainLaw):
    """Linear fibres with compensation coefficients lambda (eqs 8-10).

    ``lambda_E = E + slope |p|``, ``lambda_A = a A``, ``lambda_I = i I``; elongation
    ``f_z l / (E A)``; curvature ``M / (E I)`` and compliance per the length that the subclass
    names.  If the centroid is off the axis, which the paper does not treat, all this holds for
    the line of centroids, and the compensated second moment is that about the centroid.

    The modulus against loads is ``stiffness (E + softening slope |p|)``, the paper's own where both
    factors are 1.  With a least bending radius R, the curvature is
    ``kappa / sqrt(1 + R^2 |kappa|^2)`` instead, and its derivative by the moment is the flexibility
    under loads.  See `stiffopt.model.segment.Compensation`.
    """

    limit = "the pressure drives the compensated modulus of this segment to zero"
    per_deformed_length: ClassVar[bool]
    """Whether curvature and compliance are per deformed length, or per length at rest."""

    def margin(self, p: ca.SX) -> ca.SX:
        """Return the compensated modulus over a thousandth of the nominal one, less one."""
        return self._modulus_margin(p)

    def section(self, p: ca.SX) -> Section:
        """Return the section of eqs 8-10; see `StrainLaw.section`."""
        geometry = self.geometry
        area = self.compensation.area * geometry.area
        inertia = self.compensation.inertia * ca.SX(geometry.second_moment)
        acting = self._acting(p)
        E = self._modulus(acting)
        loaded = self._loaded_modulus(acting)
        G = loaded / (2 * (1 + self.segment.material.poisson_ratio))
        force, moment = self._axial_force(acting), self._moment_about_centroid(acting)
        kappa, flexibility = self._bent(
            ca.inv_minor(bending_matrix(inertia)) @ moment / E,
            ca.inv_minor(loaded * bending_matrix(inertia)),
        )
        compliance = self._about_axis(
            self._compliance_about_centroid(
                shear=G * area,
                axial=loaded * area,
                flexibility=flexibility,
                torsion=G * ca.trace(inertia),
            ),
            ca.SX(geometry.centroid),
        )
        c = geometry.centroid
        stretch = self._lengthened(1 + force / (E * area), kappa)  # of the line of centroids
        if self.per_deformed_length:
            strain = stretch * ca.vertcat(0, 0, 1 + kappa[1] * c[0] - kappa[0] * c[1], kappa, 0)
            return Section(strain, stretch * compliance)
        along = stretch + kappa[1] * c[0] - kappa[0] * c[1]
        return Section(ca.vertcat(0, 0, along, kappa, 0), compliance)


class PaperLaw(LinearLaw):
    """The paper's law: linear, per *deformed* length.

    Curvature and, integrated over deformed length, the compliance of eq. 17 are per deformed length
    (slip 8 of the notes); per length at rest both are multiplied by the stretch.
    """

    name = "paper"
    words = "linear fibres per deformed length"
    complexity = 0
    per_deformed_length = True
