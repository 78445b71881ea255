"""The strain law `rest-length`: linear fibres, per length at rest."""

from stiffopt.model.laws.paper import LinearLaw


class RestLengthLaw(LinearLaw):
    """The paper's formulas per length at *rest*, which is exact for linear fibres.

    A fibre's stress depends on its own length over that at rest, so stretch and bending are
    independent.
    """

    name = "rest-length"
    words = "linear fibres per length at rest"
    complexity = 1
    per_deformed_length = False
