"""An answer as data: a line of JSON in SI units, and an entry of a result file with its units."""

import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stiffopt.cli.answer import Answer, measures_of
from stiffopt.optimise.pareto import smallest_stiffness
from stiffopt.optimise.solution import PressureSolution, Sensitivities
from stiffopt.optimise.task import StiffnessMeasure
from stiffopt.units import format_quantity
