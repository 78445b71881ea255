"""What the executed pages share: cells for the shell, and how figures look."""

import os
import subprocess

import matplotlib.pyplot as plt
from IPython.core.magic import register_cell_magic

os.environ.pop("FORCE_COLOR", None)  # which the notebook's kernel sets
plt.rcParams.update({"figure.dpi": 110, "axes.spines.top": False, "axes.spines.right": False})


@register_cell_magic
def sh(line: str, cell: str) -> None:
    """Run a cell as a shell would outside of a terminal; `%%sh checkout`: in the checkout.

    What it notes meanwhile (on stderr) is shown only if it fails.
    """
    folder = os.environ["STIFFOPT_CHECKOUT"] if line == "checkout" else None
    done = subprocess.run(cell, cwd=folder, shell=True, text=True, capture_output=True)
    print(done.stdout, end="")
    if done.returncode:
        raise RuntimeError(done.stderr)
