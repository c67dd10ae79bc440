"""Tables for the terminal, and one self-contained HTML page of tables and figures."""

import base64
import dataclasses
import html
import os
import pathlib
import textwrap
from collections.abc import Sequence

import numpy as np

_STYLE = """
:root { color-scheme: light dark; --line: #8886; --soft: #8882; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; } p { max-width: 46rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; text-align: right; white-space: nowrap; }
th { border-bottom: 1px solid var(--line); vertical-align: bottom; }
th:first-child, td:first-child, td.text { text-align: left; }
tr:nth-child(even) td { background: var(--soft); }
figure { margin: 1rem 0; } figcaption { font-size: 0.85rem; }
img { background: white; border-radius: 4px; max-width: 100%; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem; } .figures figure { flex: 1 1 24rem; }
"""


@dataclasses.dataclass(frozen=True)
class Table:
    """Cells of text under headings.

    Args:
        columns: Headings.
        rows: Cells, as many in each row as there are headings.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def __post_init__(self):
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"row {row} has {len(row)} cells for {len(self.columns)} columns")

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
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        text = [' class="text"' if self._is_text(i) else "" for i in range(len(self.columns))]
        body = "\n".join(
            "<tr>"
            + "".join(
                f"<td{kind}>{html.escape(cell)}</td>" for cell, kind in zip(row, text, strict=True)
            )
            + "</tr>"
            for row in self.rows
        )
        return f'<div class="wide"><table><tr>{head}</tr>\n{body}</table></div>'

    def _is_text(self, column: int) -> bool:
        """Whether a column holds words, which are set to the left."""
        return all(row[column][:1].isalpha() for row in self.rows if row[column])


def number(value: float | np.floating) -> str:
    """Two decimals, readable also where an estimate has run away."""
    return f"{value:.2f}" if abs(value) < 1e4 else f"{value:.3g}"


@dataclasses.dataclass(frozen=True)
class Section:
    """A heading of a page and what stands below it.

    Args:
        heading: The heading.
        text: One paragraph.
        tables: Tables below the paragraph.
        figures: Captions and SVG files of the figures below the tables.
    """

    heading: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    figures: tuple[tuple[str, pathlib.Path], ...] = ()

    def __str__(self) -> str:
        text = textwrap.fill(self.text, 100)
        parts = [self.heading, "=" * len(self.heading), text, *map(str, self.tables)]
        return "\n".join(filter(None, parts))

    def html(self) -> str:
        """The section as HTML elements."""
        parts = [f"<h2>{html.escape(self.heading)}</h2>"]
        if self.text:
            parts.append(f"<p>{html.escape(self.text)}</p>")
        parts += [table.html() for table in self.tables]
        if self.figures:
            images = "\n".join(_image(caption, path) for caption, path in self.figures)
            parts.append(f'<div class="figures">{images}</div>')
        return "\n".join(parts)


def _image(caption: str, path: pathlib.Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    text = html.escape(caption)
    return (
        f'<figure><img alt="{text}" src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def write_page(
    path: str | os.PathLike[str], title: str, text: str, sections: Sequence[Section]
) -> None:
    """Write a page that needs no other file and no network.

    Args:
        path: The HTML file.
        title: Title of the page.
        text: What the page shows, one paragraph.
        sections: The sections in their order.
    """
    body = "\n".join(section.html() for section in sections)
    pathlib.Path(path).write_text(
        "<!doctype html>\n"
        '<html lang="en"><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n"
        f"<h1>{html.escape(title)}</h1>\n<p>{html.escape(text)}</p>\n{body}\n</html>\n",
        encoding="utf-8",
    )
