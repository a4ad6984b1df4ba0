"""Settings of Sphinx: ``make docs`` builds the Markdown pages and the API reference."""

import importlib.metadata

project = "marl_pack"
release = importlib.metadata.version("marl_pack")
author = copyright = "the authors of marl_pack"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/contents"
include_patterns = ["*.md", "docs/*.md", "docs/notes/*.md", "docs/*.rst", "models/*.md"]
myst_heading_anchors = 4
suppress_warnings = [
    "myst.xref_missing",  # links to folders; tests/test_pages.py follows all links
    "ref.python",  # an attribute of two classes
]

napoleon_use_ivar = True  # attributes that are properties too are described once
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": True}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"

html_theme = "furo"
html_title = "marl_pack"
