"""Tables for the terminal, and one self-contained HTML page of tables and pictures.

The page holds no script, and forbids every request: what a file says about itself, its labels and
notes, can do no harm, and what is shown offline is what was shown on-line.
"""

import base64
import dataclasses
import html
import os
import pathlib
import re
import textwrap
from collections.abc import Sequence

import numpy as np

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
_STYLE = """
:root { color-scheme: light dark; --line: #8886; --soft: #8882; --link: #0b62a4; }
html { background: white; color: #1a1a1a; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; overflow-wrap: anywhere; } h2 { margin-top: 2.5rem; }
p { max-width: 46rem; overflow-wrap: anywhere; } a { color: var(--link); }
nav ul { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: 0.2rem 1.5rem; }
.warning { border-left: 4px solid #c0392b; background: var(--soft); padding: 0.5rem 1rem; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: 0.3rem 0; }
th, td { padding: 0.2rem 0.55rem; text-align: right; white-space: nowrap; }
thead th { white-space: normal; }
thead tr:last-child th { border-bottom: 1px solid var(--line); vertical-align: bottom; }
thead th[colspan] { text-align: center; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td.text { white-space: normal; max-width: 14rem; }
td.long { max-width: none; white-space: normal; min-width: 20rem; overflow-wrap: anywhere; }
tbody tr:nth-child(even) td { background: var(--soft); }
figure { margin: 1rem 0; } figcaption { font-size: 0.85rem; overflow-wrap: anywhere; }
img { background: white; border-radius: 4px; max-width: 100%; height: auto; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem; } .figures figure { flex: 1 1 30rem; }
.figures figure.whole { flex-basis: 100%; }
pre { font-size: 0.8rem; background: var(--soft); padding: 1rem; white-space: pre-wrap;
  overflow-wrap: anywhere; user-select: all; }
@media screen and (prefers-color-scheme: dark) {
  :root { --link: #7ab8e8; } html { background: #1a1a1a; color: #e6e6e6; }
  img { filter: invert(0.9) hue-rotate(180deg); }
}
@media print {
  @page { size: A4; margin: 12mm; }
  :root { color-scheme: light; }
  body { font-size: 9.5pt; max-width: none; margin: 0; padding: 0; } nav { display: none; }
  h1, h2, caption, p:has(+ .figures), p:has(+ .wide) { break-after: avoid; }
  p { orphans: 3; widows: 3; max-width: none; } figcaption { font-size: 8pt; }
  .wide { overflow: visible; } table { font-size: 7.5pt; } th, td { padding: 0.1rem 0.3rem; }
  td.long { min-width: 0; } pre { font-size: 7pt; }
  table, figure { break-inside: avoid; } thead { display: table-header-group; }
  tr { break-inside: avoid; } .figures { display: block; }
  .figures figure { display: inline-block; width: 48%; margin: 0.5%; vertical-align: top; }
  .figures figure.whole { width: 99%; }
}
"""
_LONG = 60  # characters, above which a cell is broken into lines
_MANY = 12  # rows, above which a table stands below the pictures


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells of text under headings.

    Args:
        columns: Headings.
        rows: Cells, as many in each row as there are headings.
        groups: Headings above the headings, each with the number of columns that it spans.
        caption: Above the table.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    groups: tuple[tuple[str, int], ...] = ()
    caption: str = ""

    def __post_init__(self):
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"row {row} has {len(row)} cells for {len(self.columns)} columns")
        spanned = sum(span for _, span in self.groups)
        if self.groups and spanned != len(self.columns):
            raise ValueError(f"the groups span {spanned} columns of {len(self.columns)}")

    def __str__(self) -> str:
        lines = [self.columns, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        left = [i == 0 or self._is_text(i) for i in range(len(widths))]
        return "\n".join(
            "  ".join(
                cell.ljust(width) if to_left else cell.rjust(width)
                for cell, width, to_left in zip(line, widths, left, strict=True)
            ).rstrip()
            for line in lines
        )

    def html(self) -> str:
        """The table as an HTML element."""
        text = [self._is_text(i) for i in range(len(self.columns))]
        over = "".join(
            f'<th colspan="{span}" scope="colgroup">{html.escape(name)}</th>' if name
            else f'<td colspan="{span}"></td>'
            for name, span in self.groups
        )  # fmt: skip
        head = "".join(
            f'<th scope="col"{_class(left)}>{html.escape(name)}</th>'
            for name, left in zip(self.columns, text, strict=True)
        )
        body = "\n".join(
            "<tr>"
            + "".join(
                f"<td{_class(left, len(cell) > _LONG)}>{html.escape(cell)}</td>"
                for cell, left in zip(row, text, strict=True)
            )
            + "</tr>"
            for row in self.rows
        )
        caption = f"<caption>{html.escape(self.caption)}</caption>" if self.caption else ""
        over = f"<tr>{over}</tr>" if over else ""
        return (
            f'<div class="wide"><table>{caption}<thead>{over}<tr>{head}</tr></thead>\n'
            f"<tbody>{body}</tbody></table></div>"
        )

    def _is_text(self, column: int) -> bool:
        """Whether a column holds words, which are set to the left."""
        return all(row[column][:1].isalpha() for row in self.rows if row[column])


def _class(left: bool, long: bool = False) -> str:
    """The attribute of a cell that is set to the left, or broken into lines."""
    return ' class="text long"' if long else ' class="text"' if left else ""


def number(value: float | np.floating) -> str:
    """Two decimals, readable also where an estimate has run away."""
    return f"{value:.2f}" if abs(value) < 1e4 else f"{value:.3g}"


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture of a page.

    Args:
        caption: Below the picture.
        svg: The picture.
        alt: What it shows, for those who cannot see it; the caption if not given.
        whole: Whether it needs the width of the page, which two others share.
    """

    caption: str
    svg: bytes
    alt: str = ""
    whole: bool = False

    def html(self) -> str:
        """The picture as an HTML element."""
        data = base64.b64encode(self.svg).decode("ascii")
        alt = html.escape(self.alt or self.caption)
        whole = ' class="whole"' if self.whole else ""
        return (
            f'<figure{whole}><img alt="{alt}" src="data:image/svg+xml;base64,{data}">'
            f"<figcaption>{html.escape(self.caption)}</figcaption></figure>"
        )


@dataclasses.dataclass(frozen=True)
class Section:
    """A heading of a page and what stands below it.

    Args:
        heading: The heading.
        text: Paragraphs, with an empty line between them.
        warning: A paragraph that must not be overlooked, above the others.
        tables: Tables below the paragraphs.
        pictures: Pictures below the tables; above them if a table is long.
        code: Text to be copied as it is, at the end.
    """

    heading: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    warning: str = ""
    code: str = ""

    def __str__(self) -> str:
        paragraphs = filter(None, [self.warning, *self.text.split("\n\n")])
        text = "\n\n".join(textwrap.fill(paragraph, 100) for paragraph in paragraphs)
        parts = [self.heading, "=" * len(self.heading), text, *map(str, self.tables), self.code]
        return "\n".join(filter(None, parts))

    @property
    def anchor(self) -> str:
        """What a link to the section calls it."""
        return re.sub(r"[^a-z0-9]+", "-", self.heading.lower()).strip("-")

    def html(self) -> str:
        """The section as an HTML element."""
        parts = [f'<section id="{self.anchor}"><h2>{html.escape(self.heading)}</h2>']
        if self.warning:
            parts.append(f'<p class="warning">{html.escape(self.warning)}</p>')
        paragraphs = filter(None, self.text.split("\n\n"))
        parts += [f"<p>{html.escape(paragraph)}</p>" for paragraph in paragraphs]
        pictures = "\n".join(picture.html() for picture in self.pictures)
        shown = [f'<div class="figures">{pictures}</div>'] if pictures else []
        tables = [table.html() for table in self.tables]
        many = any(len(table.rows) > _MANY for table in self.tables)
        parts += shown + tables if many else tables + shown
        if self.code:
            parts.append(f"<pre>{html.escape(self.code)}</pre>")
        return "\n".join([*parts, "</section>"])


def write_page(
    path: str | os.PathLike[str], title: str, text: str, sections: Sequence[Section]
) -> None:
    """Write a page that needs no other file and no network.

    Args:
        path: The HTML file.
        title: Title of the page.
        text: What the page shows, one paragraph.
        sections: The sections in their order; their headings differ.
    """
    contents = "".join(
        f'<li><a href="#{section.anchor}">{html.escape(section.heading)}</a></li>'
        for section in sections
    )
    body = "\n".join(section.html() for section in sections)
    pathlib.Path(path).write_text(
        "<!doctype html>\n"
        '<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style></head>\n"
        f"<body><h1>{html.escape(title)}</h1>\n<p>{html.escape(text)}</p>\n"
        f'<nav aria-label="Contents"><ul>{contents}</ul></nav>\n\n'
        f"<main>{body}</main></body></html>\n",
        encoding="utf-8",
    )
