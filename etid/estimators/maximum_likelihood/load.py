"""One load, given the calibrations of its driver: terms, derivatives, and the fit.

The likelihood is that of `etid.estimators.maximum_likelihood.terms`, with the z of
`etid.estimators.maximum_likelihood.given_driver` as parameters of Z_th. All parameters act on a
harmonic through three numbers: Z_L, the phase factor of the delay, and W. The code computes the
derivatives with respect to these three and applies the chain rule.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float, Inexact

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.given_driver import (
    AbstractGiven,
    UnloadedSlopes,
    combined,
)
from etid.estimators.maximum_likelihood.terms import (
    apart,
    denoised,
    excess,
    residual,
    shows_hum,
    stands_out,
    variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fits import Support, complex_rrse
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import as_complex, frequency_variable, turns
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations, best_start


class _Slopes(NamedTuple):
    """Derivatives of the residual of a recording at each harmonic.

    Attributes:
        part: The residual.
        by_load: Derivative of the gain with respect to Z_L.
        own: Derivatives of the gain with respect to the elements and the delay.
        by_g: Derivatives of the residual with respect to real and imaginary part of the gain.
        by_w: Derivatives of the residual with respect to both parts of W.
        by_x: Derivatives of the residual with respect to both parts of X; None if X does not
            depend on z.
        by_variance: Derivative of the residual with respect to the logarithm of the variance of X;
            None as for `by_x`.
    """

    part: Float[Array, " part"]
    by_load: Complex[Array, " harmonic"]
    own: Complex[Array, "own harmonic"]
    by_g: tuple[Array, Array]
    by_w: tuple[Array, Array]
    by_x: tuple[Array, Array] | None
    by_variance: Array | None


class Load(eqx.Module):
    """One recording, with all data that its terms need.

    The parameters `q` of the solver are those of `LoadUnknowns`, followed by z unless z = z₀.
    """

    driver: AbstractGiven
    circuit: AbstractCircuit
    spectrum: Spectrum
    unloaded: UnloadedSlopes | None
    sample_rate: Float[Array, ""]

    @classmethod
    def behind(
        cls,
        driver: AbstractGiven,
        circuit: AbstractCircuit,
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
    ) -> "Load":
        """A recording that was made with `driver`."""
        known, unloaded = driver.informed(spectrum)
        return cls(driver, circuit, known, unloaded, sample_rate)

    @property
    def owned(self) -> int:
        """Number of own parameters."""
        return len(self.circuit.names()) + 1

    def split(self, q: Float[Array, "*row q"]) -> tuple[LoadUnknowns, Float[Array, "*row z"]]:
        """The unknowns of the load, and z; or other numbers in the same order."""
        own, mean = LoadUnknowns.of(q[..., : self.owned]), self.driver.mean
        return own, q[..., self.owned :] if q.shape[-1] == self.owned + mean.size else mean

    def load(self, log_elements: Float[Array, " element"]) -> Complex[Array, " harmonic"]:
        """Z_L."""
        s = frequency_variable(self.spectrum.frequency)
        return self.circuit.with_log_values(log_elements).impedance()(s)

    def turns(self, delay_samples: Float[Array, ""]) -> Complex[Array, " harmonic"]:
        """e^(−jωτ)."""
        f = self.spectrum.frequency
        return turns(-f[0] * delay_samples / self.sample_rate, f.size)

    def divided(
        self, load: Complex[Array, " harmonic"], w: Complex[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        """V_out per input at W = W₀ + `w`, without the delay."""
        return self.driver.gain(load, w)

    def at(self, z: Float[Array, " z"]) -> tuple[Complex[Array, " harmonic"], Spectrum]:
        """W − W₀, and the recording with the X that the calibrations estimate."""
        off = jnp.log(self.spectrum.frequency[0] / self.driver.frequency[0])
        w = as_complex(off) * self.driver.w_slope + combined(z, self.driver.slope)
        if self.unloaded is None:
            return w, self.spectrum
        x = self.spectrum.x + combined(z, self.unloaded.x)
        variance = self.spectrum.variance_x * jnp.exp(z @ self.unloaded.log_variance)
        return w, eqx.tree_at(lambda s: (s.x, s.variance_x), self.spectrum, (x, variance))

    def predicted(self, q: Float[Array, " q"]) -> tuple[Complex[Array, " harmonic"], Spectrum]:
        """Gain, and the recording with the X that the calibrations estimate."""
        own, z = self.split(q)
        w, spectrum = self.at(z)
        gain = self.divided(self.load(own.log_elements), w)
        return gain * self.turns(own.delay_samples), spectrum

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms of the recording, and the priors of its delay and of z."""
        g, spectrum = apart(self.predicted, q)
        prior = 1 / self.widths(q)
        return jnp.concatenate([residual(spectrum, g), (prior * (q - self.centre(q)))])

    def centre(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior means of the parameters."""
        return jnp.concatenate([jnp.zeros(self.owned), self.driver.mean])[: q.size]

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the parameters."""
        free = jnp.full(self.owned - 1, jnp.inf)
        own = LoadUnknowns(free, self.driver.delay_width).vector()
        return jnp.concatenate([own, jnp.ones(q.size - self.owned)])

    def slopes(self, q: Float[Array, " q"]) -> _Slopes:
        """Derivatives at each harmonic.

        The parameters change the gain through Z_L, the delay or W. The complex derivatives of these
        serve all parameters. This takes a fifth of the time of one pass for each parameter.
        """
        own, z = self.split(q)
        w, spectrum = self.at(z)

        def unit(v: Inexact[Array, " harmonic"]) -> Inexact[Array, " harmonic"]:
            return jnp.ones_like(v)

        def of_load(
            _,
        ) -> tuple[
            Complex[Array, " harmonic"],
            Complex[Array, "element harmonic"],
            Complex[Array, " harmonic"],
        ]:
            logs = own.log_elements
            by_element = jax.vmap(lambda v: jax.jvp(self.load, (logs,), (v,))[1])(
                jnp.eye(logs.size)
            )
            return self.load(logs), by_element, self.turns(own.delay_samples)

        load, by_element, turns = apart(of_load, q)

        def of_gain(
            _,
        ) -> tuple[
            Complex[Array, " harmonic"], Complex[Array, " harmonic"], Complex[Array, " harmonic"]
        ]:
            divided, by_load = jax.jvp(lambda at: self.divided(at, w), (load,), (unit(load),))
            by_w = jax.jvp(lambda at: self.divided(load, at), (w,), (unit(w),))[1]
            return divided, by_load * turns, by_w * turns

        divided, by_load, turned = apart(of_gain, q)
        late = own.delay_samples
        by_delay = jax.jvp(self.turns, (late,), (jnp.ones_like(late),))[1]
        slopes = jnp.concatenate([by_load[None, :] * by_element, (divided * by_delay)[None, :]])

        g = divided * turns

        def of_g(
            _,
        ) -> tuple[
            Float[Array, " part"],
            tuple[Array, Array],
            tuple[Array, Array] | None,
            Array | None,
        ]:
            by_g = _by_parts(g, lambda a, b: residual(spectrum, jax.lax.complex(a, b)))
            if self.unloaded is None:
                return residual(spectrum, g), by_g, None, None

            def moved(
                a: Float[Array, " harmonic"], b: Float[Array, " harmonic"]
            ) -> Float[Array, " part"]:
                there = eqx.tree_at(lambda s: s.x, spectrum, jax.lax.complex(a, b))
                return residual(there, g)

            def wider(log: Float[Array, " harmonic"]) -> Float[Array, " part"]:
                variance = spectrum.variance_x * jnp.exp(log)
                return residual(eqx.tree_at(lambda s: s.variance_x, spectrum, variance), g)

            zero = jnp.zeros_like(spectrum.variance_x)
            by_variance = jax.jvp(wider, (zero,), (unit(zero),))[1].reshape(2, -1)
            by_x = _by_parts(spectrum.x, moved)
            return residual(spectrum, g), by_g, by_x, by_variance

        part, (real, imaginary), by_x, by_variance = apart(of_g, q)
        by_w = _turned((real, imaginary), turned)
        return _Slopes(part, by_load, slopes, (real, imaginary), by_w, by_x, by_variance)

    def by_changes(self, q: Float[Array, " q"], slopes: _Slopes) -> Float[Array, "change part"]:
        """Derivatives of the residual with respect to changes of the circuit and, last, to a gain.

        The changes are those of `etid.estimators.score_tests.other_circuit`. The gain is that of
        V_out alone. If it is 1 % too large, R_p of dry skin is wrong by a quarter, and χ² shows
        this only at 60 dB.
        """
        impedance = self.circuit.with_log_values(self.split(q)[0].log_elements).impedance()

        def parts(
            _,
        ) -> tuple[
            Complex[Array, "change harmonic"], tuple[Array, Array], Complex[Array, " harmonic"]
        ]:
            _, changes = other_circuit.changes(impedance, self.spectrum.frequency)
            return changes, _turned(slopes.by_g, slopes.by_load), self.predicted(q)[0]

        changes, (real, imaginary), g = apart(parts, q)
        rows = changes.real[:, None] * real[None] + changes.imag[:, None] * imaginary[None]
        rows = rows.reshape(changes.shape[0], -1)
        return jnp.concatenate([rows, _chained(g[None, :], slopes.by_g)])

    def jacobian(
        self, q: Float[Array, " q"]
    ) -> tuple[Float[Array, " part"], Float[Array, "q part"]]:
        """Residual of the recording alone, and its transposed Jacobian."""
        slopes = apart(self.slopes, q)
        return slopes.part, self.chained(q, slopes)

    def chained(self, q: Float[Array, " q"], slopes: _Slopes) -> Float[Array, "q part"]:
        """Transposed Jacobian of the residual."""
        _, _, own, by_g, by_w, by_x, by_variance = slopes
        rows = _chained(own, by_g)
        if q.size == self.owned:
            return rows
        others = _chained(self.driver.slope, by_w)
        if self.unloaded is not None and by_x is not None and by_variance is not None:
            others = others + _chained(self.unloaded.x, by_x)
            wider = self.unloaded.log_variance[:, None, :] * by_variance[None]
            others = others + wider.reshape(others.shape)
        return jnp.concatenate([rows, others])


def _by_parts(
    value: Complex[Array, " harmonic"], function: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    """Derivatives of a residual with respect to real and imaginary part of its argument."""
    at = (value.real, value.imag)
    one, zero = jnp.ones_like(value.real), jnp.zeros_like(value.real)
    by_real, by_imaginary = (jax.jvp(function, at, of)[1] for of in ((one, zero), (zero, one)))
    return by_real.reshape(2, -1), by_imaginary.reshape(2, -1)


def _turned(by: tuple[Array, Array], slope: Complex[Array, " harmonic"]) -> tuple[Array, Array]:
    """Chain rule: derivatives with respect to both parts of a complex variable.

    The argument of the residual depends on this variable with `slope`.
    """
    real, imaginary = by
    return (
        real * slope.real[None, :] + imaginary * slope.imag[None, :],
        imaginary * slope.real[None, :] - real * slope.imag[None, :],
    )


def _chained(slope: Complex[Array, "q harmonic"], by: tuple[Array, Array]) -> Array:
    """Derivatives of a residual whose complex argument depends on real parameters."""
    return jax.lax.map(
        lambda row: (row.real[None, :] * by[0] + row.imag[None, :] * by[1]).ravel(), slope
    )


def _equations(_, q: Float[Array, " q"], load: Load) -> NormalEquations:
    """Normal equations of a load."""
    part, jacobian = load.jacobian(q)
    prior = 1 / load.widths(q)
    rest = prior * (q - load.centre(q))
    return NormalEquations(
        0.5 * (jnp.dot(part, part) + jnp.dot(rest, rest)),
        jacobian @ part + prior * rest,
        jacobian @ jacobian.T + jnp.diag(prior**2),
    ).finite()


# Largest change of W, which is uncertain by 0.1 at 40 dB. At 24 dB one fit of 30 exceeds it. Two of
# 200 fits were wrong by five standard errors; both exceed it.
FAR = 0.5
NO_HUM = 5.0  # standard deviations of a wrong gain, above which it may pass for hum
NEAR = 4.0  # χ² of the likeliest start; below this value the other starts are not tried
# Half a standard error for 3000 terms.
ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3, equations=_equations)
WELL = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=SOLVER.ftol, equations=_equations)


