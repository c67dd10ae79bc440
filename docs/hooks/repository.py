"""Pages of the site from files of the repository, without content from other hosts.

The README is the first page of the site, and the READMEs of the folders are pages too. Links are
written for the repository, so that they work there. This hook converts them to links of the site,
whose root is `docs/`.
"""

import html.parser
import pathlib
import posixpath
import re

from properdocs.exceptions import PluginError
from properdocs.structure.files import File

ROOT = pathlib.Path(__file__).parents[2]
PAGES = (
    "README.md",
    "benchmarks/README.md",
    "data_schema/README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
)
SHOWN = (
    "CITATION.cff",
    "LICENSE",
    "data_schema/example.h5",
    "data_schema/recording-1.json",
    "benchmarks/results/*.svg",
    "benchmarks/results/*.csv",
    "tests/baseline/*.png",
)
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")
FETCHED = {"script": "src", "img": "src", "iframe": "src", "source": "src"}


def on_files(files, config):
    """Add pages and files of the repository with the paths that they have there."""
    paths = [path for pattern in SHOWN for path in sorted(ROOT.glob(pattern))]
    for name in (*PAGES, *(path.relative_to(ROOT).as_posix() for path in paths)):
        files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown, page, config, files):
    """Convert links of the repository to links of the site."""
    shown = page.file.src_uri
    inside = page.file.abs_src_path and pathlib.Path(page.file.abs_src_path).relative_to(ROOT)
    if not inside:
        return markdown
    source, here = inside.parent.as_posix(), posixpath.dirname(shown)

    def moved(link):
        target = posixpath.normpath(posixpath.join(source, link[1]))
        target = target.removeprefix("docs/")
        if target.startswith("notebooks/"):
            target = posixpath.splitext(target)[0] + ".md"
        return posixpath.relpath(target, here or ".")

    return LINK.sub(moved, markdown)


def on_post_build(config):
    """Raise an error if a page needs the network."""
    for path in sorted(pathlib.Path(config.site_dir).rglob("*.html")):
        reader = _Fetched()
        reader.feed(path.read_text("utf-8"))
        if reader.elsewhere:
            raise PluginError(f"{path.name} fetches {', '.join(sorted(reader.elsewhere))}")


class _Fetched(html.parser.HTMLParser):
    """Addresses that a page loads from other hosts; ordinary links do not count."""

    def __init__(self):
        super().__init__()
        self.elsewhere = set()

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        loads = "stylesheet preload icon modulepreload preconnect dns-prefetch".split()
        name = FETCHED.get(tag)
        if tag == "link" and set((found.get("rel") or "").split()) & set(loads):
            name = "href"
        address = found.get(name) or ""
        if re.match(r"(\w+:)?//", address):
            self.elsewhere.add(address)
