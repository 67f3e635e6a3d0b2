"""Sphinx extension: check the finished site.

A build with ``-W`` fails if a link leads to a page or an anchor that does not exist, or
if a public name has no entry.
"""

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

import written_pages
from sphinx.application import Sphinx
from sphinx.util import logging

_log = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("build-finished", check_site)
    return {"parallel_read_safe": True}


def check_site(app: Sphinx, failure: Exception | None) -> None:
    """Warn of broken links and of public names without an entry."""
    if failure is not None or app.builder.name != "html":
        return
    for page, link in broken_links(Path(app.outdir)):
        _log.warning("%s: the link %s leads nowhere", page, link)
    described = app.env.get_domain("py").data["objects"]
    environments = {cls.__name__ for cls, _ in written_pages.ENVIRONMENTS.values()}
    for package, names in written_pages.public_names().items():
        for name in set(names) - environments:
            if f"{package}.{name}" not in described:
                _log.warning("%s.%s has no page", package, name)


def broken_links(site: Path) -> Iterator[tuple[str, str]]:
    """Yield (page, link) of each link inside a site that has no target."""
    pages = {
        path.resolve(): _Page(path)
        for path in site.rglob("*.html")
        if "_static" not in path.parts
    }
    for path, page in pages.items():
        for link in page.links:
            address, anchor = urldefrag(link)
            target = (path.parent / unquote(address)).resolve() if address else path
            known = pages[target].anchors if target in pages else {anchor}
            if not target.exists() or (anchor and unquote(anchor) not in known):
                yield path.relative_to(site.resolve()).as_posix(), link


class _Page(HTMLParser):
    """The anchors of a page, and its links that stay inside the site."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors = {""}
        self.links: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect what a tag names and where it leads."""
        for key, value in attrs:
            if key == "id" and value:
                self.anchors.add(value)
            elif key in {"href", "src"} and value and not re.match(r"\w+:|//", value):
                self.links.add(value.split("?")[0])
