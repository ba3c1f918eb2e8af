"""Settings of the documentation: sphinx-build -W docs docs/_build. Nothing is fetched from a network."""

import sys
from pathlib import Path

import todframes

sys.path.insert(0, str(Path(__file__).parent))

project = "todframes"
author = "the todframes developers"
copyright = author  # noqa: A001
release = todframes.__version__

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "command_pages"]
exclude_patterns = ["_build"]
templates_path = ["_templates"]
default_role = "literal"
nitpicky = False

# Links of the form page.md#heading, as on any page that shows Markdown.
myst_heading_anchors = 4
smartquotes = False  # options that readers copy have two hyphens
myst_enable_extensions = ["colon_fence", "deflist"]

# A page for each name of the front doors, taken from their __all__.
autosummary_ignore_module_all = False
autosummary_imported_members = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False

html_search_scorer = str(
    Path(__file__).parent / "reference" / "commands" / "scorer.js"
)  # written by command_pages
html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"todframes {release}"
html_copy_source = False
html_show_sourcelink = False
html_sidebars = {"index": [], "tutorials/*": []}
html_theme_options = {
    "logo": {"text": "todframes"},
    "navbar_end": ["theme-switcher"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": True,
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
}
