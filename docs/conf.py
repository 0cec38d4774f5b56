"""The site's settings. Build it with ``make docs``; no page needs the network."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

import lesson  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402

import sb3_reinforce  # noqa: E402

project = "sb3_reinforce"
author = "The sb3_reinforce developers"
version = release = sb3_reinforce.__version__
html_title = f"sb3_reinforce {version}"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.doctest", "sphinx_copybutton", "mathml", "public_names"]
exclude_patterns = ["_build", "_ext", "conf.py"]
html_theme = "furo"
html_theme_options = {"navigation_with_keys": True}
html_show_copyright = False
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["colon_fence", "dollarmath"]
html_math_renderer = "mathml"
myst_heading_anchors = 3

# The tutorial's pages are examples/*.py. A page is executed again only when its code has changed
lesson.copy_pages(HERE.parent / "examples", HERE / "lesson")
nb_custom_formats = {".py": "lesson.read"}
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 180
# Progress bars, which also say what Jupyter lacks for them
nb_output_stderr = "remove"
os.environ["PYTHONWARNINGS"] = "ignore::UserWarning:rich.live"

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "undoc-members": True, "no-value": True, "show-inheritance": True}
python_use_unqualified_type_names = True

doctest_test_doctest_blocks = "default"
linkcheck_anchors_ignore_for_url = [r"https://github\.com/.*"]


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", lesson.link_pages)
