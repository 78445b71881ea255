"""How objects show themselves in a notebook: by a page that `stiffopt.plots` makes of them.

The classes that are shown know nothing of figures, so that the module that does is imported when a
notebook asks for a page.
"""

from html import escape
from importlib import import_module

_PAGES = "stiffopt.plots.pages"


class ShownInNotebook:
    """A class of which notebooks show a small table, and a figure if matplotlib is installed."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        """Return HTML; it compiles nothing, takes no longer than a glance, and never fails."""
        try:
            return str(import_module(_PAGES).page(self))
        except Exception:
            return f"<pre>{escape(_text(self))}</pre>"


def _text(shown: object) -> str:
    try:
        return repr(shown)
    except Exception:
        return type(shown).__name__
