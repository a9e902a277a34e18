"""Links of the built site: each one within it leads to a page and an anchor that exist."""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

from sphinx.errors import ExtensionError


class _Page(HTMLParser):
    """What a page links and which anchors it has."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors = set(), {"", "top"}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.anchors.add(values.get("id") or (values.get("name") if tag == "a" else None) or "")
        self.links |= {values[key] for key in ("href", "src") if values.get(key)}


def examine(folder):
    """Return the broken links within a site, as (page, link), and its external ones."""
    folder = Path(folder).resolve()
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in folder.rglob("*.html")}
    broken, external = [], set()
    for path, page in pages.items():
        for link in page.links:
            if urlsplit(link).scheme or link.startswith("//"):
                external |= set() if link.startswith(("data:", "mailto:")) else {link}
                continue
            place, anchor = urldefrag(link)
            place = place.partition("?")[0]
            target = (path.parent / unquote(place)).resolve() if place else path
            target = target / "index.html" if target.is_dir() else target
            is_there = target.is_file() and target.is_relative_to(folder)
            if not is_there or (target in pages and unquote(anchor) not in pages[target].anchors):
                broken.append((path.relative_to(folder).as_posix(), link))
    return sorted(broken), sorted(external)


def _check(app, error):
    """Fail where a link leads nowhere; list the external ones, which are not fetched."""
    if error is not None or app.builder.name != "html":
        return
    broken, external = examine(app.outdir)
    lines = "".join(f"{link}\n" for link in external)
    (Path(app.outdir) / "external_links.txt").write_text(lines, encoding="utf-8")
    if broken:
        raise ExtensionError("links that lead nowhere: " + "; ".join(map(" -> ".join, broken)))


def setup(app):
    """Sphinx calls this."""
    app.connect("build-finished", _check, priority=900)  # when every file is there
    return {"parallel_read_safe": True, "parallel_write_safe": True}
