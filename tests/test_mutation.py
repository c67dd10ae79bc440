"""Bugs that are put in: each is one, no test sees what cannot matter, and none is done twice."""

import ast
import csv

import pytest

from benchmarks import mutation
from benchmarks.__main__ import asked
from benchmarks.mutant_tests import Outcome
from benchmarks.mutants import drawn, mutants
from benchmarks.provenance import ROOT

SOURCE = '''"""A module."""

LIMIT: float = 2.0


def small(a: int, b: int = 3) -> int:
    """Docstring, of 4 words."""
    assert a is not None
    if a > b and not b == 1:
        a += 1
    total = a * 2 + pow(a, b)
    return -total if a else b
'''


def test_every_mutant_is_another_program_with_one_change():
    found = mutants("small.py", SOURCE)
    kinds = {mutant.kind for mutant in found}
    assert kinds == {
        "arguments swapped", "comparison", "condition", "condition negated", "constant", "operator",
        "sign", "statement deleted", "term dropped",
    }  # fmt: skip
    programs = {ast.dump(ast.parse(mutant.applied(SOURCE))) for mutant in found}
    assert len(programs) == len(found)
    assert ast.dump(ast.parse(SOURCE)) not in programs
    for mutant in found:
        changed = mutant.applied(SOURCE)
        assert "Docstring, of 4 words" in changed
        assert "assert a is not None" in changed
        assert "a: int" in changed
        line = SOURCE.splitlines()[mutant.line - 1]
        assert mutant.before.splitlines()[0] in line


def test_a_text_of_several_bytes_a_letter_is_cut_where_it_should():
    [mutant, *_] = mutants("small.py", 'name = "Ω"; value = 2 + 1\n')
    assert mutant.applied('name = "Ω"; value = 2 + 1\n') == 'name = "Ω"; value = (2)\n'


def test_what_changes_nothing_by_construction_is_no_mutant():
    source = "n = math.gcd(a, b)\nk = np.maximum(a, b)\npairs = zip(a, a, strict=True)\n"
    assert mutants("small.py", source) == []
    [alone] = mutants("small.py", "os.sched_setaffinity(0, cores)\n")  # acts on processes
    assert alone.kind == "statement deleted"
    [tiny] = mutants("small.py", "guard = 1e-300\n")
    assert tiny.after == "(1.0)"


def test_draws_are_seeded_and_larger_ones_hold_the_smaller():
    found = mutants("small.py", SOURCE)
    assert drawn(found, 9, 1)[:4] == drawn(found, 4, 1)  # an interrupted run is a draw, too
    assert drawn(found, 9, 2) != drawn(found, 9, 1)


@pytest.fixture
def tree(tmp_path):
    """A package of one module, whose test sees a sum and nothing else."""
    root = tmp_path / "root"
    for folder in ("etid", "tests"):
        (root / folder).mkdir(parents=True)
    (root / "etid" / "__init__.py").touch()
    (root / "etid" / "small.py").write_text("UNUSED = 5\n\n\ndef add(a, b):\n    return a + b\n")
    (root / "tests" / "test_small.py").write_text(
        "from etid.small import add\n\n\ndef test_nothing():\n    pass\n"
        "\n\ndef test_sum():\n    assert add(2, 1) == 3\n"
    )
    return root


@pytest.mark.slow
def test_what_no_test_sees_survives_and_what_is_done_is_kept(tree, tmp_path, monkeypatch):
    path = tree / "etid" / "small.py"
    chosen = mutants("etid/small.py", path.read_text())
    assert [mutant.kind for mutant in chosen] == ["constant", "term dropped", "operator"]
    kept = tmp_path / "kept.jsonl"
    tests = {"small": ("small",)}
    rows = list(mutation.outcomes(tree, tests, chosen[:2], kept, 60.0))
    assert [row["outcome"] for row in rows] == ["survived", "killed"]
    assert [row["killer"] for row in rows] == ["", "tests/test_small.py::test_sum"]
    assert path.read_text().startswith("UNUSED = 5")
    monkeypatch.setattr(mutation, "Runner", lambda _: None)  # nothing that could be called
    assert list(mutation.outcomes(tree, tests, chosen[:2], kept, 60.0)) == rows


def test_modules_and_their_tests_are_where_the_benchmark_looks_for_them():
    for name, tests in mutation.TESTS.items():
        assert (ROOT / "etid" / f"{name.replace('.', '/')}.py").exists()
        for test in tests:
            assert (ROOT / "tests" / f"test_{test}.py").exists()


def test_survivors_are_shown_and_the_table_tells_seed_and_commit(tmp_path, monkeypatch, capsys):
    row = {
        "key": "k", "module": "a", "place": "etid/a.py:7", "kind": "sign", "before": "-\\\n x",
        "after": "(x)", "killer": "", "seconds": 1.0,
    }  # fmt: skip
    rows = [{**row, "outcome": outcome} for outcome in ("survived", "killed")]
    monkeypatch.setattr(mutation, "outcomes", lambda *_: rows)
    kept = tmp_path / "mutation.jsonl"
    of = asked(["mutation", "--modules", "results.verdicts", "--seed", "3", "--output", str(kept)])
    assert not of.module.main(of)
    text = capsys.readouterr().out
    assert "1 of 2 survive, 50%" in text
    assert "etid/a.py:7: sign: -\\ x  ->  (x)" in text
    with kept.with_suffix(".csv").open() as file:
        found = next(csv.DictReader(file))
    assert (found["seed"], found["outcome"], found["before"]) == ("3", "survived", "-\\ x")
    assert found["commit"]


def test_tests_that_fail_by_themselves_are_no_judge(tree, tmp_path, monkeypatch):
    monkeypatch.setattr(mutation, "Runner", lambda _: lambda *_: Outcome(False, ""))
    chosen = mutants("etid/small.py", (tree / "etid" / "small.py").read_text())
    with pytest.raises(SystemExit, match="fails without any mutant"):
        next(mutation.outcomes(tree, {"small": ("small",)}, chosen, tmp_path / "k.jsonl", 60.0))
