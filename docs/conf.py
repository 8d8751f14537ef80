"""The site of mdnum's documents: `sphinx-build -W docs site` builds it without a network.

Notebooks (docs/tutorials) are executed where MDNUM_DOCS_EXECUTE is "cache" (those that have changed) or
"force" (all); otherwise they are built without output, in seconds.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

from mdnum.version import __version__  # noqa: E402

project = "mdnum"
author = "mdnum developers"
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml", "reference"]
exclude_patterns = ["_ext", "_build", "**/.ipynb_checkpoints"]

# what is public is mdnum.NAME, wherever it is defined
add_module_names = False

# dollar signs are mathematics
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = os.environ.get("MDNUM_DOCS_EXECUTE", "off")
# what a notebook writes, runs/ in most, is not left beside the pages
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

# blocks without a language are output of commands
highlight_language = "text"
html_theme = "pydata_sphinx_theme"
html_title = f"mdnum {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
# pages without others below them have nothing to navigate
html_sidebars = {"index": [], "start": []}
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 7,
    "navigation_with_keys": False,
    "show_toc_level": 1,
    "footer_start": ["copyright"],
    "footer_end": [],
}
copyright = "mdnum developers, Apache License 2.0"


def _own_pages(app, docname, source):
    """On the site, what lies beside docs/ has a page that includes it."""
    source[0] = source[0].replace("](../CONTRIBUTING.md", "](contributing.md")


def setup(app):
    """Sphinx calls it."""
    app.connect("source-read", _own_pages)
