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
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, PRNGKeyArray

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import DELAY_WIDTH, MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.terms import as_list, excess, same_unloaded, stands_out
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import HarmonicDriver
from etid.results.fits import complex_rrse
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.transfer import as_complex, delayed, frequency_variable, power, reciprocal
from etid.solvers.levenberg_marquardt import best_start
from etid.solvers.matrices import inverse

CLEAR = 0.97  # smallest share of signal in the power of a calibration's Y, 15 dB
PAIRS = 4  # pairs of draws that estimate the bias
SEED = 1994


def _clear(calibrations: list[Spectrum]) -> Bool[Array, "calibration harmonic"]:
    """Harmonics that each calibration shows clearly."""
    shown = [s.selected & (signal_share(s.y, s.variance_y) > CLEAR) for s in calibrations]
    return jnp.stack(shown)


def _total(values: list[Array]) -> Array:
    """Sum of arrays."""
    return sum(values[1:], start=values[0])


def _root(x: Float[Array, " harmonic"]) -> Float[Array, " harmonic"]:
    """√x with the derivative 0 at 0."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


class _Measured(eqx.Module):
    """Z_th at the harmonics, and the sources of its errors.

    Attributes:
        z: Z_th [Ω].
        by_x: Derivative of Z_th with respect to the X of each calibration.
        by_y: Variance of Z_th by the noise of the Y of all calibrations.
        apart: Difference of each calibration from the mean [standard deviations].
    """

    z: Complex[Array, " harmonic"]
    by_x: list[Complex[Array, " harmonic"]]
    by_y: Float[Array, " harmonic"]
    apart: list[Complex[Array, " harmonic"]]


class _Model(eqx.Module):
    """The terms of the calibrations and of a load; the load is the last record."""

    circuit: AbstractCircuit
    r_load: Float[Array, " calibration"]
    calibration_rate: Float[Array, ""]
    sample_rate: Float[Array, ""]
    clear: Bool[Array, "calibration harmonic"]
    selected: Bool[Array, " harmonic"]

    def named(self, q: Float[Array, " q"]) -> tuple[LoadUnknowns, Float[Array, " calibration"]]:
        """The unknowns of the load, and the delays of the calibrations [samples]."""
        last = q.size - 1
        elements, late, delay = jnp.split(q, (last - self.r_load.size, last))
        return LoadUnknowns(elements, delay[0]), late

    def load(
        self, q: Float[Array, " q"], frequency: Float[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        """Z_L."""
        load = self.circuit.with_log_values(self.named(q)[0].log_elements).impedance()
        return load(frequency_variable(frequency))

    def z_th(self, q: Float[Array, " q"], records: list[Spectrum]) -> _Measured:
        """Mean of the Z_th of the calibrations, weighted by their variances."""
        z, by_x, by_y, weights = [], [], [], []
        _, late = self.named(q)
        for r, delay, s, clear in zip(self.r_load, late, records[:-1], self.clear, strict=True):
            y = delayed(s.y, s.frequency, -delay, self.calibration_rate)
            inverse_y = reciprocal(y)
            slope = as_complex(r) * inverse_y
            one = slope * s.x - as_complex(r)
            variance = power(slope * s.x * inverse_y) * s.variance_y
            z.append(one)
            by_x.append(slope)
            by_y.append(variance)
            used = clear | ~self.selected  # if not selected, use all: this avoids 0/0
            weights.append(jnp.where(used, 1 / (variance + power(slope) * s.variance_x), 0.0))
        total = _total(weights)
        parts = [w / total for w in weights]
        mean = _total([as_complex(p) * one for p, one in zip(parts, z, strict=True)])
        return _Measured(
            mean,
            [as_complex(p) * slope for p, slope in zip(parts, by_x, strict=True)],
            _total([p**2 * variance for p, variance in zip(parts, by_y, strict=True)]),
            [(one - mean) * as_complex(_root(2 * w)) for one, w in zip(z, weights, strict=True)],
        )

    def _variance(
        self,
        q: Float[Array, " q"],
        records: list[Spectrum],
        y: Complex[Array, " harmonic"],
        of: _Measured,
    ) -> tuple[Float[Array, " harmonic"], Float[Array, " harmonic"]]:
        """Variance of e, and the part that only the load has; `y` is Y without the delay."""
        spectrum = records[-1]
        load = self.load(q, spectrum.frequency)
        own = power(load + of.z) * spectrum.variance_y
        rest = power(y) * of.by_y
        together, shared = -load, jnp.zeros((), dtype=bool)
        for slope, s in zip(of.by_x, records[:-1], strict=True):
            same = same_unloaded(spectrum, s)
            shared = shared | same
            rest = rest + jnp.where(same, 0.0, power(y * slope) * s.variance_x)
            together = together + jnp.where(same, y * slope, 0.0)
        of_x = power(together) * spectrum.variance_x
        return own + rest + of_x, own + jnp.where(shared, 0.0, of_x)

    def _in_time(
        self, q: Float[Array, " q"], records: list[Spectrum]
    ) -> Complex[Array, " harmonic"]:
        """Y of the load, without its delay."""
        spectrum = records[-1]
        late = self.named(q)[0].delay_samples
        return delayed(spectrum.y, spectrum.frequency, -late, self.sample_rate)

    def terms(self, q: Float[Array, " q"], records: list[Spectrum]) -> Float[Array, " term"]:
        """Scaled e, the weak priors of the delays, and differences between calibrations."""
        y, of = self._in_time(q, records), self.z_th(q, records)
        load = self.load(q, records[-1].frequency)
        variance, _ = self._variance(q, records, y, of)
        weight = jnp.where(self.selected, jnp.sqrt(2 / variance), 0.0)
        e = ((load + of.z) * y - load * records[-1].x) * as_complex(weight)
        own, late = self.named(q)
        delays = jnp.append(late, own.delay_samples) / DELAY_WIDTH
        parts = [e.real, e.imag, delays]
        if len(of.apart) > 1:
            apart = jnp.where(self.selected[None, :], jnp.stack(of.apart), 0.0).ravel()
            parts += [apart.real, apart.imag]
        return jnp.concatenate(parts)

    def squares(self, q: Float[Array, " q"], records: list[Spectrum]) -> Float[Array, " harmonic"]:
        """|e|² divided by its variance, also for harmonics that are not selected."""
        y, of = self._in_time(q, records), self.z_th(q, records)
        load = self.load(q, records[-1].frequency)
        e = (load + of.z) * y - load * records[-1].x
        return power(e) / self._variance(q, records, y, of)[0]

    def without_noise(self, q: Float[Array, " q"], records: list[Spectrum]) -> list[Spectrum]:
        """The records with the Y of the load that all other records predict."""
        spectrum, of = records[-1], self.z_th(q, records)
        load = self.load(q, spectrum.frequency)
        g = load * reciprocal(load + of.z)
        late = self.named(q)[0].delay_samples
        y = delayed(g * spectrum.x, spectrum.frequency, late, self.sample_rate)
        return [*records[:-1], eqx.tree_at(lambda s: s.y, spectrum, y)]

    def by_drift(
        self, q: Float[Array, " q"], records: list[Spectrum], driver: HarmonicDriver
    ) -> Float[Array, "parameter term"]:
        """Changes of e by one standard deviation of the drift of each parameter of Z_th."""
        spectrum = records[-1]
        source, unflatten = ravel_pytree(driver.source)

        def changed(direction: Float[Array, " parameter"]) -> Complex[Array, " harmonic"]:
            def z_th(p: Float[Array, " parameter"]) -> Complex[Array, " harmonic"]:
                return unflatten(p).response(spectrum.frequency)

            return jax.jvp(z_th, (source,), (direction,))[1]

        y, of = self._in_time(q, records), self.z_th(q, records)
        weight = jnp.sqrt(2 / self._variance(q, records, y, of)[0])
        weight = jnp.where(self.selected, weight, 0.0)
        e = jax.vmap(changed)(jnp.diag(driver.drift_std())) * (y * as_complex(weight))[None, :]
        return jnp.concatenate([e.real, e.imag], axis=1)

    def private(self, q: Float[Array, " q"], records: list[Spectrum]) -> Float[Array, " harmonic"]:
        """Part of the variance of e that only the load has."""
        y, of = self._in_time(q, records), self.z_th(q, records)
        variance, own = self._variance(q, records, y, of)
        return own / variance


def fit_circuit(
    circuit: AbstractCircuit,
    driver: HarmonicDriver,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
) -> tuple[Estimate, Float[Array, " element"]]:
    """Identify the load of one recording with the harmonics of its driver's calibrations.

    Args:
        circuit: Structure of the load.
        driver: Driver whose calibrations have the same pulse rate.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Starts, stacked; the start that predicts best is refined.

    Returns:
        The estimate, whose parameters are the logarithms of the elements, and the bias that was
        subtracted from them.
    """
    calibration, calibration_rate = driver.calibration, jnp.asarray(driver.sample_rate)
    known, elements = as_list(driver.spectra), candidates.log_elements.shape[1]
    count = min(spectrum.x.size, known[0].x.size)
    records = [jax.tree.map(lambda leaf: leaf[:count], s) for s in (*known, spectrum)]
    clear = _clear(records[:-1])
    selected = clear.any(0) & records[-1].selected
    model = _Model(circuit, calibration.r_load, calibration_rate, sample_rate, clear, selected)

    late = calibration.delay_samples
    late = jnp.broadcast_to(late, (candidates.delay_samples.size, late.size))
    starts = jnp.concatenate(
        [candidates.log_elements, late, candidates.delay_samples[:, None]], axis=1
    )
    best = best_start(lambda q: model.terms(q, records), starts)

    def solve(records: list[Spectrum], start: Float[Array, " q"]) -> optx.Solution:
        return optx.least_squares(
            model.terms, SOLVER, start, args=records, max_steps=MAX_STEPS, throw=False
        )

    solution = solve(records, best)
    q = solution.value
    bias = _bias(lambda noisy: solve(noisy, q).value - q, records)
    freedom = 2 * jnp.sum(selected, dtype=q.dtype) - q.size
    chi2 = jnp.sum(model.terms(q, records)[: 2 * count] ** 2) / freedom
    # The Jacobian at Y = G X: the noise of e in it would count as information.
    clean = model.without_noise(q, records)
    jacobian = jax.jacfwd(model.terms)(q, clean)
    by_term = inverse(jacobian.T @ jacobian)[:elements] @ jacobian.T
    part = model.private(q, clean)
    rest = jacobian.shape[0] - 2 * count - len(known)
    weights = jnp.concatenate([part, part, jnp.zeros(len(known)), jnp.ones(1), jnp.zeros(rest - 1)])
    noise = excess(model.terms(q, records)[: 2 * count], selected)
    noise = jnp.concatenate([noise, jnp.ones(rest + len(known))])
    own_cov = (by_term * (weights * noise)[None, :]) @ by_term.T
    shared = (by_term * ((1 - weights) * noise)[None, :]) @ by_term.T
    if driver.drift is not None:
        by_drift = by_term[:, : 2 * count] @ model.by_drift(q, clean, driver).T
        shared = shared + by_drift @ by_drift.T
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
        hum=stands_out(model.squares(q, records), records[-1]),
    )
    return estimate, bias[:elements]


def _bias(
    change: Callable[[list[Spectrum]], Float[Array, " number"]], records: list[Spectrum]
) -> Float[Array, " number"]:
    """Bias of the parameters by the noise of the records, to second order.

    It is the mean of the changes by added noise and by its negative, which has no part of first
    order (simulation and extrapolation, Cook and Stefanski 1994, with antithetic draws).
    """

    def drawn(
        key: PRNGKeyArray, variance: Float[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        parts = jax.random.normal(key, (2, variance.size), variance.dtype)
        noise = parts * jnp.sqrt(variance / 2)[None, :]
        return jax.lax.complex(noise[0], noise[1])

    def mean_of_pair(key: PRNGKeyArray) -> Float[Array, " number"]:
        noises = []
        last = jax.random.fold_in(key, 0)
        for i, s in enumerate(records):
            own = jax.random.fold_in(key, i + 1)
            same = same_unloaded(s, records[-1])
            # Recordings with the same unloaded record have the same noise of X.
            of_x = jnp.where(same, drawn(last, s.variance_x), drawn(own, s.variance_x))
            noises.append((of_x, drawn(jax.random.fold_in(own, 1), s.variance_y)))

        def refitted(sign: Complex[Array, ""]) -> Float[Array, " number"]:
            return change(
                [
                    eqx.tree_at(lambda s: (s.x, s.y), s, (s.x + sign * a, s.y + sign * b))
                    for s, (a, b) in zip(records, noises, strict=True)
                ]
            )

        return (refitted(as_complex(jnp.ones(()))) + refitted(as_complex(-jnp.ones(())))) / 2

    return jax.lax.map(mean_of_pair, jax.random.split(jax.random.key(SEED), PAIRS)).mean(0)
