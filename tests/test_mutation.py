"""Bugs that are put in: each is one, no test sees what cannot matter, and survivors are counted."""

import csv

import pytest

from benchmarks import mutation
from benchmarks.__main__ import asked
from benchmarks.mutants import mutants


@pytest.fixture
def tree(tmp_path):
    """A package of one module, whose test sees a sum and nothing else."""
    root = tmp_path / "root"
    for folder in ("etid", "tests"):
        (root / folder).mkdir(parents=True)
    (root / "etid" / "__init__.py").touch()
    (root / "etid" / "small.py").write_text(
        "def add(a, b):\n    return a + b\n\n\ndef twice(a):\n    return a * 2\n"
    )
    (root / "tests" / "test_small.py").write_text(
        "from etid.small import add\n\n\ndef test_sum():\n    assert add(2, 1) == 3\n"
    )
    return root


SAID = '''
"""Nobody tests a docstring."""


def said(name, size):
    """Nor this one."""
    if size:
        raise ValueError(f"{name} has {size} rows")
    return ("name", "two words"), {"a": name, "b": size}, ["x", "x"]
'''


def test_mutants_of_texts_and_columns():
    found = [(one.kind, one.before, one.after) for one in mutants("m.py", SAID)]
    texts = [change for kind, *change in found if kind == "text"]
    assert texts == [
        ['f"{name} has {size} rows"', "(f'{size} has {name} rows')"],
        ['f"{name} has {size} rows"', "(f'{name} sah {size} rows')"],
        ['"name"', "('eman')"],
        ['"two words"', "('two')"],
        ['"a"', "('aa')"],
        ['"b"', "('bb')"],
        ['"x"', "('xx')"],
        ['"x"', "('xx')"],
    ]
    columns = [after for kind, _, after in found if kind == "columns exchanged"]
    assert columns == [
        "(({'a': name, 'b': size}, ('name', 'two words'), ['x', 'x']))",
        "(('two words', 'name'))",
        "({'a': size, 'b': name})",
    ]
    assert {kind for kind, *_ in found} == {"text", "columns exchanged", "condition negated"}


@pytest.mark.slow
def test_the_benchmark_counts_what_no_test_sees(tree, tmp_path, capsys):
    of = asked(["mutation", "--seed", "3", "--output", f"{tmp_path}/found.csv"])
    assert not mutation.main(of, tree)  # 2 of 4
    text = capsys.readouterr().out
    assert "2 of 4, 50% (95 %: 7% to 93%)   target <= 0.1, missed" in text
    with (tmp_path / "found.csv").open() as file:
        rows = list(csv.DictReader(file))
    outcomes = {(row["place"], row["outcome"], row["killer"]) for row in rows}
    assert outcomes == {
        ("etid/small.py:2", "killed", "tests/test_small.py::test_sum"),
        ("etid/small.py:6", "survived", ""),
    }
    assert {row["seed"] for row in rows} == {"3"}
    assert (tree / "etid" / "small.py").read_text().startswith("def add(a, b):\n    return a + b\n")
