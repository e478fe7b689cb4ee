"""Sphinx configuration; ``make docs`` makes the pages."""

from sb3_ctco import __version__

project = "sb3-ctco"
copyright = "the sb3-ctco developers"  # Sphinx asks for this name.
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.viewcode"]
# No mathematics extension: formulas are plain text, because MathJax would be fetched from the net.
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"sb3-ctco {__version__}"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
