"""Sphinx's settings. Built by `make docs`, where a warning is an error."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

import sb3_gae  # noqa: E402

project = "sb3-gae"
author = "sb3-gae authors"
copyright = f"2026, {author}"
version = release = sb3_gae.__version__

extensions = [
    "myst_parser",
    "listed_members",
    "mathml",
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown"}
nitpicky = True
# Names within SB3's aliases and NumPy's ArrayLike, and classes whose projects are not linked to
nitpick_ignore = [
    ("py:class", "BaseCallback"),
    ("py:class", "VecEnv"),
    ("py:class", "collections.abc.Mapping[str"),
    ("py:class", "collections.abc.Callable[[]"),
]
nitpick_ignore_regex = [("py:class", r"numpy\._typing\..*|pandas\..*|optuna\..*|.*\._[A-Z]\w*")]

myst_enable_extensions = ["colon_fence", "dollarmath", "fieldlist"]
# Headings are linked to across pages by the names that GitHub gives them
myst_heading_anchors = 3

doctest_global_setup = """
import numpy as np

from sb3_gae.estimators.advantages import *
from sb3_gae.estimators.measures import *
"""

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
# No default for members: it would take the place of each list of them
autodoc_default_options = {"show-inheritance": True}

# Inventories of what is linked to lie here: a build reaches nothing outside the machine
intersphinx_mapping = {
    "gymnasium": ("https://gymnasium.farama.org", "inventories/gymnasium.txt"),
    "numpy": ("https://numpy.org/doc/stable", "inventories/numpy.txt"),
    "python": ("https://docs.python.org/3", "inventories/python.txt"),
    "sb3": ("https://stable-baselines3.readthedocs.io/en/master", "inventories/sb3.txt"),
    "sb3-contrib": ("https://sb3-contrib.readthedocs.io/en/master", "inventories/sb3-contrib.txt"),
    "torch": ("https://docs.pytorch.org/docs/stable", "inventories/torch.txt"),
}

html_theme = "furo"
html_title = f"sb3-gae {version}"
html_static_path = ["_static"]
html_css_files = ["book.css"]
