"""Importing etid does nothing else, and shows what is public."""

import subprocess
import sys
import types

import etid


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )


def test_importing_prints_nothing_and_changes_no_setting():
    code = """
import jax
before = dict(jax.config.values)
import sys, etid
etid.read
from jax._src import xla_bridge
assert dict(jax.config.values) == before
assert not {"matplotlib", "pandas", "jaxopt", "pyarrow", "pynwb"} & set(sys.modules), "too much"
assert not xla_bridge._backends, "JAX has started: a later choice of its platform would be lost"
slow = {f"scipy.{part}" for part in ("fft", "interpolate", "optimize", "special", "stats")}
assert not slow & set(sys.modules), "scipy loads its parts when they are used: import scipy"
"""
    done = run(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_dir_shows_the_public_names_and_no_module():
    shown = dir(etid)
    assert shown == sorted(etid.__all__)
    modules = {name for name in shown if isinstance(getattr(etid, name), types.ModuleType)}
    assert modules == {"scenes"}  # `etid.scenes.paper_skins()` is how its functions are called
