"""How Sphinx builds the site: ``make docs``."""

from __future__ import annotations

import os
import re
import textwrap
from html import escape, unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import nbformat
from docutils import nodes
from myst_nb.core.read import read_myst_markdown_notebook
from myst_parser.config.main import MdParserConfig
from sphinx.errors import ExtensionError

import holdfast

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
NOTEBOOKS = ROOT / "build" / "notebooks"

project = "holdfast"
author = "The holdfast developers"
copyright = "The holdfast developers. Licence: Apache-2.0"  # noqa: A001 - Sphinx's name
release = version = holdfast.__version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["results/*/**"]
# A block without a language is a drawing or a session, not Python.
highlight_language = "none"

# MyST resolves links to pages and headings, and a warning is an error. `finish_pages` below then
# follows every link of the finished pages. `make docs-links` asks other sites, too.
linkcheck_timeout = 20
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4

# Tutorials are run at every build, each in a process of its own, and must not fail.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 180
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_static_path = ["static"]
html_css_files = ["site.css"]
html_search_scorer = str(DOCS / "static" / "scorer.js")
toc_object_entries = False  # headings have the names
html_extra_path = [str(NOTEBOOKS)]
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

BELOW = {
    "results": """
```{toctree}
:hidden:

gallery
results/mujoco_peg
results/taskboard
benchmarks
```
""",
    "decisions/README": """
```{toctree}
:hidden:
:glob:

*
```
""",
}
"""Lists of the pages below a page, which a forge has no use for."""

