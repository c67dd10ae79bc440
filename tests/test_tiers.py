"""NumPy and XLA run the same programs: equal verdicts and numbers, and nothing is compiled."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import etid
from etid.estimators.lanes import unstacked
from etid.numpy_tier import tiers
from etid.numpy_tier.tiers import program

pytestmark = pytest.mark.usefixtures("run_as_for_users")


@pytest.fixture(scope="module")
def studies():
    """Recordings of dry and of damp skin, with much and with little noise."""
    scenes = {"dry": etid.scenes.paper_dry, "damp": etid.scenes.paper_damp}
    return {
        (name, snr): scene(snr_db=snr).simulate(seed=int(snr))
        for name, scene in scenes.items()
        for snr in (60.0, 25.0)
    }


COUNTED = """
import json, pathlib, sys, tempfile
import jax
jax.config.update("jax_enable_x64", True)
import jax.monitoring
import numpy as np
compiled = []

def listen(event, seconds, **of):
    if "backend_compile" in event:
        compiled.append(of.get("fun_name"))

jax.monitoring.register_event_duration_secs_listener(listen)
import etid
from etid import cli

def ran(name, *results):
    print("compiled", json.dumps([name, compiled]))
    compiled.clear()

study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
driver = etid.identify_driver(study["calibration/98k8"], order=5)
fit = etid.identify_skin(study["typical/dry/01"], driver)
print(driver, fit)
ran("the example of the README")
"""

COMMANDS = """
with tempfile.TemporaryDirectory() as folder:
    at = pathlib.Path(folder)
    for command, *files in (
        ("simulate", "paper_dry", "-o", at / "study.h5"),
        ("fit", at / "study.h5", "-o", at / "fits.h5"),
        ("report", at / "fits.h5", "-o", at / "report.html"),
    ):
        assert cli.main([command, *map(str, files)]) == 0
        ran("etid " + command)
"""

OTHERS = """
import matplotlib
matplotlib.use("agg")
from etid.estimators.registry import names
calibration, one = study["calibration/98k8"], study["typical/dry/01"]
ran("posterior", fit.posterior(one, driver))
ran("profile", fit.profile("r_s", one, driver))
ran("predict", etid.predict(one, driver, fit.circuit))
ran("pictures", etid.plot(fit, one, driver), etid.plot(driver, calibration))
ran("joint", etid.identify_jointly(study))
ran("choice of a circuit", etid.select_circuit(one, driver))
for method in set(names()) - {"maximum_likelihood", "output_error"}:
    ran(method, etid.identify_skin(one, driver, method=method, throw=False))
for circuit in (etid.SkinLayers(), etid.SkinCole(), etid.ParallelRC(), etid.Resistor()):
    ran(type(circuit).__name__, etid.identify_skin(one, driver, circuit=circuit, throw=False))
for name, value in {"fixed": 3.3e4, "prior": (3e4, 1e3), "bounds": (1e3, 3.3e4)}.items():
    ran(name, etid.identify_skin(one, driver, throw=False, **{name: {"r_s": value}}))
