"""How the documentation site is made: `make docs`."""

import os
import re
import sys
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode, literal_block
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx_gallery.scrapers import figure_rst

import stiffopt

HERE = Path(__file__).resolve().parent

project = "stiffopt"
author = "The stiffopt authors"
project_copyright = author
extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["gallery/*", "auto_gallery/*.ipynb", "**sg_execution_times.rst"]

# -- Pages ----------------------------------------------------------------------------------------

source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 4
suppress_warnings = ["config.cache"]  # of sphinx_gallery_conf, which has a function
nitpicky = True
nitpick_ignore_regex = [("py:.*", r".*")]  # types in docstrings are words for people

# -- Notebooks: executed at each build, away from the checkout ------------------------------------

nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_render_markdown_format = "gfm"
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
os.environ.pop("MPLBACKEND", None)  # notebooks show figures in place
os.environ |= {
    "COLUMNS": "84",
    "NO_COLOR": "1",
    "PYTHONPATH": os.pathsep.join(filter(None, (str(HERE), os.environ.get("PYTHONPATH")))),
    "STIFFOPT_CHECKOUT": str(HERE.parent),
    "STIFFOPT_COMPILE": "wait",
}

# -- Gallery --------------------------------------------------------------------------------------


def _figure_of_script(block: Any, variables: dict[str, Any], settings: dict[str, Any]) -> str:
    """Save what a script calls `figure`; stiffopt's figures are not pyplot's."""
    figure = variables["example_globals"].pop("figure", None)
    if figure is None:
        return ""
    path = next(variables["image_path_iterator"])
    figure.savefig(path, dpi=100)
    return figure_rst([path], settings["src_dir"])


sphinx_gallery_conf = {
    "image_scrapers": (_figure_of_script,),
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "filename_pattern": r"\.py$",
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
}

# -- Python ---------------------------------------------------------------------------------------

autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "model_config, model_post_init"}
default_role = "code"  # what docstrings have in single backticks
for _name in stiffopt.__all__:  # as users do: autodoc would import with typing.TYPE_CHECKING set
    getattr(stiffopt, _name)
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

# -- HTML -----------------------------------------------------------------------------------------

html_theme = "furo"
html_title = "stiffopt"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False


def _inline_mathml(translator: Any, node: Any) -> None:
    translator.body.append(_mathml(node))
    _skip()


def _display_mathml(translator: Any, node: Any) -> None:
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    translator.body.append(_mathml(node, "block"))
    translator.body.append("</div>\n")
    _skip()


def _skip() -> None:
    raise SkipNode


def _mathml(node: Any, display: str = "inline") -> str:
    """A formula as MathML; `tfrac` is unknown to the converter, and primes come out too small."""
    found = convert(node.astext().replace(r"\tfrac", r"\frac").strip(), display=display)
    prime = r"<msup>(<mi>[^<]*</mi>)<mi>(&#x0203[23];)</mi></msup>"
    return re.sub(prime, r'<mrow>\1<mo lspace="0" rspace="0">\2</mo></mrow>', found)


def _shell_cells(app: Sphinx, tree: Any) -> None:
    """Cells that the shell runs look like a terminal."""
    for block in tree.findall(literal_block):
        if block.astext().startswith("%%sh"):
            lines = block.astext().splitlines()[1:]
            shown = "\n".join(f"$ {line}" for line in lines)
            block.replace_self(literal_block(shown, shown, language="console"))


def _links_out_of_docs(app: Sphinx, page: str, source: list[str]) -> None:
    """Files of the checkout that a page links to are downloads; other folders are only named."""
    folder = (HERE / page).parent

    def link(found: re.Match[str]) -> str:
        text, target = found.groups()
        return f"[{text}](path:{target})" if (folder / target).is_file() else text

    source[0] = re.sub(r"\[([^]]+)\]\((\.\./[^)#]+)\)", link, source[0])
    source[0] = source[0].replace("](gallery/)", "](auto_gallery/index.rst)")


def setup(app: Sphinx) -> None:
    """Formulas are MathML, which needs neither the internet nor a script."""
    app.add_html_math_renderer("mathml", (_inline_mathml, None), (_display_mathml, None))
    app.connect("source-read", _links_out_of_docs)
    app.connect("doctree-read", _shell_cells)
