"""Sphinx settings of the site: ``sphinx-build -W -n docs docs/_build``."""

import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst
from sphinx_gallery.sorting import FileNameSortKey

import slamgym

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

project = "slamgym"
author = copyright = "The slamgym developers"
version = release = slamgym.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "written_pages",  # _ext/written_pages.py: pages made from the package itself
    "site_checks",  # _ext/site_checks.py: links, anchors and public names
]
exclude_patterns = ["_build", "_ext", "_templates", "tutorials", "**/GALLERY_HEADER.*"]
suppress_warnings = ["config.cache"]  # functions among the settings below
templates_path = ["_templates"]

html_theme = "pydata_sphinx_theme"
html_title = "slamgym"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"
html_css_files = ["site.css"]
html_theme_options = {
    "header_links_before_dropdown": 10,
    "navbar_align": "left",
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
    "pygments_light_style": "tango",
    "pygments_dark_style": "monokai",
}
html_sidebars = dict.fromkeys(("index", "homework", "logs"), ())  # no subpages
html_context = {"default_mode": "auto"}  # dark where the system is
html_show_sourcelink = False
toc_object_entries_show_parents = "hide"
html_domain_indices = False

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 4

autosummary_generate = True
autosummary_ignore_module_all = False
autodoc_inherit_docstrings = False
autodoc_typehints = "none"  # the docstrings give types, shapes and units
_OUTSIDE = ("BaseModel", "BaseException", "Env", "Generic", "Protocol", "VectorEnv")
_OUTSIDE += ("VectorWrapper", "Wrapper", "tuple")
autodoc_default_options = {
    "members": True,
    "inherited-members": ",".join(_OUTSIDE),  # but not those of these
    "exclude-members": "move_kernel, update_kernel",  # for those who write a filter
}
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
intersphinx_mapping: dict[str, tuple[str, None]] = {}  # the build uses no network


def figures_of(block: object, block_vars: dict[str, Any], conf: dict[str, Any]) -> str:
    """Save the figures that a block of a tutorial made, with or without pyplot."""
    figures = {
        id(value): value
        for value in block_vars["example_globals"].values()
        if isinstance(value, Figure)
    }
    paths = []
    for figure in figures.values():
        if getattr(figure, "is_shown", False):
            continue
        figure.is_shown = True
        path = next(block_vars["image_path_iterator"])
        figure.savefig(path, dpi=110)
        paths.append(path)
    return figure_rst(paths, conf["src_dir"])


sphinx_gallery_conf = {
    "examples_dirs": ["tutorials"],
    "gallery_dirs": ["learn"],
    "filename_pattern": r"/plot_",
    "within_subsection_order": FileNameSortKey,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,  # a page with scripts of other servers
    "capture_repr": (),
    "abort_on_example_error": True,
    "image_scrapers": (figures_of,),
    "default_thumb_file": str(HERE / "images/honest_ellipses.png"),
}
