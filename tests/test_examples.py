"""The short programs of `examples` that "Build on etid" shows."""

import ast
import pathlib
import subprocess
import sys

import pytest

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"
# What a program prints, and what it needs beside etid.
SHORT = {
    "any_record": "20 iterations: a = [ 1.    -1.50",
    "export_nwb": "12 TimeSeries, 0 errors",
    "own_circuit": "Leaky: successful",
    "waveform": "c_p: 50 mV",
}
LONG = {
    "batches": "NumPy, nothing compiled: first",
    "correct_driver": "% corrected",
    "design": "found: pulse 688",
    "hierarchy": "r_p of the population: 1.8",
    "own_prior": "with the prior former_study",
    "own_solver": "jaxopt: [3.344",
    "profile": "+1 standard errors: -2 ln L rises by 1.0",
    "pulse": "after 12 pulses: R_s 33",
    "variation": "between recordings          1 %",
}
LINES = 30  # of code


def run(name: str) -> str:
    """What the program prints."""
    program = [sys.executable, EXAMPLES / f"{name}.py"]
    done = subprocess.run(
        program, cwd=EXAMPLES.parent, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", SHORT)
def test_a_program_runs(name):
    if name == "export_nwb":
        pytest.importorskip("pynwb")
    assert SHORT[name] in run(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_a_long_program_runs(name):
    assert LONG[name] in run(name)


@pytest.mark.parametrize("name", [*SHORT, *LONG])
def test_a_program_is_short_and_uses_public_names_only(name):
    tree = ast.parse((EXAMPLES / f"{name}.py").read_text("utf-8"))
    lines = {node.lineno for node in ast.walk(tree) if isinstance(node, ast.stmt | ast.expr)}
    assert len(lines) <= LINES
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert not (node.module or "").startswith("etid")
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")
