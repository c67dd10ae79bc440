"""Tables for the terminal, and one self-contained HTML page of tables and pictures.

The page forbids every request, and every script except its own one, which sorts and searches long
tables. Labels and notes of a file can therefore do no harm, and the page looks the same with and
without a network.
"""

import base64
import dataclasses
import hashlib
import importlib.resources
import os
import re
import textwrap
from collections.abc import Mapping, Sequence

import jinja2
import markupsafe

from etid.recordings.replacing import replace_text


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells of text under headings.

    Args:
        columns: Headings.
        rows: Rows of cells. Each row has one cell for each heading.
        groups: Headings above the headings, each with the number of columns that it spans.
        caption: Text above the table.
        searchable: Whether the page lets the reader sort the table and search in it.
        folded: Whether the page shows the table, below the pictures, when the reader asks for it.
        links: Anchors of the page for cells of the first column.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    groups: tuple[tuple[str, int], ...] = ()
    caption: str = ""
    searchable: bool = False
    folded: bool = False
    links: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        columns, at, over = [], 0, ""
        for cells in zip(self.columns, *self.rows, strict=True):
            left, width = not columns or self.texts[len(columns)], max(map(len, cells))
            columns.append([cell.ljust(width) if left else cell.rjust(width) for cell in cells])
        for name, span in self.groups:
            over = f"{over:{sum(len(cells[0]) + 2 for cells in columns[:at])}}{name}"
            at += span
        lines = ("  ".join(line).rstrip() for line in zip(*columns, strict=True))
        return "\n".join([*filter(None, [self.caption, over]), *lines])

    @property
    def texts(self) -> list[bool]:
        """Whether each column holds words; such columns are aligned to the left."""
        columns = ([row[i] for row in self.rows if row[i]] for i in range(len(self.columns)))
        return [all(cell[:1].isalpha() for cell in column) for column in columns]


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture of a page.

    Args:
        caption: Text below the picture.
        svg: The picture.
        alt: Description for readers who cannot see the picture; the caption if not given.
        whole: Whether the picture needs the whole width of the page. Two other pictures share it.
        anchor: Name of the picture in a link; empty if there is no link to it.
    """

    caption: str
    svg: bytes
    alt: str = ""
    whole: bool = False
    anchor: str = ""

    @property
    def source(self) -> str:
        """The picture as a data URL."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg).decode('ascii')}"


@dataclasses.dataclass(frozen=True)
class Section:
    """A section of a page: a heading, text, tables and pictures.

    Args:
        heading: The heading.
        text: Paragraphs, separated by empty lines.
        warning: A paragraph above the others that the reader must not overlook.
        tables: Tables below the paragraphs.
        pictures: Pictures below the tables; above them if a table is long.
        details: Paragraphs that the page shows when the reader asks for them, with the tables and
            the code of the section.
        code: Text at the end, to be copied unchanged.
    """

    heading: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    warning: str = ""
    details: str = ""
    code: str = ""

    def __str__(self) -> str:
        paragraphs = [self.warning, *self.text.split("\n\n"), *self.details.split("\n\n")]
        filled = (textwrap.fill(one, 100) for one in paragraphs)
        parts = [f"{self.heading}\n{'=' * len(self.heading)}", *filled, *map(str, self.tables)]
        return "\n\n".join(filter(None, [*parts, self.code]))

    @property
    def anchor(self) -> str:
        """Name of the section in a link."""
        return re.sub(r"[^a-z0-9]+", "-", self.heading.lower()).strip("-")


def _marked(text: str) -> markupsafe.Markup:
    """Escaped text, with what stands between backticks as code."""
    return markupsafe.Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(markupsafe.escape(text))))


def template(name: str) -> jinja2.Template:
    """A file of `templates`; what is filled in is escaped if it is HTML."""
    of = jinja2.Environment(
        loader=jinja2.PackageLoader("etid.report"),
        autoescape=jinja2.select_autoescape(),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    of.filters["marked"] = _marked
    return of.get_template(name)


def write_page(
    path: str | os.PathLike[str], title: str, text: str, sections: Sequence[Section]
) -> None:
    """Write a page that needs no other file and no network.

    Args:
        path: The HTML file.
        title: Title of the page.
        text: One paragraph that says what the page shows.
        sections: The sections in their order. No two headings may be equal.
    """
    searchable = any(table.searchable for section in sections for table in section.tables)
    script = importlib.resources.files("etid.report").joinpath("templates/table.js")
    text_of_script = script.read_text("utf-8") if searchable else ""
    digest = base64.b64encode(hashlib.sha256(text_of_script.encode()).digest()).decode()
    page = template("page.html").render(
        title=title,
        text=text,
        sections=sections,
        script=text_of_script,
        allowed=f"sha256-{digest}",
        LONG=60,  # characters; a longer cell is broken into lines
        MANY=12,  # rows; a longer table is below the pictures
    )
    replace_text(path, page.lstrip())
