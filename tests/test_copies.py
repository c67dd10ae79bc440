"""Copies and pickles of every public object keep types and bytes, in a process of float32 too."""

import concurrent.futures
import copy
import dataclasses
import inspect
import multiprocessing
import pickle
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
import etid.display
from etid.simulation.calibration import CheckedCalibration

ARRAYS = jax.Array | np.ndarray | np.generic


def described(one, place=""):
    """Place, class, type and bytes of every array and number below an object."""
    if isinstance(one, ARRAYS):
        data = np.asarray(one)
        plain = data.tolist() if data.dtype.kind == "O" else data.tobytes()
        kind = "jax" if isinstance(one, jax.Array) else type(one).__name__
        return [(place, kind, str(data.dtype), data.shape, plain)]
    if isinstance(one, Mapping) and not isinstance(one, etid.Study):
        items = sorted(one.items(), key=str)
    elif isinstance(one, tuple | list):
        items = list(enumerate(one))
    elif dataclasses.is_dataclass(one) or type(one).__module__.startswith(("etid", "circuit str")):
        slots = [name for kind in type(one).__mro__ for name in getattr(kind, "__slots__", ())]
        items = [(name, getattr(one, name)) for name in slots if hasattr(one, name)]
        items += getattr(one, "__dict__", {}).items()
    else:
        return [
            (place, type(one).__name__, repr(one) if isinstance(one, int | float | str) else "")
        ]
    found = [(place, type(one).__name__)]
    for name, value in items:
        if name not in ("_close", "_spectra", "__weakref__"):
            found += described(value, f"{place}.{name}")
    return found


def objects():
    """One of each public class."""
    scene = etid.scenes.paper_dry(snr_db=60.0)
    study = scene.simulate(seed=0)
    calibration, recording = study["calibration/98k8"], study["typical/dry/01"]
    driver = etid.identify_driver(calibration, order=5)
    fit = etid.identify_skin(recording, driver)
    f = np.geomspace(1e2, 1e5, 20)
    z = np.asarray(etid.SkinRC().response(f))
    fits = etid.identify_skins([recording, recording.replace(path="b", subject="b")], driver)
    tracker = etid.display.Tracker.of(driver, calibration, electrodes=2)
    plain = etid.identify_driver(calibration, order=5, method="steiglitz_mcbride", throw=False)
    measured = etid.identify_impedance(f, z, stderr=0.01 * abs(z))
    selection = etid.select_circuit(recording, driver, candidates=[etid.SkinRC()])
    bounds = etid.bound(dataclasses.replace(scene, trials=scene.trials[:1]))
    return [
        *(of() for of in (*CIRCUITS, *ESTIMATORS)),
        etid.SkinRC(*jnp.arange(1.0, 4.0)),
        dataclasses.replace(etid.circuit("R0-p(R1,CPE1)"), r_0=jnp.array(1e3)),
        etid.SkinLayers().impedance(),
        scene,
        study,
        recording,
        recording.samples["v_th"],
        driver,
        plain,
        fit,
        measured,
        fits,
        fits[1],
        etid.StudyFits(fits, {("calibration/98k8",): driver}, {}),
        fit.budget(),
        fit.posterior(draws=100),
        fit.residual(),
        etid.compare(fit, recording),
        etid.Profile("r_s", "ohm", 2e4, 1e2, np.arange(3.0), np.arange(3.0)),
        selection,
        *selection.candidates,
        etid.variation(fits, "r_p", ("subject",)),
        etid.kramers_kronig(f, z, stderr=0.01 * abs(z)),
        bounds,
        *bounds.values(),
        CheckedCalibration(driver, [1e-3], {}),
        tracker,
        tracker.start(),
        etid.display.Controller.of(tracker),
        etid.Instrument(gain=0.01),
        etid.Filter.of(np.array([1.0]), np.array([1.0, -0.5])),
        etid.Likelihood.of(
            recording.v_th, recording.v_out, driver, sample_rate=200e3, pulse_rate=60.0
        ),
        etid.Layout(("1",), np.zeros(1), np.zeros(1)),
        etid.RESULTS.successful,
        etid.RecordingError("is wrong", file="a.h5", field="v_th"),
        etid.IdentificationError("is wrong", fit),
    ]


CIRCUITS = [
    etid.ParallelRC,
    etid.Resistor,
    etid.SkinCole,
    etid.SkinCurrent,
    etid.SkinLayers,
    etid.SkinRC,
    etid.SkinWarburg,
]
ESTIMATORS = [
    etid.MaximumLikelihood,
    etid.OutputError,
    etid.SteiglitzMcBride,
]


@pytest.fixture(scope="module")
def public():
    """The objects, made in a process of float32."""
    with jax.enable_x64(False):
        yield objects()


def test_every_public_class_is_here(public):
    named = [getattr(of, name) for of in (etid, etid.display) for name in of.__all__]
    classes = {of for of in named if inspect.isclass(of)}
    wanted = {of for of in classes if not inspect.isabstract(of)}
    missing = {of for of in wanted if not any(isinstance(one, of) for one in public)}
    assert missing == set()


@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))],
    ids=["copy", "deepcopy", "pickle"],
)
def test_copies_keep_type_and_bytes(public, copied):
    with jax.enable_x64(False):
        for one in public:
            assert described(copied(one)) == described(one)


def test_a_worker_that_is_spawned_gets_type_and_bytes(public):
    spawned = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, spawned) as pool:
        found = list(pool.map(described, public))
    assert found == [described(one) for one in public]


def test_a_fit_with_a_driver_from_a_pickle_is_the_same():
    """In a process of float32, the default: other precision is no error of types, and no digits."""
    with jax.enable_x64(False):
        study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
        driver = etid.identify_driver(study["calibration/98k8"], order=5)
        fit, again = (
            etid.identify_skin(study["typical/dry/01"], of)
            for of in (driver, pickle.loads(pickle.dumps(driver)))
        )
        np.testing.assert_array_equal(fit.circuit.values(), again.circuit.values())
        np.testing.assert_array_equal(fit.cov, again.cov)
