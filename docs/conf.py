# SPDX-License-Identifier: Apache-2.0
"""Settings of Sphinx for these pages: `make docs`, or rosdoc2 in a sourced workspace."""

import importlib.util
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import paul_ros

project = "paul_ros"
author = "The paul_ros authors"
copyright = "The paul_ros authors, Apache-2.0"
version = release = paul_ros.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
# Formulas are drawn by MathJax beside the pages, for readers without the internet. rosdoc2 may lack the package: the
# pages then load MathJax from its web site.
if importlib.util.find_spec("sphinx-mathjax-offline"):
    extensions.append("sphinx-mathjax-offline")
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_use_ivar = True

html_theme = "furo"
html_title = "paul_ros"
html_static_path = [str(Path(__file__).resolve().parent / "style")]
html_css_files = ["pages.css"]
# rosdoc2 adds its own index, a page for each module and the README: these pages stand in their place, in their theme.
exclude_patterns = ["*.rst", "standard_docs"]
rosdoc2_settings = {"override_theme": False}
