"""Display of objects in notebooks, by pages that `stiffopt.plots` generates.

The displayed classes do not depend on figures; `stiffopt.plots` is imported only when a notebook
requests a page.
"""

from html import escape
from importlib import import_module

_PAGES = "stiffopt.plots.pages"


class ShownInNotebook:
    """Base of classes that notebooks display as a table, and as a figure given matplotlib."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        """Return HTML; this compiles nothing, is fast, and never fails."""
        try:
            return str(import_module(_PAGES).page(self))
        except Exception:
            return f"<pre>{escape(_text(self))}</pre>"


def _text(shown: object) -> str:
    try:
        return repr(shown)
    except Exception:
        return type(shown).__name__
