"""The strain law `rest-length`: linear fibres, per length at rest."""

from stiffopt.model.laws.paper import LinearLaw


class RestLengthLaw(LinearLaw):
    """The paper's formulas per length at *rest*, as linear fibres have it.

    A fibre's stress follows its length over that at rest, whatever the others do; so stretch and
    bending do not mix.
    """

    name = "rest-length"
    words = "linear fibres per length at rest"
    complexity = 1
    per_deformed_length = False
