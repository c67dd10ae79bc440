"""Numbers, plurals and names as people read them."""

import ast
import itertools
import pathlib
import re

import pytest

import etid
from etid.printing import as_symbol, per_cent, quality, quantity, rounded, several, significant
from etid.report.html import Section, Table


@pytest.mark.parametrize(
    ("value", "shown", "in_a_sentence"),
    [
        (970.0, "970", "970"),  # it was 9.7e+02
        (8.3e-5, "0.000083", "0.000083"),
        (0.12, "0.12", "0.12"),
        (1.0, "1.0", "1"),
        (99.99, "100", "100"),
        (-3.456, "-3.5", "-3.5"),
        (0.0, "0", "0"),
        (2e7, "2.0e+07", "2e+07"),
        (float("nan"), "", "-"),
    ],
)
def test_a_number_has_two_digits_and_no_power_of_ten(value, shown, in_a_sentence):
    assert (significant(value), rounded(value)) == (shown, in_a_sentence)


def test_three_digits_are_three():
    assert [significant(value, 3) for value in (0.12, 0.14, 1234.0)] == ["0.120", "0.140", "1230"]
    assert per_cent(9.7) == "970 %"


def test_one_thing_is_no_several():
    assert [several(n, "recording") for n in (0, 1, 2)] == [
        "0 recordings", "1 recording", "2 recordings",
    ]  # fmt: skip
    assert (several(1, "frequency"), several("3.5", "frequency")) == (
        "1 frequency",
        "3.5 frequencies",
    )


def test_an_error_that_rounds_up_has_two_digits():
    """The report had 185.794 ± 0.100 beside 185.80 ± 0.10."""
    assert quantity(185.794e3, "ohm", 99.8) == "185.79 ± 0.10 kΩ"
    assert per_cent(float("nan")) == "-"


def test_what_diverges_predicts_nothing():
    assert quality(1e-3, 1.02) == "RRSE 0.1 %, chi2 1.02"
    assert quality(float("inf"), float("nan")) == "no finite prediction"


def test_elements_are_named_as_in_figures():
    names = ("r_s", "r_p", "c", "alpha_2", "q_2")
    assert [*map(as_symbol, names)] == ["R_s", "R_p", "C", "alpha_2", "Q_2"]


def test_a_section_is_printed_as_text_and_tables():
    """The demo printed `Section(heading=…` in place of its tables."""
    table = Table(
        ("subject", "successful", "median [kΩ]", "own [%]"),
        (("s01", "9/10", "33.4", "1.2"), ("typical", "10/10", "186", "")),
        (("", 2), ("R_s", 2)),
        "Medians",
    )
    section = Section("Skins", "One paragraph.\n\nAnother one.", (table,))
    assert str(section) == (
        "Skins\n=====\n\nOne paragraph.\n\nAnother one.\n\n"
        "Medians\n"
        "                     R_s\n"
        "subject  successful  median [kΩ]  own [%]\n"
        "s01            9/10         33.4      1.2\n"
        "typical       10/10          186"
    )


SOURCES = sorted(pathlib.Path(etid.__file__).parent.rglob("*.py"))
THINGS = (
    *("recording", "fit", "driver", "sample", "pulse", "electrode", "period", "file", "row"),
    *("column", "draw", "value", "label", "calibration", "candidate", "impedance", "cell"),
)
# Counts that stand before a plural and cannot be one, because the text is said of more only.
SEVERAL = {
    "__init__.py: np.shape(one.rrse)",
    "assemble.py: length",
    "causes.py: rounded(abs(inspected.apart))",
    "channel.py: len(alike)",
    "channel.py: limits.SAMPLES",
    "channel.py: self.length",
    "contents.py: limits.SAMPLES",
    "contents.py: record.stored.size",
    "delimited.py: length",
    "driver.py: rounded(open_delay)",
    "fields.py: limits.SAMPLES",
    "file.py: total",
    "fit.py: kind",
    "fits.py: len(rows)",
    "hdf5_table.py: column.shape[0]",
    "labels.py: len(others)",
    "matlab.py: member.size",
    "methods.py: len(fits)",
    "online.py: LATEST",
    "pulse_train.py: rest",
    "pulse_train.py: self.spacing",
    "recording.py: size",
    "simulate.py: ELECTRODES",
    "simulate.py: streamed['pulses']",
    "spectra.py: width",
    "study.py: len(fits)",
    "study.py: len(found.drivers)",
    "view.py: len(layout.electrodes)",
}


def texts(path):
    """Texts of a module: all constants, without docstrings, and its f-strings."""
    tree = ast.parse(path.read_text("utf-8"))
    docs = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    return [node for node in ast.walk(tree) if id(node) not in docs]


def test_no_message_says_one_recordings():
    plural = re.compile(rf"^ (?:{'|'.join(THINGS)})s\b")
    found = set()
    for path in SOURCES:
        for node in texts(path):
            parts = node.values if isinstance(node, ast.JoinedStr) else []
            for count, text in itertools.pairwise(parts):
                if not (isinstance(count, ast.FormattedValue) and isinstance(text, ast.Constant)):
                    continue
                if plural.match(str(text.value)):
                    found.add(f"{path.name}: {ast.unparse(count.value)}")
    assert found - SEVERAL == set()


def test_no_message_gives_advice_that_only_python_understands():
    """A command said method='output_error'."""
    python = re.compile(r"\b(method|circuit|order)=['\"]")
    found = [
        f"{path.name}: {node.value}"
        for path in SOURCES
        for node in texts(path)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and python.search(node.value)
    ]
    assert found == []
