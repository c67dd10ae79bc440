"""Parts of pages that are made from the code: `<!-- made: NAME -->` in a page.

The tables of verdicts and remarks come from their messages, the tests from the table of directions,
the command line from its parsers, and the reference from the names that `etid` and `etid.display`
export. The report is that of the example, as `etid report` writes it.
"""

import os
import pathlib
import re
import tempfile
import types

import optimistix as optx
from properdocs.structure.files import File

import etid
import etid.display
from etid import cli
from etid.circuits import directions
from etid.display.__main__ import PROGRAM
from etid.display.__main__ import parser as parser_of_display
from etid.recordings import remarks
from etid.results import verdicts

ROOT = pathlib.Path(__file__).parents[2]
MARK = re.compile(r"^<!-- made: (\w+) -->$", re.MULTILINE)
REPORT = "example_report.html"
BORROWED = ("successful", "max_steps_reached", "nonfinite")  # from optimistix, see etid.RESULTS


def on_files(files, config):
    """Add the report of the example."""
    with tempfile.TemporaryDirectory() as folder:
        fits, page = (pathlib.Path(folder) / name for name in ("fits.h5", REPORT))
        etid.fit_file(ROOT / "data_schema" / "example.h5", fits)
        etid.write_report(fits, page)
        files.append(File.generated(config, REPORT, content=page.read_text("utf-8")))
    return files


def on_page_markdown(markdown, page, config, files):
    """Replace the marks."""
    return MARK.sub(lambda mark: MADE[mark[1]](), markdown)


def table_of_verdicts():
    """Table of all verdicts of etid and their messages."""

    def names(kind):
        return list(vars(kind)["_name_to_item"])

    own = [name for name in names(etid.RESULTS) if name not in names(optx.RESULTS)]
    said = {name: " ".join(verdicts.message(name).split()) for name in (*BORROWED, *own)}
    said["successful"] = "The model explains the recording down to its noise."
    rows = [f"| `{name}` | {text} |" for name, text in said.items()]
    return "\n".join(["| verdict | what it says |", "|---|---|", *rows])


def table_of_remarks():
    """Table of all remarks and their sentences."""
    rows = [f"| `{one.name}` | {remarks.texts(one)[0]} |" for one in remarks.Remark]
    return "\n".join(["| remark | what it says |", "|---|---|", *rows])


def table_of_tests():
    """Table of the changes for which a fit tests, with their limits."""
    rows = []
    for of in directions.DIRECTIONS.values():
        least = f"ε of {of.least:g}" if of.least else f"{100 * of.moves:g} % of an element"
        every = filter(None, (*of.looks, of.looks_back))
        for looks in dict.fromkeys(every) if of.verdict else ():
            rows.append(f"| {looks} | {of.limit:.2g} | {least} | `{of.verdict}` |")
    heads = "| the residual looks like | limit of \\|z\\| | and at least | verdict |"
    return "\n".join([heads, "|---|---|---|---|", *rows])


PROGRAMS = (
    "waveform", "design", "own_circuit", "own_solver", "own_prior", "profile", "hierarchy",
    "variation", "batches", "correct_driver", "pulse", "any_record", "export_nwb",
)  # fmt: skip


def programs():
    """The short programs of `examples`, each under the first line of its docstring."""
    parts = []
    for name in PROGRAMS:
        _, said, code = (ROOT / "examples" / f"{name}.py").read_text("utf-8").split('"""', 2)
        title, *more = said.strip().split("\n\n")
        place = f"`python examples/{name}.py`"
        parts += [f"## {title.rstrip('.')}", *more, place, f"```python\n{code.strip()}\n```"]
    return "\n\n".join(parts)


def commands():
    """Help of all commands, as the terminal shows it."""
    os.environ["COLUMNS"] = "90"
    parser = cli.parser()
    helps = {"etid": parser.format_help()}
    for action in parser._actions:
        if isinstance(action.choices, dict):
            helps |= {f"etid {name}": one.format_help() for name, one in action.choices.items()}
    helps[PROGRAM] = parser_of_display().format_help()
    return "\n\n".join(f"### {name}\n\n```text\n{text}```" for name, text in helps.items())


# What one does with a name, by the package that has it.
TASKS = {
    "Read, import and export recordings": ("recordings", "files"),
    "Identify": ("identify", "selection", "nonlinear"),
    "Use the results": ("results",),
    "Show and share": ("plotting", "report"),
    "Simulate and plan": ("simulation",),
    "Circuits": ("circuits",),
    "Methods": ("estimators",),
}


def reference():
    """Reference of all names that `etid` exports, by task, and of those of `etid.display`."""
    names = sorted(set(etid.__all__) - {"__version__"}, key=str.lower)
    of = {name: _package(getattr(etid, name)) for name in names}
    missing = {name for name, package in of.items() if package not in sum(TASKS.values(), ())}
    assert not missing, f"no task has {missing}"
    parts = []
    for heading, packages in TASKS.items():
        parts.append(f"## {heading}")
        parts += [f"::: etid.{name}" for name, package in of.items() if package in packages]
    parts.append("## Follow a display: `import etid.display`")
    parts += [f"::: etid.display.{name}" for name in etid.display.__all__]
    return "\n\n".join(parts)


def _package(named):
    """The package of etid that a class, a function or a module comes from."""
    name = named.__name__ if isinstance(named, types.ModuleType) else named.__module__
    return name.split(".")[1]


def report():
    """The report of the example in a frame."""
    return f'<iframe class="page" src="{REPORT}" title="The report of the example"></iframe>'


MADE = {
    "report": report,
    "verdicts": table_of_verdicts,
    "remarks": table_of_remarks,
    "tests": table_of_tests,
    "commands": commands,
    "programs": programs,
    "reference": reference,
}
