"""The house: imports go down, importing does nothing else."""

import ast
import pathlib
import subprocess
import sys

import pytest

import etid

PACKAGE = pathlib.Path(etid.__file__).parent
FLOORS = {
    "citations": 0,
    "filtering": 0,
    "noise": 0,
    "remarks": 0,
    "report": 0,
    "precision": 0,
    "prefetch": 0,
    "tables": 2,
    "errors": 0,
    "limits": 0,
    "untrusted": 1,
    "traces": 0,
    "spectra": 0,
    "transfer": 0,
    "units": 0,
    "uncertainty": 0,
    "verdicts": 0,
    "schema": 0,
    "schema_page": 1,
    "elements": 1,
    "mains": 1,
    "rounding": 1,
    "circuits": 2,
    "other_circuit": 2,
    "recording": 1,
    "arguments": 4,
    "driver": 2,
    "results": 3,
    "repeats": 4,
    "changes": 5,
    "measurement": 2,
    "scan": 2,
    "worst_fits": 5,
    "study_tables": 5,
    "writing": 2,
    "levenberg_marquardt": 2,
    "transformer": 2,
    "arrowhead": 3,
    "likelihood": 3,
    "preflight": 3,
    "pulse_train": 0,
    "alignment": 1,
    "study": 3,
    "prediction": 3,
    "steiglitz_mcbride": 4,
    "netlist": 3,
    "periodic": 0,
    "methods": 5,
    "settings": 4,
    "study_fits": 5,
    "hdf5": 4,
    "channels": 3,
    "mapping": 4,
    "formats": 4,
    "formats.abf": 4,
    "formats.delimited": 4,
    "formats.mat5": 3,
    "formats.matlab": 4,
    "formats.npz": 4,
    "formats.tdms": 4,
    "sampling": 5,
    "imported": 6,
    "importing": 7,
    "nwb": 5,
    "exporting": 6,
    "scenes": 4,
    "information": 4,
    "harmonic_steiglitz_mcbride": 5,
    "bounds": 5,
    "impedance": 5,
    "other_in_time": 5,
    "output_error": 6,
    "judging": 7,
    "maximum_likelihood": 7,
    "non_parametric": 7,
    "baseline": 9,
    "methods_section": 10,
    "given_driver": 8,
    "unloaded": 4,
    "missing_pole": 8,
    "resistors": 8,
    "single_load": 9,
    "estimation": 10,
    "lanes": 11,
    "shared_terms": 8,
    "shared_errors": 9,
    "shared_driver": 10,
    "identify": 12,
    "batch": 13,
    "bands": 3,
    "pulse": 7,
    "online": 12,
    "plotting": 14,
    "plotting.elements": 6,
    "plotting.impedances": 4,
    "plotting.pulses": 13,
    "plotting.style": 0,
    "joint": 14,
    "streaming": 14,
    "experiments": 14,
    "study_figures": 15,
    "waveforms": 16,
    "study_report": 17,
    "demo": 15,
    "commands": 16,
    "commands.check": 17,
    "commands.exporting": 17,
    "commands.fit": 17,
    "commands.importing": 17,
    "commands.report": 18,
    "commands.simulate": 17,
    "cli": 19,
    "__main__": 19,
    "__init__": 19,
}


def module_of(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


def imports_of(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "etid":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("etid."):
            package = node.module.removeprefix("etid.")
            names = [f"{package}.{alias.name}" for alias in node.names]
            yield from ((name if name in FLOORS else package) for name in names)
        elif isinstance(node, ast.Import):
            yield from (
                alias.name.removeprefix("etid.")
                for alias in node.names
                if alias.name.startswith("etid.")
            )


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=module_of)
def test_imports_go_down(path):
    module = module_of(path)
    assert module in FLOORS, f"give {module} a floor"
    for name in imports_of(path):
        if name == "__version__":
            continue
        assert name in FLOORS, f"{module} imports {name}, which is no module of etid"
        assert FLOORS[name] < FLOORS[module], f"{module} imports {name} from above"


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )


def test_importing_prints_nothing_and_changes_no_setting():
    code = """
import jax
before = dict(jax.config.values)
import sys, etid
assert dict(jax.config.values) == before
assert not {"matplotlib", "pandas", "jaxopt", "pyarrow", "pynwb"} & set(sys.modules), "too much"
"""
    done = run(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_float32_is_refused_with_the_line_to_add():
    code = """
import numpy as np, etid
v = np.ones(1000)
cal = etid.Recording(v, v, sample_rate=2e5, pulse_rate=60.0, r_load=1e5)
etid.identify_driver(cal)
"""
    done = run(code)
    assert done.returncode == 1
    assert 'jax.config.update("jax_enable_x64", True)' in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("or set the environment variable")
