"""Where numbers come from: commit, machine and versions, beside every row of a CSV."""

import csv
import importlib.metadata
import os
import pathlib
import platform
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

ROOT = pathlib.Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"  # of the last full run, which the README shows
PACKAGES = ("etid", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy", "h5py")


def provenance() -> dict[str, str]:
    """Commit, machine and versions."""
    return {
        "commit": _commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def _commit() -> str:
    """The commit, with a + if the working tree differs from it, other than by results of a run."""
    changed = ["git", "diff", "--name-only", "HEAD", "--", ".", f":!{RESULTS}"]
    try:
        commit, names = (
            subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
            for command in (["git", "rev-parse", "--short=12", "HEAD"], changed)
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.strip() + "+" * bool(names)


def _processor() -> str:
    described = pathlib.Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def write_csv(path: pathlib.Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows, each with `provenance` unless it has one of an earlier run; no file if none."""
    if not rows:
        return path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    source = provenance()
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(dict.fromkeys([*rows[0], *source])))
        writer.writeheader()
        writer.writerows({**source, **row} for row in rows)
    return None
