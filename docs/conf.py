"""How Sphinx builds the site: ``make docs``."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import holdfast

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"

project = "holdfast"
author = "The holdfast developers"
copyright = "The holdfast developers. Licence: Apache-2.0"  # noqa: A001 - Sphinx's name
release = version = holdfast.__version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_copybutton",
    "sphinx_design",
]
templates_path = ["templates"]
exclude_patterns = ["results/*/**", "templates"]

# Every link and every name must lead somewhere; `make docs` makes a warning an error.
nitpicky = False
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4

# Tutorials are run at every build, each in a process of its own, and must not fail.
nb_execution_mode = "force"
nb_execution_timeout = 120
nb_execution_raise_on_error = True
nb_merge_streams = True

autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "pydata_sphinx_theme"
html_title = "holdfast"
html_theme_options = {
    "navigation_with_keys": False,
    "collapse_navigation": True,
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
    "navbar_align": "left",
}
html_sidebars = {"index": []}
html_show_sourcelink = False

PAGES = {
    "start": "README.md",
    "architecture": "ARCHITECTURE.md",
    "changelog": "CHANGELOG.md",
    "contributing": "CONTRIBUTING.md",
    "benchmarks": "benchmarks/RESULTS.md",
    "laboratory": "lab/README.md",
}
"""Pages of the site that are files of the repository, which a forge shows as well."""

RESULTS_BELOW = """
```{toctree}
:hidden:

results/mujoco_peg
results/taskboard
benchmarks
```
"""
"""Pages below docs/results.md, which a forge shows without."""

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s#:]+)(#[^()\s]*)?\)")


def adapt(app: Any, page: str, source: list[str]) -> None:
    """Give a page the text of its file, and let its links to the repository lead somewhere."""
    del app
    path = ROOT / PAGES[page] if page in PAGES else DOCS / f"{page}.md"
    if not path.is_file():
        return  # made by autosummary
    text = path.read_text(encoding="utf-8") if page in PAGES else source[0]
    here = (DOCS / page).parent
    own = {(ROOT / file).resolve(): DOCS / f"{name}.md" for name, file in PAGES.items()}

    def replaced(match: re.Match[str]) -> str:
        image, words, target, anchor = match.groups(default="")
        file = (path.parent / target).resolve()
        file = own.get(file, file)
        if file.is_dir() and (file / "README.md").resolve() in own:
            file = own[(file / "README.md").resolve()]
        if file.is_dir():
            return f"{words} (`{file.relative_to(ROOT)}`)"
        return f"{image}[{words}]({os.path.relpath(file, here)}{anchor})"

    if page == "start":
        text = text.replace("# holdfast", "# Start", 1)
    if page == "results":
        text += RESULTS_BELOW
    source[0] = _LINK.sub(replaced, text).replace("```mermaid", "```text")


def setup(app: Any) -> None:
    """Register what adapts the pages."""
    app.connect("source-read", adapt)
