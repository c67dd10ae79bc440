"""The uncertainty budget of one fit.

A source z of the shared errors has a standard normal prior. If its mean moves by 1, the estimate
moves by its column of H⁻¹ (`etid.estimators.sandwich`). A tolerance that nobody stated gets a prior
so narrow that the recording tells nothing about it.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood import load_fit
from etid.estimators.maximum_likelihood.search import minimum
from etid.identify.posterior import Known, given, terms_of
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.recording import Recording
from etid.results.budget import EXAMPLES, Budget
from etid.results.driver import Driver, HarmonicDriver
from etid.results.fit import Fit
from etid.results.instrument import Instrument

NARROW = 1e-3  # of an example: a prior that no recording changes


@program
def _effects(lane: Harmonics, known: Known, circuit: AbstractCircuit) -> Float[Array, "z element"]:
    """Change of the logarithms of the elements by each z."""
    load = terms_of(lane, known, circuit)
    gains = load.gains
    start = [circuit.log_values(), jnp.zeros(gains.outputs), known.driver.mean]
    least = minimum(load, jnp.concatenate(start))[1]
    return load_fit.covariance_of_priors(load, least)[gains.owned :, : gains.elements]


@in_float64
def budget(fit: Fit, recording: Recording | None, driver: Driver | None) -> Budget:
    """`Fit.budget`."""
    recording, driver = fit.source_or_own(recording, driver)
    if not isinstance(driver, HarmonicDriver):
        raise ValueError(
            "a budget needs the driver of the fit, with the harmonics of its calibrations; "
            "identify it by maximum likelihood, and pass it as in fit.budget(recording, driver)"
        )
    told = driver.instrument.stored() if driver.instrument is not None else {}
    stated = {name: told.get(name, 0.0) for name in EXAMPLES}
    narrow = {name: stated[name] or NARROW * size for name, size in EXAMPLES.items()}
    asked = dataclasses.replace(driver, instrument=Instrument(**narrow).as_arrays())
    lane, known, _ = given(fit, recording, asked)
    effects = np.asarray(_effects(lane, known, fit.circuit))
    gain, crosstalk, capacitance, *r_load = effects[-3 - driver.calibration.r_load.size :]
    of = {"gain": gain, "crosstalk": crosstalk, "capacitance": capacitance}
    of |= {"r_load": np.sqrt(np.sum(np.square(r_load), axis=0))}  # independent resistors
    values = np.asarray(fit.circuit.values())
    cov, shared = (np.diagonal(np.asarray(of)) / values**2 for of in (fit.cov, fit.shared_cov))
    of = {name: np.abs(effect) for name, effect in of.items()}
    instrument = {name: of[name] for name, size in stated.items() if size}
    rest = shared - sum(part**2 for part in instrument.values())
    return Budget(
        names=fit.circuit.names(),
        parts={
            "recording": np.sqrt(cov - shared),
            "driver": np.sqrt(np.maximum(rest, 0.0)),
            **instrument,
        },
        tolerances={name: size for name, size in stated.items() if size},
        unstated={name: of[name] / NARROW for name, size in stated.items() if not size},
    )