def refined(
    load: Load, start: Float[Array, " q"], solver: LevenbergMarquardt | None = None
) -> optx.Solution:
    """The minimum over the own parameters, and over z if `start` contains it; `WELL` if no solver.

    The default is looked up here, so that a test of derivatives can ask for more digits.
    """
    with_solver = solver or WELL
    return optx.least_squares(
        lambda q, load: load(q), with_solver, start, args=load, max_steps=MAX_STEPS, throw=False
    )


def fit_circuit(
    driver: AbstractGiven,
    circuit: AbstractCircuit,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
) -> tuple[Estimate, Bool[Array, ""], Bool[Array, ""]]:
    """Identify the load of one recording.

    Args:
        driver: Distribution of Z_th at the harmonics of the recording, or the measured current.
        circuit: Structure of the load.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Starts, stacked; the likeliest is the last. The start that predicts best is
            refined.

    Returns:
        The estimate, whose parameters are the logarithms of the elements. Whether W is too far from
        W₀ for its linear distribution. Whether the data show another circuit or another gain of
        V_out.
    """
    load = Load.behind(driver, circuit, spectrum, sample_rate)

    # First with Z_th fixed: from a distant start, a joint fit would distort Z_th.
    starts = candidates.vector()
    likely = starts[-1]
    near = jnp.sum(load(likely) ** 2) < NEAR * 2 * jnp.sum(spectrum.selected, dtype=likely.dtype)
    start = jax.lax.cond(near, lambda: likely, lambda: best_start(load, starts))
    alone = refined(load, start, ROUGHLY).value
    solution = refined(load, jnp.concatenate([alone, driver.mean]), WELL)
    q = solution.value
    own, z = load.split(q)
    g, known = load.predicted(q)
    part = residual(known, g)
    moved = jnp.max(jnp.where(spectrum.selected, jnp.abs(load.at(z)[0]), 0.0))

    # The Jacobian at denoised data: noise in it would count as information.
    [clean], [share] = denoised([known], [g])
    if load.unloaded is not None:  # X contains the effect of this z already
        x = clean.x - combined(z, load.unloaded.x)
        clean = eqx.tree_at(lambda s: (s.x, s.variance_x), clean, (x, load.spectrum.variance_x))
    clean = dataclasses.replace(load, spectrum=clean)
    slopes = apart(clean.slopes, q)
    jacobian = clean.chained(q, slopes)
    prior = 1 / load.widths(q) ** 2
    linear = Linear(jacobian, share, excess(part, spectrum.selected), jnp.diag(prior))
    information, count = linear.bread(), own.log_elements.size
    elements = information[:count]
    by_term = elements @ jacobian
    noise = linear.noise
    rows = clean.by_changes(q, slopes)
    found = other_circuit.scores(
        rows,
        linear,
        part,
        prior * (q - load.centre(q)),
        jax.scipy.linalg.block_diag(jnp.diag(prior[: load.owned]), driver.cov),
        information,
        slice(count),
    )
    other = other_circuit.Scores.of(found, gain=True)
    # If a wrong gain explains the excess of the low harmonics, the excess is no hum.
    gain = rows[-1] - linear.told(rows[-1:])[0] @ information @ jacobian
    rest = jnp.sum((part - found.size[-1] * gain).reshape(2, -1) ** 2, axis=0) / 2
    wrong_gain = (jnp.abs(found.z[-1]) > NO_HUM) & ~stands_out(rest, known)
    # Part of the noise that only this trial has: all, or that of V_out if V_th is shared.
    private = jnp.where(
        jnp.any(known.variance_x != spectrum.variance_x),
        spectrum.variance_y / variance(known, g),
        1.0,
    )
    private = jnp.tile(private, 2)
    by_own, by_z = load.split(elements)
    of_delay = jnp.outer(by_own.delay_samples, by_own.delay_samples) / driver.delay_width**2
    of_driver = by_z @ driver.cov @ by_z.T
    shared = of_driver + (by_term * ((1 - private) * noise)[None, :]) @ by_term.T
    # For an element without any effect the matrix product contains only rounding errors.
    unknown = jnp.diagonal(elements)
    unknown = jnp.diag(jnp.where(unknown > 1, unknown, 0.0))
    change = z - driver.mean
    # Increase of the Σ r² of the calibrations.
    strain = jnp.dot(change, jnp.linalg.solve(driver.cov, change))
    squares, terms = jnp.sum(part**2), 2 * jnp.sum(spectrum.selected, dtype=q.dtype)
    freedom = terms - load.owned
    estimate = Estimate(
        parameters=own.log_elements,
        delay_samples=own.delay_samples[None],
        cov=(by_term * (private * noise)[None, :]) @ by_term.T + of_delay + shared + unknown,
        shared_cov=shared,
        chi2=squares / freedom,
        rrse=complex_rrse(g * spectrum.x, spectrum.y, spectrum.selected),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=strain,
        hum=shows_hum(known, g) & ~wrong_gain,
        support=Support(squares + strain, terms, other.relevant(), *other.spread.possible()),
    )
    return estimate, moved > FAR, other.seen() | other.has_other_gain()
