"""Types of arrays in annotations; docstrings tell their shapes and units."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""
Flags = NDArray[np.bool_]
