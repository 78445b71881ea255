"""What the executed pages share: cells for the shell, and how figures look."""

import os
import subprocess

import matplotlib.pyplot as plt
from IPython.core.magic import register_cell_magic

os.environ.pop("FORCE_COLOR", None)  # which the notebook's kernel sets
plt.rcParams.update({"figure.dpi": 110, "axes.spines.top": False, "axes.spines.right": False})


@register_cell_magic
def sh(_line: str, cell: str) -> None:
    """Run a cell as a shell would outside of a terminal, and print all that it says at its end."""
    done = subprocess.run(cell, shell=True, text=True, stdout=-1, stderr=subprocess.STDOUT)
    print(done.stdout, end="")
    done.check_returncode()
