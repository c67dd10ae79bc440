"""Notebooks and the README are executed as a reader would execute them."""

import contextlib
import json
import pathlib
import re
import sys
import warnings

import nbformat
import pytest

ROOT = pathlib.Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@contextlib.contextmanager
def jupyter_warnings_allowed():
    """Jupyter's packages warn about each other; what a cell warns of is in its output."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.fixture
def running_kernel(tmp_path, monkeypatch):
    """Name of a kernel that runs this interpreter, whatever kernels the machine has."""
    folder = tmp_path / "jupyter" / "kernels" / "running"
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": command, "display_name": "running", "language": "python"}
    (folder / "kernel.json").write_text(json.dumps(spec))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    return "running"


def test_there_is_a_notebook():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_from_top_to_bottom_and_shows_its_figures(path, tmp_path, running_kernel):
    with jupyter_warnings_allowed():
        import jupytext
        from nbclient import NotebookClient

        notebook = jupytext.read(path)
        client = NotebookClient(
            notebook,
            timeout=300,
            kernel_name=running_kernel,
            resources={"metadata": {"path": str(tmp_path)}},
        )
        client.execute()
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    outputs = [output for cell in cells for output in cell.outputs]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    wanted = [cell for cell in cells if "etid.plot(" in cell.source]
    assert len(pictures) == len(wanted) > 0
    warned = [output.text for output in outputs if output.get("name") == "stderr"]
    assert not warned


def test_readme_examples_print_what_the_readme_says(capsys):
    """Digits may differ between machines; words, units and the number of numbers may not."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(?:python|text)\n(.*?)```", text, flags=re.DOTALL)
    names: dict = {}

    def structure(lines):
        return [NUMBER.sub("#", line).split() for line in lines.strip().splitlines()]

    assert len(blocks) == 6
    for code, printed in zip(blocks[::2], blocks[1::2], strict=True):
        exec(compile(code, "README.md", "exec"), names)
        assert structure(capsys.readouterr().out) == structure(printed)
