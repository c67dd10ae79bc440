"""Results of benchmarks name commits of this history; those older than the code are skipped."""

import ast
import csv
import pathlib
import subprocess

import pytest

ROOT = pathlib.Path(__file__).parents[1]
MADE_BY = {  # tables whose names are not those of their benchmarks
    "failures": "failure_map",
    "silent_failures": "failure_map",
    "perturbation_pairs": "perturbations --pairs 500",
    "selection_map": "selection",
    "coverage": "coverage --snr-db 40 60 --method default joint -o FILE",
}
# No number of a benchmark depends on them.
SHOWN = (
    *("cli.py", "commands", "files", "garbage.py", "live", "paper", "plotting", "report"),
    *("results/variation.py", "simulation/calibration.py"),
)
# No number depends on them but of benchmarks with joint fits.
JOINT = ("identify/jointly.py", "selection/delays.py")
WITH_JOINT = ("coverage", "tolerances")


def git(*arguments):
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module", autouse=True)
def _whole_history():
    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("the history of the project is not here")


def commits(table):
    with table.open(newline="") as file:
        return {row["commit"].rstrip("+") for row in csv.DictReader(file)}


def code(commit, name):
    """A module without comments and docstrings, on which no number depends."""
    found = git("show", f"{commit}:{name}")
    if found.returncode or not name.endswith(".py"):
        return found.stdout
    tree = ast.parse(found.stdout)
    for node in ast.walk(tree):
        described = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        if described and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.dump(tree)


TABLES = sorted((ROOT / "benchmarks" / "results").glob("*.csv"))


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_a_result_is_of_this_code(table):
    """A stale one is skipped, with what to run: a whole benchmark takes longer than all tests."""
    unknown = [
        one for one in commits(table) if git("cat-file", "-e", f"{one}^{{commit}}").returncode
    ]
    assert not unknown, f"{table.name} names commits that do not exist: {unknown}"
    without = (*SHOWN, *(() if table.stem in WITH_JOINT else JOINT))
    of = ["etid", ":!*.pyi", *(f":!etid/{name}" for name in without)]
    for one in commits(table):
        for name in git("diff", "--name-only", one, "HEAD", "--", *of).stdout.split():
            if code(one, name) != code("HEAD", name):
                command = MADE_BY.get(table.stem, table.stem)
                pytest.skip(f"{name} has changed since: python -m benchmarks {command}")
