"""Maximum likelihood without a model of Z_th: one complex number for each harmonic.

At every harmonic, a calibration with R_L gives (R_L + Z) Y₁ = R_L X₁, and a load Z_L gives
(Z_L + Z) Y = Z_L X. The first equation gives Z, and with this Z the residual of the second is

    e = (Z_L + Z) Y − Z_L X,      σ_e² = |Z_L + Z|² σ_y² + |Z_L|² σ_x² + |Y|² var Z,

to first order in the noise of Z. Delays multiply Y and Y₁ by phase factors. Only elements and
delays are fitted. The estimate is valid for a driver of any order, and for a driver that is no
lumped circuit.

A ratio of noisy numbers is biased. Therefore only harmonics that a calibration shows clearly are
used. Below 40 dB `etid.estimators.maximum_likelihood.driver` uses more information (Pintelon and
Schoukens, 2012, ch. 9 and 10).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.profile import excess, stands_out
from etid.estimators.non_parametric.terms import Model, clearly_shown
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import other_circuit
from etid.estimators.score_tests.other_circuit import Scores
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import HarmonicDriver, SourceImpedance
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum, as_list, same_unloaded
from etid.signals.transfer import as_complex, power
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import best_start
from etid.solvers.matrices import inverse

PAIRS = 4  # pairs of draws that estimate the bias
SEED = 1994


def fit_circuit(
    circuit: AbstractCircuit,
    driver: HarmonicDriver,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
) -> tuple[Estimate, Float[Array, " element"], Scores]:
    """Identify the load of one recording with the harmonics of its driver's calibrations.

    Returns:
        The estimate, whose parameters are the logarithms of the elements, the bias that was
        subtracted from them, and the scores of another circuit and of another gain.
    """
    calibration, calibration_rate = driver.calibration, jnp.asarray(driver.sample_rate)
    known, elements = as_list(driver.spectra), candidates.log_elements.shape[1]
    count = min(spectrum.x.size, known[0].x.size)
    records = [jax.tree.map(lambda leaf: leaf[:count], s) for s in (*known, spectrum)]
    clear = clearly_shown(records[:-1])
    selected = clear.any(0) & records[-1].selected
    model = Model(circuit, calibration.r_load, calibration_rate, sample_rate, clear, selected)

    late = calibration.delay_samples
    late = jnp.broadcast_to(late, (candidates.delay_samples.size, late.size))
    starts = jnp.concatenate(
        [candidates.log_elements, late, candidates.delay_samples[:, None]], axis=1
    )
    best = best_start(lambda q: model.terms(q, records), starts)

    def solve(records: list[Spectrum], start: Float[Array, " q"]) -> optx.Solution:
        return least_squares(_terms, SOLVER, start, (model, records), MAX_STEPS)

    solution = solve(records, best)
    q = solution.value
    bias = _bias(lambda noisy: solve(noisy, q).value - q, records)
    freedom = 2 * jnp.sum(selected, dtype=q.dtype) - q.size
    chi2 = jnp.sum(model.terms(q, records)[: 2 * count] ** 2) / freedom
    # The Jacobian at Y = G X: the noise of e in it would count as information.
    clean = model.without_noise(q, records)
    jacobian = jax.jacfwd(model.terms)(q, clean)
    by_term = inverse(jacobian.T @ jacobian)[:elements] @ jacobian.T
    at = model.equation(q, clean)
    others = jacobian.shape[0] - 2 * count
    # The delay of the load is its own; those of the calibrations, before it, are shared.
    alone = jnp.zeros(others).at[len(known)].set(1.0)
    weights = jnp.concatenate([jnp.tile(at.own / at.variance, 2), alone])
    noise = excess(model.terms(q, records)[: 2 * count], selected)
    noise = jnp.concatenate([noise, jnp.ones(others)])
    own_cov = (by_term * (weights * noise)[None, :]) @ by_term.T
    shared = (by_term * ((1 - weights) * noise)[None, :]) @ by_term.T
    drift = None
    if driver.drift is not None:
        drift = model.by_drift(q, clean, driver)
        by_drift = by_term[:, : 2 * count] @ drift.T
        shared = shared + by_drift @ by_drift.T
    seen = model.equation(q, records)
    squares = power(seen.error) / seen.variance  # also of harmonics that are not selected
    estimate = Estimate(
        parameters=(q - bias)[:elements],
        delay_samples=model.named(q)[0].delay_samples[None],
        cov=own_cov + shared,
        shared_cov=shared,
        chi2=chi2,
        rrse=complex_rrse(
            jnp.where(selected, clean[-1].y, 0.0), jnp.where(selected, records[-1].y, 0.0)
        ),
        result=solution.result,
        steps=solution.stats["num_steps"],
        hum=stands_out(squares, records[-1].frequency, records[-1].selected),
    )
    return estimate, bias[:elements], _scores(model, q, records, driver.source, noise, drift)


def _terms(q: Float[Array, " q"], of: tuple[Model, list[Spectrum]]) -> Float[Array, " term"]:
    model, records = of
    return model.terms(q, records)


def _scores(
    model: Model,
    q: Float[Array, " q"],
    records: list[Spectrum],
    source: SourceImpedance,
    noise: Float[Array, " term"],
    drift: Float[Array, "parameter part"] | None,
) -> Scores:
    """Scores of another circuit and of another gain.

    What the driver may have drifted by since its calibration widens them.

    The derivatives are taken at the Z_th of a model. With the measured Z_th, they would contain the
    noise of the residual: z was 10 for undisturbed recordings at 60 dB. A model that is wrong makes
    the test less sensitive only.
    """
    smooth, share = model.predicted(q, records, source)
    jacobian, rows = jax.jacfwd(model.terms)(q, smooth).T, model.changes(q, smooth)
    others = jacobian.shape[1] - rows.shape[1]
    rows = jnp.pad(rows, ((0, 0), (0, others)))
    if drift is not None:
        drift = jnp.pad(drift, ((0, 0), (0, others)))
    linear = Linear(jacobian, jnp.pad(share, (0, others), constant_values=1.0), noise)
    nothing, residual = jnp.zeros((q.size, q.size)), model.terms(q, records)
    elements = slice(model.named(q)[0].log_elements.size)
    found = other_circuit.scores(
        rows, linear, residual, nothing[0], nothing, linear.bread(), elements, drift
    )
    return Scores.of(found, gain=True)


def _bias(
    change: Callable[[list[Spectrum]], Float[Array, " number"]], records: list[Spectrum]
) -> Float[Array, " number"]:
    """Bias of the parameters by the noise of the records, to second order.

    It is the mean of the changes by added noise and by its negative, which has no part of first
    order (simulation and extrapolation, Cook and Stefanski 1994, with antithetic draws).
    """
    # Constants of the program, by pair, record, X or Y, real or imaginary part, and harmonic.
    shape = PAIRS, len(records), 2, 2, records[-1].x.size
    draws = np.random.default_rng(SEED).normal(size=shape)

    def noise(
        of: Float[Array, "2 harmonic"], variance: Float[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        real, imag = of * jnp.sqrt(variance / 2)[None, :]
        return jax.lax.complex(real, imag)

    def mean_of_pair(own: Float[Array, "record 2 2 harmonic"]) -> Float[Array, " number"]:
        noises = []
        for s, (of_x, of_y) in zip(records, own, strict=True):
            same = same_unloaded(s.x, records[-1].x)
            # Recordings with the same unloaded record have the same noise of X.
            of_x = jnp.where(same, own[-1, 0], of_x)
            noises.append((noise(of_x, s.variance_x), noise(of_y, s.variance_y)))

        def refitted(sign: Complex[Array, ""]) -> Float[Array, " number"]:
            return change(
                [
                    eqx.tree_at(lambda s: (s.x, s.y), s, (s.x + sign * a, s.y + sign * b))
                    for s, (a, b) in zip(records, noises, strict=True)
                ]
            )

        return (refitted(as_complex(jnp.ones(()))) + refitted(as_complex(-jnp.ones(())))) / 2

    return jax.lax.map(mean_of_pair, jnp.asarray(draws)).mean(0)
