"""Notebooks, the README and the guide are executed as a reader would execute them."""

import contextlib
import io
import json
import pathlib
import re
import shutil
import sys
import time
import warnings

import nbformat
import pytest
from matplotlib.testing.compare import compare_images

from tests.conftest import REFERENCE_DATA

# Root mean square of the differences of grey values, of 255. The same commands give 0; with another
# release of FreeType letters differ by 1 to 3. A curve that is missing gives 4 and more.
TOLERANCE = 3.0
ROOT = pathlib.Path(__file__).parents[1]
CONCLUSIONS = ROOT / "tests" / "conclusions"  # what must hold after each notebook
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
SLOW = {  # compiled for minutes, or with a profile and draws
    "circuits",
    "control",
    "derivatives",
    "joint",
    "known_elements",
    "online",
    "selection",
    "uncertainties",
    "instrument",
}
PAGES = [
    pytest.param(path, marks=[pytest.mark.slow] if path.stem in SLOW else [])
    for path in sorted((ROOT / "docs").glob("*.md"))
    if "```python" in path.read_text(encoding="utf-8")
]
LAST_PLACES = {False: 5, True: 1}  # units that may differ; True: of up to three digits
LONG = 2e-4  # part of a number of six digits or more that may differ
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
    monkeypatch.setenv("ETID_REFERENCE_DATA", str(REFERENCE_DATA))
    folder = tmp_path / "jupyter" / "kernels" / "running"
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": command, "display_name": "running", "language": "python"}
    (folder / "kernel.json").write_text(json.dumps(spec))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    return "running"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_opens_in_jupyter_as_it_is(path):
    """Its file for Jupyter has the cells of the script, without outputs: `jupytext --sync`."""
    with jupyter_warnings_allowed():
        import jupytext
    script, notebook = jupytext.read(path), nbformat.read(path.with_suffix(".ipynb"), as_version=4)
    nbformat.validate(notebook)
    cells = [[(cell.cell_type, cell.source) for cell in of.cells] for of in (script, notebook)]
    assert cells[0] == cells[1]
    assert not any(cell.get("outputs") for cell in notebook.cells)


@pytest.mark.notebook
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_from_top_to_bottom_and_shows_its_figures(path, tmp_path, running_kernel):
    with jupyter_warnings_allowed():
        import jupytext
        from nbclient import NotebookClient

        notebook = jupytext.read(path)
        held = (CONCLUSIONS / path.name).read_text("utf-8")
        notebook.cells.append(nbformat.v4.new_code_cell(held))
        client = NotebookClient(
            notebook,
            timeout=300,
            kernel_name=running_kernel,
            resources={"metadata": {"path": str(tmp_path)}},
        )
        begun = time.perf_counter()
        client.execute()
        notebook.metadata["etid"] = {"seconds": time.perf_counter() - begun}
    del notebook.cells[-1]  # for readers, the notebook ends with its conclusion
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    outputs = [output for cell in cells for output in cell.outputs]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    wanted = [cell for cell in cells if re.search(r"\.plot\(|plt\.subplots\(", cell.source)]
    assert len(pictures) == len(wanted) > 0
    warned = [output.text for output in outputs if output.get("name") == "stderr"]
    assert not warned
    executed = path.parent / "executed"  # for readers, and for the site
    executed.mkdir(exist_ok=True)
    nbformat.write(notebook, executed / f"{path.stem}.ipynb")


def blocks_of(path):
    """Examples of a page with what it says they print; empty where it does not say."""
    text = path.read_text(encoding="utf-8")
    pattern = r"```python\n(.*?)```\n(?:\n```text\n(.*?)```)?"
    return re.findall(pattern, text, flags=re.DOTALL)


def structure(lines):
    """Words, units and the number of numbers."""
    return [NUMBER.sub("#", line).split() for line in lines.strip().splitlines()]


def stale(told, printed):
    """Numbers that are not what the code prints now, line by line.

    Numbers of fits repeat on every processor to 0.05 standard errors, which `33.449 ± 0.076` shows
    as four units of its last place. Times and counts of steps are no results.
    """
    found = []
    for before, now in zip(told.strip().splitlines(), printed.strip().splitlines(), strict=True):
        before, now = (re.sub(r"\d+ steps|[\d.]+ m?s\b", "", line) for line in (before, now))
        for old, new in zip(NUMBER.findall(before), NUMBER.findall(now), strict=True):
            shown, _, power = old.partition("e")
            place = 10.0 ** (int(power or 0) - len(shown.partition(".")[2]))
            digits = len(re.sub(r"\D", "", shown).lstrip("0"))
            size = LONG * abs(float(old)) if digits > 5 else 0.0
            if abs(float(old) - float(new)) > max(1.001 * LAST_PLACES[digits <= 3] * place, size):
                found.append((before, now))
    return found


def run_page(path, names, capsys):
    for code, printed in blocks_of(path):
        exec(compile(code, path.name, "exec"), names)
        shown = capsys.readouterr().out
        assert structure(shown) == structure(printed)
        assert not stale(printed, shown)


@pytest.fixture(scope="module")
def after_readme(tmp_path_factory):
    """Names that the example of the start page has made, what it printed and says, its folder."""
    names: dict = {}
    printed, folder = io.StringIO(), tmp_path_factory.mktemp("clone")
    (folder / "data_schema").mkdir()
    shutil.copy(ROOT / "data_schema" / "example.h5", folder / "data_schema")
    with contextlib.redirect_stdout(printed), contextlib.chdir(folder):
        (code, told), *others = blocks_of(ROOT / "README.md")
        exec(compile(code, "README.md", "exec"), names)
    assert not others
    return names, printed.getvalue(), told, folder


def test_readme_example_prints_and_draws_what_the_readme_shows(after_readme):
    _, printed, told, folder = after_readme
    assert structure(printed) == structure(told)
    assert not stale(told, printed)
    shown, drawn = str(ROOT / "docs" / "fit.png"), str(folder / "fit.png")
    assert compare_images(shown, drawn, TOLERANCE) is None


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_examples_of_a_page_print_what_it_says(path, after_readme, tmp_path, monkeypatch, capsys):
    shutil.copytree(after_readme[-1], tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    run_page(path, dict(after_readme[0]), capsys)


def test_every_example_of_the_guide_is_run():
    text = "".join(path.read_text("utf-8") for path in (ROOT / "docs").glob("*.md"))
    assert text.count("```python") == sum(len(blocks_of(page.values[0])) for page in PAGES) > 10
