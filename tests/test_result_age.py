"""Results of benchmarks name commits of this history; those older than the code are skipped."""

import ast
import csv
import functools
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
    *("__main__.py", "cli.py", "commands", "files", "garbage.py", "live", "plotting", "report"),
    *("results/variation.py", "simulation/calibration.py"),
    *(f"display/{name}" for name in ("command.py", "page.html", "server.py", "view.py")),
)
# Tables whose numbers depend on them; those of no other do.
ONLY = {
    ("identify/jointly.py", "selection/delays.py", "likelihood/joint"): ("coverage", "tolerances"),
    ("online", "display"): ("control", "live", "mutation", "online"),
}


def git(*arguments):
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module", autouse=True)
def _whole_history():
    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("the history of the project is not here")


def commits(table):
    with table.open(newline="") as file:
        return {row["commit"].rstrip("+") for row in csv.DictReader(file)}


@functools.cache
def statements(commit, name):
    """Statements of a module but imports, without docstrings and messages.

    A text with a space is a message; names have none.
    """
    text = git("show", f"{commit}:{name}").stdout
    if not name.endswith(".py"):
        return {text}
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            if ast.get_docstring(node) is not None:
                del node.body[0]
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            node.value = ""
    imports = ast.Import | ast.ImportFrom
    return {ast.dump(node) for node in tree.body if not isinstance(node, imports)}


def first_changed(commit, names):
    """The first of some modules with a statement that is in none of them today; None without one.

    A statement that was moved from one module to another is the same, and a new one that is used
    changes another.
    """
    now = set().union(*(statements("HEAD", name) for name in names))
    return next((name for name in names if statements(commit, name) - now), None)


TABLES = sorted((ROOT / "benchmarks" / "results").glob("*.csv"))


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_a_result_is_of_this_code(table):
    """A stale one is skipped, with what to run: a whole benchmark takes longer than all tests."""
    unknown = [
        one for one in commits(table) if git("cat-file", "-e", f"{one}^{{commit}}").returncode
    ]
    assert not unknown, f"{table.name} names commits that do not exist: {unknown}"
    without = [
        *SHOWN,
        *(name for names, of in ONLY.items() if table.stem not in of for name in names),
    ]
    of = ["etid", ":!*.pyi", *(f":!etid/{name}" for name in without)]
    for one in commits(table):
        changed = git("diff", "--name-only", "--no-renames", one, "HEAD", "--", *of).stdout.split()
        name = first_changed(one, changed)
        if name is not None:
            command = MADE_BY.get(table.stem, table.stem)
            pytest.skip(f"{name} has changed since: python -m benchmarks {command}")
