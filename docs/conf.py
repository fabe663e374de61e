"""Sphinx configuration of the documentation site (`make docs`)."""

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "cavbench"
author = "the authors of cavbench"
version = release = metadata.version("cavbench")
# The address is set once, as "Documentation" in [project.urls] of pyproject.toml: a folder with one site for each version.
_addresses = dict(entry.split(", ", 1) for entry in metadata.metadata("cavbench").get_all("Project-URL") or ())
html_baseurl = f"{_addresses['Documentation'].rstrip('/')}/{release}/" if "Documentation" in _addresses else ""
language = "en-GB"

extensions = ["myst_parser", "sphinx.ext.autodoc", "cavbench_site"]
exclude_patterns = ["_build", "_ext"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
# Docstrings mark names with `single backticks`.
default_role = "code"

html_theme = "furo"
html_title = f"cavbench {release}"
html_show_search_summary = True
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_math_renderer = "mathml"
highlight_language = "none"
