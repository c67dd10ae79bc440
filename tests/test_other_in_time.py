"""Score tests of output error: slopes, the size of what is seen, and whole identifications."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.failure_axes import Cole, TwoLayers
from benchmarks.ladder import CALIBRATION, LOADS, rung
from etid.circuits.elements import capacitor, resistor
from etid.circuits.impedance import parallel, series
from etid.estimators.output_error.information import Slopes
from etid.estimators.output_error.prediction import (
    Records,
    impulse,
    impulse_response,
    loaded_filter,
    predict,
    prepare,
    residual_variance,
)
from etid.estimators.score_tests.other_circuit import relaxations
from etid.estimators.score_tests.other_in_time import HIGHEST, relaxed, score
from etid.estimators.unknowns import Nuisance
from etid.results.driver import SourceImpedance
from etid.signals.noise import Measurement
from etid.simulation.scenes import Trial

RATE = 200e3
prepared = eqx.filter_jit(prepare)  # operation by operation, it takes seconds
NONE = jnp.zeros(0)
R, POLE = jnp.log(jnp.asarray(5e3)), jnp.log(jnp.array([2e4]))
SOURCE = SourceImpedance(R, NONE, NONE, NONE, NONE, POLE, jnp.array([9e3]))
SKIN = etid.SkinRC(33e3, 186e3, 0.12e-9)


def records(sigma: float = 1e-3, count: int = 600) -> Records:
    """A pulse, of which nothing is measured."""
    v_th = jnp.exp(-(((jnp.arange(float(count)) - 150) / 20) ** 2))
    noise = jnp.asarray(sigma)
    return prepared(Measurement(v_th, 0 * v_th, noise, noise, jnp.asarray(RATE)))


@pytest.mark.slow
def test_slopes_are_those_of_a_load_with_one_more_relaxation():
    """The load as a whole, its relaxation a resistor and a capacitor, made a little larger."""
    of, step = records(), 1e-6
    impedance = SKIN.impedance()
    found = jax.jit(relaxed)(of, SOURCE, impedance, Nuisance.of(jnp.zeros(4)))
    corner, level = relaxations(impedance, RATE / of.intervals, jnp.asarray(HIGHEST))

    @jax.jit
    @jax.vmap
    def whole(corner, r):
        more = series(impedance, parallel(resistor(r), capacitor(1 / (corner * r))))
        system = loaded_filter(SOURCE, more.rational(), of.sample_rate)
        return predict(system, of, Nuisance.of(jnp.zeros(5))), impulse_response(system)

    sides = zip(whole(corner, step * level), whole(corner, -step * level), strict=True)
    for side, (high, low) in zip((found.v_out, found.h), sides, strict=True):
        # Differences have lost nine digits, of voltages of one volt.
        np.testing.assert_allclose(side.T, (high - low) / (2 * step), atol=1e-7)


@pytest.mark.slow
def test_scores_say_how_far_a_residual_goes_along_a_change():
    """z grows with ε, ε is found, and noise of the same power alone gives z of one."""
    of, rng = records(), np.random.default_rng(9)
    rows = of.hold.shape[0]
    found = jax.jit(relaxed)(of, SOURCE, SKIN.impedance(), Nuisance.of(jnp.zeros(4)))
    h = jax.jit(lambda z: impulse_response(loaded_filter(SOURCE, z.rational(), of.sample_rate)))(
        SKIN.impedance()
    )
    s = residual_variance(of, h)

    @jax.jit
    def scores(residual):
        # The first parameter is an element; then a source without any doubt, and the delay.
        jacobian = jnp.zeros((rows, 4)).at[:, 0].set(found.v_out[:, 3] / 3 + 0.1)
        at = Slopes(residual, jacobian / jnp.sqrt(s), h, jnp.zeros((h.size, 4)))
        nothing = jnp.zeros(4)
        return score(of, found, at, jnp.zeros((1, 1)), 1, nothing, nothing + 1e-12, 1)

    for epsilon in (0.1, -0.2):
        seen = scores(epsilon * found.v_out[:, 4] / jnp.sqrt(s))
        # The noise of V_th in P moves with ε, and is no part of this residual: below a per cent.
        assert float(seen.size[4]) == pytest.approx(epsilon, rel=0.01)
        assert float(jnp.abs(seen.z[4])) > 5
    z = []
    for _ in range(60):
        noise = rng.normal(size=(2, rows + 2 * h.size)) * 1e-3
        k = np.asarray(impulse())[:, 0]
        filtered = np.convolve(noise[0], k, "same") + np.convolve(noise[1], h, "same")
        z.append(np.asarray(scores(filtered[h.size : h.size + rows] / jnp.sqrt(s)).z))
    # 60 draws of each of 7, which go together: 10 % is one standard error of the mean square.
    assert np.mean(np.square(z)) == pytest.approx(1, abs=0.4)


def identified(load, snr_db: float, samples: int, circuit=None, method="output_error"):
    scene = dataclasses.replace(
        rung("dry", snr_db=snr_db, samples=samples), trials=(Trial("skin", load),)
    )
    study = scene.simulate(12)
    if method == "maximum_likelihood":  # which needs several periods
        calibration = dataclasses.replace(scene, samples=10_000, trials=()).simulate(12)
    else:
        calibration = study
    driver = etid.identify_driver(calibration[CALIBRATION], method=method)
    return etid.identify_skin(
        study["skin"], driver, circuit=circuit, method="output_error", throw=False
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", ["output_error", "maximum_likelihood"])
@pytest.mark.parametrize(
    ("load", "snr_db", "verdicts"),
    [
        # A wrong circuit bends the valley, in which a fit may also spend its steps.
        (Cole(LOADS["damp"], 0.9), 40.0, ("misfit", "max_steps_reached")),
        (TwoLayers(LOADS["dry"], 0.3), 40.0, ("misfit", "max_steps_reached")),
        *((LOADS[skin], snr_db, ("successful",)) for skin in LOADS for snr_db in (40.0, 80.0)),
    ],
)
def test_output_error_sees_another_skin_and_only_that(load, snr_db, verdicts, method):
    fit = identified(load, snr_db, 3334, method=method)
    assert fit.chi2 < 1.5 or verdicts == ("successful",)
    assert fit.verdict in verdicts
