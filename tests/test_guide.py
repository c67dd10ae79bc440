"""The guide can be read: its pages are short, and the start page shows a result before all else."""

import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
WORDS = 600  # a reader with one question reads this in three minutes
# Code, tables, equations and comments are looked up, not read.
LOOKED_UP = re.compile(
    r"^ *```.*?^ *```|^\s*\|.*?$|^\$\$.*?\$\$|<!--.*?-->", re.DOTALL | re.MULTILINE
)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_page_of_the_guide_is_short(path):
    assert len(LOOKED_UP.sub("", path.read_text("utf-8")).split()) <= WORDS


def test_the_start_page_shows_the_set_up_then_a_result_and_no_other_picture():
    text = (ROOT / "README.md").read_text("utf-8")
    pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", text)
    assert pictures == ["docs/setup.svg", "docs/fit.png"]
    order = ("setup.svg", "pip install", "docs/fit.png", "What a result", "make demo")
    places = [text.index(part) for part in order]
    assert places == sorted(places)