TUTORIALS = sorted(path.stem for path in (DOCS / "tutorials").glob("*.md") if path.stem != "index")

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s#:]+)(#[^()\s]*)?\)")
_MERMAID = re.compile(r"^```mermaid\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def adapt(app: Any, page: str, source: list[str]) -> None:
    """Give a page the text of its file, and let its links to the repository lead somewhere."""
    del app
    path = ROOT / PAGES[page] if page in PAGES else DOCS / f"{page}.md"
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
            where = file.relative_to(ROOT).as_posix()
            return f"`{where}`" if where.endswith(words.strip("/")) else f"{words} (`{where}`)"
        return f"{image}[{words}]({os.path.relpath(file, here)}{anchor})"

    if page == "start":
        text = text.replace("# holdfast", "# Start", 1)
    text += BELOW.get(page, "")
    if page.removeprefix("tutorials/") in TUTORIALS:
        name = page.removeprefix("tutorials/")
        offer = f'<p><a href="../{name}.ipynb" download>Download this page as a notebook</a></p>'
        text = re.sub(r"^(# .*)$", rf"\1\n\n{offer}", text, count=1, flags=re.MULTILINE)
    source[0] = _MERMAID.sub(lambda match: picture(match[1]), _LINK.sub(replaced, text))


def picture(mermaid: str) -> str:
    """Draw a state diagram whose states form a row, as SVG; a forge draws it by itself."""
    steps = re.findall(r"^\s*(\S+) --> (\w+)(?:: (.*))?$", mermaid, re.MULTILINE)
    names = list(dict.fromkeys(after for _, after, _ in steps))
    parts = ['<circle class="start" cx="210" cy="12" r="7"/>']
    for index, name in enumerate(names):
        y = 50 + 110 * index
        parts.append(f'<rect x="130" y="{y}" width="160" height="36" rx="8"/>')
        parts.append(f'<text x="210" y="{y + 23}" text-anchor="middle">{escape(name)}</text>')
    for before, after, label in steps:
        index = names.index(after)
        back = before in names and names.index(before) > index
        x, top = (250 if back else 170), 86 + 110 * (index if back else index - 1)
        if before == "[*]":
            x, top = 210, 20
        elif abs(names.index(before) - index) != 1:
            raise ExtensionError(f"docs/conf.py draws a row of states, not {before} --> {after}")
        ends = (top + 74, top + 3) if back else (top, top + (29 if before == "[*]" else 71))
        parts.append(f'<path d="M{x} {ends[0]}V{ends[1]}" marker-end="url(#arrow)"/>')
        anchor, beside = ("start", 262) if back else ("end", 158)
        for line, words in enumerate(textwrap.wrap(label, 18)):
            parts.append(
                f'<text x="{beside}" y="{top + 34 + 16 * line}" text-anchor="{anchor}">'
                f"{escape(words)}</text>"
            )
    said = "; ".join(f"from {a} to {b}: {why}" for a, b, why in steps if why)
    return (
        "```{raw} html\n"
        f'<svg class="states" viewBox="0 0 420 {110 * len(names)}" role="img" '
        f'aria-label="{escape(said)}"><defs><marker id="arrow" viewBox="0 0 8 8" refX="6" refY="4" '
        'markerWidth="7" markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z"/></marker></defs>'
        + "".join(parts)
        + "</svg>\n```"
    )


def name_columns(app: Any, tree: nodes.document) -> None:
    """Drop a table's empty head, and name an empty column for whoever hears the page."""
    del app
    for head in list(tree.findall(nodes.thead)):
        entries = list(head.findall(nodes.entry))
        if not any(entry.astext().strip() for entry in entries):
            head.parent.remove(head)
            continue
        for entry in entries:
            if not entry.astext().strip():
                entry.clear()
                entry += nodes.paragraph(
                    "", "", nodes.inline("", "row", classes=["visually-hidden"])
                )


def write_notebooks() -> None:
    """Write the tutorials as notebooks, without outputs, for the site to offer."""
    NOTEBOOKS.mkdir(parents=True, exist_ok=True)
    for name in TUTORIALS:
        text = (DOCS / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
        notebook = read_myst_markdown_notebook(text, config=MdParserConfig())
        nbformat.write(notebook, NOTEBOOKS / f"{name}.ipynb")


def check_names(app: Any, environment: Any) -> None:
    """Hold the reference to the public names: each is there, with an example that is run."""
    del app
    known = {each[0] for each in environment.get_domain("py").get_objects()}
    missing = [name for name in holdfast.__all__ if f"holdfast.{name}" not in known]
    for path in sorted((DOCS / "reference").glob("*.md")):
        sections = re.split(r"^## ", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
        missing += [
            f"an example of {each.splitlines()[0]} ({path.name})"
            for each in sections
            if "```{code-cell}" not in each
        ]
    if missing:
        raise ExtensionError(f"docs/reference lacks {', '.join(missing)}")


def finish_pages(app: Any, error: Exception | None) -> None:
    """Name what the theme and notebooks leave nameless, then follow every link.

    Files and anchors must exist; addresses of other sites must be well formed.
    """
    if error or app.builder.name != "html":
        return
    site = Path(app.outdir)
    pages = {}
    for path in site.rglob("*.html"):
        if path.parent.name != "_static":  # templates
            text = path.read_text(encoding="utf-8")
            text = text.replace("<summary><span", '<summary aria-label="pages below"><span')
            label = '<span class="visually-hidden">row</span>'
            pages[path] = text.replace("<th></th>", f"<th>{label}</th>")
            path.write_text(pages[path], encoding="utf-8")
    anchors = {path: set(re.findall(r'\bid="([^"]+)"', text)) for path, text in pages.items()}
    broken = set()
    for page, text in pages.items():
        for link in map(unescape, re.findall(r'\b(?:href|src)="([^"]*)"', text)):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                well_formed = parts.scheme in ("https", "http", "data", "mailto")
            else:
                target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
                anchor = unquote(parts.fragment)
                found = not anchor or target not in anchors or anchor in anchors[target]
                well_formed = target.exists() and found
            if not well_formed:
                broken.add(f"{page.relative_to(site)}: {link}")
    if broken:
        raise ExtensionError("links that lead nowhere:\n  " + "\n  ".join(sorted(broken)))


def setup(app: Any) -> None:
    """Register what adapts and checks the pages."""
    write_notebooks()
    app.connect("source-read", adapt)
    app.connect("doctree-read", name_columns)
    app.connect("env-check-consistency", check_names)
    app.connect("build-finished", finish_pages)