frequency = np.geomspace(1e2, 1e5, 40)
z = np.asarray(fit.circuit.response(frequency)) * (1 + 1e-3 * np.sin(frequency))
ran("impedance", etid.identify_impedance(frequency, z, throw=False))
study = etid.scenes.paper_dry(current_snr_db=60.0, samples=3334).simulate(seed=0)
calibration, one = study["calibration/98k8"], study["typical/dry/01"]
ran("current", etid.identify_skin(one, throw=False))
ran("current behind a driver", etid.identify_skin(one, driver, throw=False))
single = etid.identify_driver(calibration, throw=False)
ran("a single period", etid.identify_skin(one, single, throw=False))
ran("output error", etid.identify_skin(one, single, method="output_error", throw=False))
"""


def compiled(code, folder):
    """What a new process compiles, by what it does; nothing is cached."""
    done = subprocess.run(
        [sys.executable, "-c", COUNTED + code],
        capture_output=True,
        text=True,
        check=False,
        env={
            **{name: of for name, of in os.environ.items() if not name.startswith("JAX_")},
            "XDG_CACHE_HOME": str(folder),
        },
    )
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("compiled ")]
    return dict(json.loads(line.removeprefix("compiled ")) for line in lines)


def test_the_example_of_the_readme_and_ten_recordings_with_their_report_compile_nothing(tmp_path):
    found = compiled(COMMANDS, tmp_path)
    parts = ("the example of the README", "etid simulate", "etid fit", "etid report")
    assert found == {part: [] for part in parts}


@pytest.mark.slow
def test_no_small_work_compiles_anything(tmp_path):
    found = compiled(OTHERS, tmp_path)
    assert len(found) == 21
    assert not any(found.values()), found


def test_a_fit_depends_neither_on_what_ran_before_nor_on_the_number_of_recordings(studies):
    """And it keeps one thread busy: threads of BLAS that wait would take more time than the fit."""
    study = studies["dry", 60.0]
    calibration, recordings = study["calibration/98k8"], list(study.loaded.recordings())[:3]
    driver = etid.identify_driver(calibration)
    begun = time.process_time(), time.thread_time()
    etid.identify_driver(calibration)
    whole, own = time.process_time() - begun[0], time.thread_time() - begun[1]
    assert whole <= 1.2 * own  # 1.0 was seen, and 3 to 6 with threads
    first = etid.identify_skin(recordings[0], driver)
    few = etid.identify_skins(recordings, driver)
    again = etid.identify_skin(recordings[0], driver)
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    one = unstacked(few.fit)[0]  # other orders of sums
    np.testing.assert_allclose(one.circuit.values(), first.circuit.values(), rtol=1e-9)
    np.testing.assert_allclose(one.cov, first.cov, rtol=1e-6)


def scaled(x):
    return jnp.sin(x) * 2.0


X = np.linspace(0.0, 1.0, 5)


@pytest.fixture
def who(monkeypatch):
    """Names of the functions that NumPy has run."""
    ran, real = [], tiers.translated

    def noted(jaxpr):
        run = real(jaxpr)
        return lambda operands: ran.append("NumPy") or run(operands)

    monkeypatch.setattr(tiers, "translated", noted)
    return ran


def test_numpy_runs_a_small_program_and_xla_batches_transformations_and_what_is_looked_into(who):
    function, x = program(scaled), jnp.asarray(X)
    np.testing.assert_allclose(function(X), 2 * np.sin(X), rtol=1e-15)
    assert who == ["NumPy"]
    for call in (program(scaled, batch=True), jax.jit(function), jax.vmap(function)):
        np.testing.assert_allclose(call(x), 2 * np.sin(X), rtol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda x: function(x).sum())(x), 2 * np.cos(X), rtol=1e-15)
    with jax.disable_jit():
        np.testing.assert_allclose(function(x), 2 * np.sin(X), rtol=1e-15)
    assert who == ["NumPy"]


@pytest.mark.parametrize("batch", [False, True])
def test_nan_and_infinity_are_results_whatever_looks_for_them(batch):
    """Every call of etid ended in FloatingPointError: elements that are not known are NaN."""
    function = program(lambda x: (jnp.log(x), 1 / x), batch=batch)
    with jax.debug_nans(True), jax.debug_infs(True):
        logs, inverse = map(np.asarray, function(np.array([-1.0, 0.0])))
        assert np.isnan(logs[0])
        assert np.isinf(inverse[1])
        with pytest.raises(FloatingPointError):  # the caller's own functions are looked into
            jnp.log(jnp.asarray(-1.0))


def test_xla_runs_what_numpy_cannot_and_the_log_says_so(caplog):
    def own(x):
        return jax.scipy.special.erfinv(x)

    function = program(own)
    with caplog.at_level("INFO", logger="etid"):
        for _ in range(2):
            np.testing.assert_allclose(function(X / 9), scipy.special.erfinv(X / 9), rtol=1e-12)
    lines = [line for line in caplog.messages if "NumPy cannot run" in line]
    assert lines == ["XLA compiles own: NumPy cannot run erf_inv"]


def test_a_program_is_traced_once_for_each_shape_and_setting():
    traces = []

    def counted(x, name):
        traces.append(name)
        return {"x": x + 1, "name": name}

    function = program(counted)
    for _ in range(2):
        assert function(X, "a")["name"] == "a"
        function(X, name="b")
        function(X[:3], "a")
        with jax.numpy_dtype_promotion("standard"):
            function(X, "a")
    assert len(traces) == 4


LONG = """
import jax, numpy as np, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from etid.numpy_tier.tiers import program

@program
def long(x):
    return jax.lax.while_loop(lambda x: x[0] > -1.0, lambda x: jnp.abs(jnp.sin(x)), x)

print("begins", flush=True)
long(np.ones(3))
"""


def test_ctrl_c_ends_a_fit_by_numpy_at_once():
    process = subprocess.Popen(
        [sys.executable, "-c", LONG], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "begins\n"
    time.sleep(2.0)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert errors.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.parametrize("terminal", [True, False])
def test_a_long_compilation_is_announced_once_on_a_terminal_and_not_in_a_file(
    terminal, monkeypatch
):
    def slowly(x):
        time.sleep(0.5)  # tracing and compiling
        return x + 1

    screen, function = io.StringIO(), program(slowly, batch=True)
    monkeypatch.setattr(screen, "isatty", lambda: terminal, raising=False)
    monkeypatch.setattr(tiers, "PATIENCE", 0.05)
    monkeypatch.setattr(tiers, "_told", threading.Event())
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", screen)
        for _ in range(2):
            function(jnp.zeros(3))
    assert screen.getvalue().count("JAX compiles") == terminal
