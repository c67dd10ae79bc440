"""What a person reads, as it is stored in `tests/outputs`: commands, prints of objects, pages.

`check(name, text)` compares with `tests/outputs/NAME.txt`. Where this file is missing, the test
writes it and fails. `make outputs` writes all of them anew: read what has changed like code.

Words, units and integers must be equal. A text of fits holds numbers that differ between
processors; they may differ by what is said at each tolerance. In all other texts every digit
counts.
"""

import contextlib
import html.parser
import io
import pathlib
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest
from typing import Any

import pytest

import etid
from etid import cli
from etid.display.__main__ import parser as parser_of_display

OUTPUTS = pathlib.Path(__file__).parent / "outputs"
WIDTH = 100  # columns of the terminal
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan|inf)\b")
# An estimate may move by its standard error. What etid says on ±, χ² and the residual are functions
# of the noise that it measures; processors agree on them to 0.5 % (tests/kept_numbers.py), and four
# times this is allowed.
RELATIVE = 0.02
VERSIONED = ("etid", "JAX", "jax", "jaxlib", "optimistix", "equinox", "numpy", "NumPy", "Python")


def check(name: str, text: str, *, fitted: bool, chaotic: bool = False) -> None:
    """Compare a text with `tests/outputs/NAME.txt`.

    Args:
        name: Name of the file.
        text: The text.
        fitted: Whether its numbers come from fits.
        chaotic: Whether some come from iterations that do not converge, so that no number counts.
    """
    path, text = OUTPUTS / f"{name}.txt", text.rstrip() + "\n"
    if not path.exists():
        path.write_text(text, "utf-8")
        pytest.fail(f"{path} was missing and is written now; read it")
    before = path.read_text("utf-8")
    if chaotic:
        before, text = (NUMBER.sub("0", of) for of in (before, text))
    found = differences(before, text, fitted=fitted)
    assert not found, "\n".join([f"{path}: `make outputs` writes it anew", *found])


def differences(before: str, now: str, *, fitted: bool) -> list[str]:
    """The lines that differ: as stored, and as they are now."""
    lines = zip_longest(before.splitlines(), now.splitlines())
    return [
        f"- {was}\n+ {new}"
        for was, new in lines
        if was != new and not (fitted and was and new and _alike(was, new))
    ]


def _alike(before: str, now: str) -> bool:
    """Whether two lines differ only by what fits may differ by; columns may have moved."""
    words, others = ([" ".join(one.split()) for one in NUMBER.split(of)] for of in (before, now))
    was, new = NUMBER.findall(before), NUMBER.findall(now)
    return words == others and all(
        _near(was[i], new[i], was[i + 1] if words[i + 1] == "±" else None) for i in range(len(was))
    )


def _near(before: str, now: str, error: str | None) -> bool:
    """Whether two written numbers are one estimate; `error` is written behind it."""
    if not {".", "e"} & set(before + now):
        return before == now
    was, new = float(before), float(now)
    digit = 10.0 ** -len(before.partition("e")[0].partition(".")[2])
    if "e" in before:
        digit *= 10.0 ** int(before.partition("e")[2])
    allowed = RELATIVE * abs(was) if error is None else float(error)
    return abs(was - new) <= max(allowed, digit * 1.001)  # a last digit may be rounded elsewhere


PROGRAMS = {
    "etid": cli.main,
    "etid-live": lambda words: cli.run(parser_of_display(), words),
}


def transcript(*commands: str, program: str = "etid") -> str:
    """Commands of a program, and what a terminal shows: stdout, stderr, a status that is not 0."""
    return "\n".join(_shown(program, command) for command in commands)


def _shown(program: str, command: str) -> str:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = PROGRAMS[program](shlex.split(command))
        except SystemExit as stop:
            status = stop.code
    shown = f"$ {program} {command}\n{out.getvalue()}{err.getvalue()}"
    return f"{shown}(exit status {status})\n" if status else shown


class _Page(html.parser.HTMLParser):
    """The text of a page: a line for each heading, paragraph, caption and row of a table."""

    BLOCKS = frozenset(
        {"h1", "h2", "h3", "p", "tr", "caption", "figcaption", "pre", "summary", "title", "li"}
    )
    SILENT = frozenset({"style", "script"})

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.cells: list[str] = [""]
        self.silent = 0

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        del attrs
        self.silent += tag in self.SILENT
        if tag in self.BLOCKS:
            self._end_of_line()
        if tag in ("td", "th") and self.cells != [""]:
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        self.silent -= tag in self.SILENT
        if tag in self.BLOCKS:
            self._end_of_line()
            self.lines += [""] * (tag in ("h1", "h2", "h3", "p", "figcaption"))

    def handle_data(self, data: str) -> None:
        if not self.silent:
            self.cells[-1] += data

    def _end_of_line(self) -> None:
        cells = [" ".join(cell.split()) for cell in self.cells]
        if any(cells):
            self.lines.append(" | ".join(cells))
        self.cells = [""]


def of_page(page: str) -> str:
    """The text of an HTML page, table by table; pictures are left out."""
    reader = _Page()
    reader.feed(page)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(reader.lines))


def masked(text: str, folder: pathlib.Path) -> str:
    """The text without what differs between machines: the folder, ports, versions, checksums."""
    text = text.replace(str(folder), "FOLDER")
    text = re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1:PORT", text)
    text = re.sub(rf"\b({'|'.join(VERSIONED)}) \d[\w.]+", r"\1 VERSION", text)
    text = text.replace(f"version = {{{etid.__version__}}}", "version = {VERSION}")
    return re.sub(r"\b[0-9a-f]{64}\b", "SHA256", text)


def session(expressions: Iterable[str], names: Mapping[str, Any]) -> str:
    """Expressions as at the prompt of Python, and what `print` shows of each value or error."""
    shown = ((one, value(one, names)) for one in expressions)
    return "\n".join(f">>> print({one})\n{_said(it)}\n" for one, it in shown)


def value(expression: str, names: Mapping[str, Any]) -> Any:
    """The value of an expression, or the error that it raises."""
    try:
        return eval(expression, dict(names))
    except Exception as error:
        return error


def _said(shown: Any) -> str:
    return f"{type(shown).__name__}: {shown}" if isinstance(shown, Exception) else str(shown)
