"""Where the recordings of real arms are, which are no part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("STIFFOPT_DATA", Path(__file__).resolve().parent.parent.parent))
DATA = ROOT / "shared/data"


def recordings(pattern: str) -> list[Path]:
    """Return the files whose path below the folder of recordings matches, in order of name."""
    return sorted(DATA.glob(pattern))


UCL = recordings("ucl_stiff_flop_58mm/*.csv")
ASU = recordings("asu_*/*.csv")

needs_ucl = pytest.mark.skipif(not UCL, reason=f"the UCL recordings are not in {DATA}")
needs_asu = pytest.mark.skipif(not ASU, reason=f"the ASU recordings are not in {DATA}")
