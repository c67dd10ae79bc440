"""Bugs that are put in: each is one, no test sees what cannot matter, and survivors are counted."""

import ast
import csv

import pytest

from benchmarks import mutation
from benchmarks.__main__ import asked
from benchmarks.mutants import drawn, mutants

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
        assert mutant.inside == (mutant.line > 7)  # a default is computed at the import


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


def test_a_mutant_is_judged_by_the_tests_that_execute_it_and_a_constant_by_those_of_its_module():
    found = mutants("etid/small.py", SOURCE)
    executed = {
        "slow": (9.0, {"etid/small.py": [3, 6, 9, 10, 11]}),
        "fast": (1.0, {"etid/small.py": [3, 6, 11]}),
        "importing": (0.1, {"etid/small.py": [3, 6]}),
    }
    calls = {one.line for one in found if one.inside}
    by = {one.line: mutation.judges(one, executed, calls) for one in found}
    assert by == {3: ["fast", "slow"], 6: ["fast", "slow"], 9: ["slow"], 10: ["slow"],
                  11: ["fast", "slow"], 12: []}  # fmt: skip


def test_modules_are_drawn_from_the_whole_of_etid():
    names = mutation.module_names(mutation.ROOT)
    assert len(names) == len({*mutation.ROOT.glob("etid/**/*.py")})
    assert {"__init__", "solvers.levenberg_marquardt", "report.html", "numpy_tier.tiers"} < {*names}


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


@pytest.mark.slow
def test_tests_that_fail_by_themselves_are_no_judge(tree, tmp_path):
    (tree / "tests" / "test_small.py").write_text("def test_sum():\n    assert False\n")
    with pytest.raises(SystemExit, match="without any mutant: tests/test_small"):
        mutation.main(asked(["mutation", "--output", f"{tmp_path}/found.csv"]), tree)
