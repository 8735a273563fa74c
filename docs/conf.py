"""The site of the documentation: `make docs`.

Pages stay where they are in the repository, with links that work there as well. The navigation is
that of docs/README.md: a page that is not linked there fails the build, and so does a broken link.
"""

import re
import shutil
from importlib import metadata
from pathlib import Path
from posixpath import join, normpath
from typing import Any

from sphinx.application import Sphinx

project = "tactomo"
release = metadata.version("tactomo")
root_doc = "README"
include_patterns = ["*.md", "docs/**", "deploy/*.md", "clients/**.md", "firmware_protocol/**.md"]
include_patterns += ["models/**.md"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
napoleon_use_ivar = True  # a list of attributes, not a heading for each
autodoc_default_options = {"members": True, "member-order": "bysource"}
python_maximum_signature_line_length = 88
default_role = "code"  # `name` in docstrings
html_theme = "furo"  # nothing of it comes from elsewhere, fonts neither
html_title = f"tactomo {release}"
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = html_show_sourcelink = html_show_copyright = False


def add_navigation(_: Sphinx, name: str, source: list[str]) -> None:
    """Append to the first page a table of contents, of the pages that docs/README.md links."""
    if name != root_doc:
        return
    index = Path(__file__).with_name("README.md").read_text("utf-8")
    source[0] += "\n```{toctree}\n:hidden:\n\ndocs/README\n```\n"
    for section in index.split("\n## ")[1:]:
        links = re.findall(r"\]\(([^)]+\.(?:md|rst))\)", section)
        pages = "\n".join(normpath(join("docs", link)) for link in links)
        caption = section.partition("\n")[0]
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{pages}\n```\n"


def escape_bars(*arguments: Any) -> None:
    """Take |x| in docstrings for an absolute value, not for a substitution."""
    lines: list[str] = arguments[-1]
    lines[:] = [line.replace("|", r"\|") for line in lines]


def add_index(app: Sphinx, failure: Exception | None) -> None:
    """Begin at index.html, and list the versions that lie beside this one."""
    if failure:
        return
    site = Path(app.outdir)
    shutil.copy(site / f"{root_doc}.html", site / "index.html")
    versions = sorted(path.parent.name for path in site.parent.glob("*/index.html"))
    links = "".join(f'<li><a href="{each}/index.html">{each}</a></li>' for each in versions)
    (site.parent / "index.html").write_text(f"<title>tactomo</title><ul>{links}</ul>", "utf-8")


def setup(app: Sphinx) -> None:
    """Connect the above."""
    app.connect("source-read", add_navigation)
    app.connect("autodoc-process-docstring", escape_bars)
    app.connect("build-finished", add_index)
