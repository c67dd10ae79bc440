"""Pages of the executed notebooks, with their figures.

`make notebooks` executes the notebooks; this hook executes those that are older than their source.
Every output on a page comes from the code above it. A notebook becomes the page
`notebooks/NAME.md`. The mark `<!-- gallery -->` becomes a list of all notebooks with their first
figure.
"""

import concurrent.futures
import functools
import os
import pathlib
import re
import time

import jupytext
import nbclient
import nbconvert
import nbformat
from properdocs.plugins import event_priority, get_plugin_logger
from properdocs.structure.files import File

ROOT = pathlib.Path(__file__).parents[2]
MARK = "<!-- gallery -->"
SECONDS = 300  # time limit of one notebook

log = get_plugin_logger("gallery")


def executed(path):
    """Markdown of an executed notebook, its figures by name, and its run time [s]."""
    made = path.parent / "executed" / f"{path.stem}.ipynb"
    if made.exists() and made.stat().st_mtime > path.stat().st_mtime:
        notebook = nbformat.read(made, as_version=4)
        taken = notebook.metadata["etid"]["seconds"]
    else:
        notebook, taken = _execute(path.read_text("utf-8"))
    body, resources = nbconvert.MarkdownExporter().from_notebook_node(notebook)
    return body, resources["outputs"], taken


@functools.cache  # while a site is served, only changed notebooks are executed again
def _execute(text):
    notebook = jupytext.reads(text, fmt="py:percent")
    begun = time.perf_counter()
    nbclient.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3").execute()
    return notebook, time.perf_counter() - begun


def on_config(config):
    """Add the notebooks to the navigation, below the gallery."""
    pages = [f"notebooks/{path.stem}.md" for path in _notebooks()]
    for group in config.nav:
        for entry in next(iter(group.values())):
            if entry == {"Notebooks": "gallery.md"}:
                entry["Notebooks"] = ["gallery.md", *pages]
    return config


@event_priority(50)
def on_files(files, config):
    """Execute the notebooks and add their pages and figures."""
    paths = _notebooks()
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        # The longest is the last.
        made = dict(zip(reversed(paths), pool.map(executed, reversed(paths)), strict=True))
    for path in paths:
        body, figures, taken = made[path]
        log.info("%s: executed in %.0f s", path.name, taken)
        for name, content in figures.items():
            place = f"notebooks/{path.stem}_{name}"
            files.append(File.generated(config, place, content=content))
            body = body.replace(f"({name})", f"({path.stem}_{name})")
        note = f"*{taken:.0f} s on the machine that made this page; `notebooks/{path.name}`.*"
        title, _, rest = body.strip().partition("\n")
        page = f"{title}\n\n{note}\n{rest}"
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=page))
    return files


def on_page_markdown(markdown, page, config, files):
    """Replace the mark by a list of the notebooks."""
    if MARK not in markdown:
        return markdown
    notebooks = sorted(
        (each for each in files if re.fullmatch(r"notebooks/[^/]*\.md", each.src_uri)),
        key=lambda each: each.src_uri,
    )
    return markdown.replace(MARK, "\n\n".join(map(_card, notebooks)))


def _notebooks():
    return sorted((ROOT / "notebooks").glob("*.py"))


def _card(file):
    """Title, first sentences and first figure of a notebook."""
    text = file.content_string
    title = re.search(r"^# (.*)$", text, re.MULTILINE)[1]
    words = re.search(r"\n\n([^*!#`\s<].*?)(?:\n\n|\Z)", text, re.DOTALL)[1]
    figure = re.search(r"!\[.*?\]\((.*?)\)", text)
    shown = f"\n\n[![{title}](notebooks/{figure[1]})](notebooks/{file.name}.md)" if figure else ""
    return f"## [{title}](notebooks/{file.name}.md)\n\n{' '.join(words.split())}{shown}"
