"""What is said of the package in several places, what it ships, and what importing it does."""

import importlib.metadata
import pathlib
import re
import subprocess
import sys
import tomllib

import h5py
import pytest
import yaml

import etid
from benchmarks import specimens
from etid.report import methods
from etid.results import study_fits

ROOT = pathlib.Path(__file__).parents[1]
# Keys of the Citation File Format 1.2.0, of which the first four are required.
CITATION_KEYS = (
    "cff-version message title authors abstract commit contact date-released doi identifiers "
    "keywords license license-url preferred-citation references repository repository-artifact "
    "repository-code type url version"
).split()


@pytest.fixture(scope="module")
def citation():
    return yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_version_is_the_same_everywhere(citation, project):
    changelog = (ROOT / "CHANGELOG.md").read_text("utf-8")
    newest = re.search(r"^## (\S+)", changelog, re.MULTILINE)
    assert newest is not None
    said = {
        "pyproject.toml": project["version"],
        "CITATION.cff": citation["version"],
        "CHANGELOG.md": newest[1],
        "installed": importlib.metadata.version("etid"),
    }
    assert said == dict.fromkeys(said, etid.__version__)


def test_citation_follows_its_format(citation):
    assert set(citation) <= set(CITATION_KEYS)
    assert set(citation) >= set(CITATION_KEYS[:4])
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] in ("software", "dataset")
    assert all(isinstance(citation[key], str) for key in ("message", "title", "version"))
    assert all(each.keys() <= {"name", "orcid", "website"} for each in citation["authors"])


def test_citation_says_what_the_project_says(citation, project):
    assert citation["license"] == project["license"]
    assert citation["keywords"] == project["keywords"]
    assert [each["name"] for each in citation["authors"]] == [
        each["name"] for each in project["authors"]
    ]


def test_the_conda_recipe_says_what_the_project_says(project):
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text("utf-8"))
    assert recipe["context"]["version"] == project["version"]
    assert f">={recipe['context']['python_min']}" == project["requires-python"]
    assert recipe["about"]["summary"] == project["description"]
    assert recipe["about"]["license"] == project["license"]
    scripts = [f"{name} = {place}" for name, place in project["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts
    named = {"matplotlib-base": "matplotlib"}  # what conda-forge calls it without Qt
    needed = [one.partition(" ") for one in recipe["requirements"]["run"][1:]]
    assert [named.get(name, name) + bound for name, _, bound in needed] == project["dependencies"]


def test_dependencies_have_lower_bounds_and_exact_versions_in_the_constraints(project):
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text("utf-8").split()
    }
    extras = [each for extra in project["optional-dependencies"].values() for each in extra]
    for requirement in [*project["dependencies"], *extras]:
        name, bound = requirement.split(">=")
        assert bound[0].isdigit()
        assert name.lower() in pinned, f"{name} is not in constraints.txt"


def test_annotations_of_all_packages_are_checked():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pytest"]
    found = [of for of in options["ini_options"]["addopts"] if of.startswith("--jaxtyping")]
    packages = {f"etid.{of.parent.name}" for of in (ROOT / "etid").glob("*/__init__.py")}
    checked = found[0].split("=")[1].split(",")
    assert set(checked) == packages | {"beartype.beartype"}


def test_importing_prints_nothing_and_changes_no_setting():
    code = """
import jax
before = dict(jax.config.values)
import sys, etid, etid.display
etid.read
from jax._src import xla_bridge
assert dict(jax.config.values) == before
assert not {"matplotlib", "pandas", "jaxopt", "pyarrow", "pynwb"} & set(sys.modules), "too much"
assert not xla_bridge._backends, "JAX has started: a later choice of its platform would be lost"
slow = {f"scipy.{part}" for part in ("fft", "interpolate", "optimize", "special", "stats")}
assert not slow & set(sys.modules), "scipy loads its parts when they are used: import scipy"
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_first_fit_needs_no_part_of_scipy():
    """Its linear algebra and its transforms take a fifth of a second to import."""
    code = """
import sys, etid
study = etid.read("data_schema/example.h5")
driver = etid.identify_driver(study["calibration/98k8"], order=5)
etid.identify_skin(study["typical/dry/01"], driver)
loaded = {f"scipy.{part}" for part in ("fft", "linalg", "special")} & set(sys.modules)
assert not loaded, loaded
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_clone_that_is_not_installed_writes_its_version(tmp_path, monkeypatch):
    """A folder on PYTHONPATH has no metadata; that must not end a fit after its work."""

    def absent(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    study_fits.versions.cache_clear()
    path = tmp_path / "fits.h5"
    specimens.study_fits().write(path)
    with h5py.File(path) as file:
        assert file.attrs["etid_version"] == etid.__version__
    assert study_fits.versions()[:2] == (f"etid {etid.__version__}", "jax of unknown version")
    assert f"version = {{{etid.__version__}}}" in methods.bibtex(["etid"])
    study_fits.versions.cache_clear()
