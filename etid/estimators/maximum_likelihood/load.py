"""One load, given the calibrations of its driver: terms, derivatives, and the fit.

The likelihood is that of `etid.estimators.maximum_likelihood.terms`, with the z of
`etid.estimators.maximum_likelihood.given_driver` as parameters of Z_th.

The objective and its gradient are sums over all harmonics. Curvature, covariance and score tests
need products of a record and derivatives of the gain. The derivatives are smooth in frequency, so
these products are summed at the knots of `etid.signals.knots`. With the noise of X removed,

    x̂ = X + conj(G) σ_x² (Y − G X) / σ²,      σ² = σ_y² + |G|² σ_x²,

the gradient of ½ Σ r² is −Re Σ_k conj(∂G_k) ρ_k with ρ = 2 conj(x̂) (Y − G X) / σ², and the
information is Re Σ_k conj(∂G_k) ∂G_k P_k with P = 2 |x̂|² / σ².
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimate import MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.gain import Gain, Slopes
from etid.estimators.maximum_likelihood.given_driver import AbstractGiven, UnloadedSlopes, combined
from etid.estimators.maximum_likelihood.terms import (
    LOW,
    apart,
    excess,
    residual,
    shows_hum,
    stands_out,
    variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.fits import Support, complex_rrse
from etid.signals.harmonics import Spectrum, real_parts, signal_share
from etid.signals.knots import Knots, knots
from etid.signals.transfer import as_complex, frequency_variable, power, reciprocal, turns
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse_root


class Load(eqx.Module):
    """One recording, with all data that its terms need.

    Attributes:
        gain: The gain at all harmonics.
        spectrum: The recording.
        unloaded: How X depends on z; None if it does not.
    """

    gain: Gain
    spectrum: Spectrum
    unloaded: UnloadedSlopes | None

    @classmethod
    def behind(
        cls,
        driver: AbstractGiven,
        circuit: AbstractCircuit,
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
        prior: ElementPrior | None = None,
    ) -> "Load":
        """A recording that was made with `driver`, and a prior of the elements if there is one."""
        known, unloaded = driver.informed(spectrum)
        gain = Gain(driver, circuit, spectrum.frequency, sample_rate, prior)
        return cls(gain, known, unloaded)

    @property
    def knots(self) -> Knots:
        """Knots of the harmonics."""
        return knots(self.spectrum.frequency.size)

    def centre(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior means of the parameters."""
        return self.gain.centre(q)

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the parameters."""
        return self.gain.widths(q)

    def predicted(self, q: Float[Array, " q"]) -> tuple[Complex[Array, " harmonic"], Spectrum]:
        """Gain, and the recording with the X that the calibrations estimate."""
        z_load, turned, known = self._acting(q)
        return self.gain.driver.gain(z_load, self.gain.w(self.gain.split(q)[1])) * turned, known

    def _acting(
        self, q: Float[Array, " q"]
    ) -> tuple[Complex[Array, " harmonic"], Complex[Array, " harmonic"], Spectrum]:
        """Z_L, e^(−jωτ), and the recording with the X that the calibrations estimate."""
        own, z = self.gain.split(q)
        f = self.spectrum.frequency
        z_load = self.gain.impedance(q)(frequency_variable(f))
        turned = turns(-f[0] * own.delay_samples / self.gain.sample_rate, f.size)
        if self.unloaded is None:
            return z_load, turned, self.spectrum
        x = self.spectrum.x + combined(z, self.unloaded.x)
        variance = self.spectrum.variance_x * jnp.exp(z @ self.unloaded.log_variance)
        known = eqx.tree_at(lambda s: (s.x, s.variance_x), self.spectrum, (x, variance))
        return z_load, turned, known

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms of the recording, and the priors of its delay and of z."""
        prior = 1 / self.gain.widths(q)
        return jnp.concatenate([self.residual(q), prior * (q - self.gain.centre(q))])

    def residual(self, q: Float[Array, " q"]) -> Float[Array, " part"]:
        """Terms of the recording alone."""
        g, spectrum = apart(self.predicted, q)
        return residual(spectrum, g)

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the recording alone; the matrix is its information."""
        return self.evaluated(q)[0]

    def evaluated(self, q: Float[Array, " q"]) -> "tuple[NormalEquations, Around]":
        """Normal equations of the recording alone, and the terms from which they are computed."""
        of = self.gain
        z_load, turned, known = apart(self._acting, q)
        acting = apart(lambda q: of.by_acting(q, z_load, turned), q)
        around = Around.of(self, q, (acting[0], known))
        gradient = of.pulled(q, -jnp.conj(around.score), acting)
        if self.unloaded is not None:
            by_x = self.by_unloaded((acting[0], known)).sum(-1)
            gradient = gradient + jnp.pad(by_x, (of.owned, 0))[: q.size]
        jacobian = around.jacobian
        return NormalEquations(around.objective, gradient, jacobian @ jacobian.T), around

    def at_knots(self, every: Knots) -> Gain:
        """The gain at knots."""
        of, frequency = self.gain, every.at(self.gain.frequency)
        return Gain(of.driver.at_knots(every), of.circuit, frequency, of.sample_rate, of.prior)

    def known(self, q: Float[Array, " q"]) -> Spectrum:
        """The recording with the X that the calibrations estimate."""
        return self.spectrum if self.unloaded is None else self._acting(q)[2]

    def by_unloaded(
        self, at: tuple[Complex[Array, " harmonic"], Spectrum]
    ) -> Float[Array, "z harmonic"]:
        """Derivatives of ½ r² at each harmonic with respect to the z that X depends on."""
        (g, known), slopes = at, self.unloaded
        if slopes is None:
            return jnp.zeros((self.gain.driver.mean.size, g.size))
        weight = jnp.where(known.selected, 1 / variance(known, g), 0.0)
        error = known.y - g * known.x
        by_x = as_complex(2 * weight) * jnp.conj(error) * g
        by_log = weight**2 * power(error) * power(g) * known.variance_x
        return -(by_x[None, :] * slopes.x).real - by_log[None, :] * slopes.log_variance


class Sums(eqx.Module):
    """What the fit of a recording needs around q₀, summed at the knots.

    Attributes:
        gain: The gain at q₀.
        score: ρ.
        power: P.
        by_z: Relative derivatives of X with respect to z; None if X does not depend on z.
        shift: Relative difference of X between z = 0 and q₀.
    """

    gain: Complex[Array, "*load knot"]
    score: Complex[Array, "*load knot"]
    power: Float[Array, "*load knot"]
    by_z: Complex[Array, "*load z knot"] | None
    shift: Complex[Array, "*load knot"] | None


class AtKnots(eqx.Module):
    """The terms of a recording near q₀; they are as good as those of `Load` for small steps.

    Attributes:
        gain: The gain at the knots.
        sums: The recording at the knots.
    """

    gain: Gain
    sums: Sums

    def rows(self, slopes: Complex[Array, "row knot"]) -> Float[Array, "row part"]:
        """Derivatives of the terms, from those of the gain."""
        rows = slopes * as_complex(jnp.sqrt(self.sums.power))[None, :]
        return -real_parts(rows)

    def by_unknown(self, slopes: Slopes) -> Complex[Array, "q knot"]:
        """Derivatives of G X/x̂ with respect to the parameters."""
        own, by_z = self.gain.owned, self.sums.by_z
        if by_z is None or slopes.by_unknown.shape[0] == own:
            return slopes.by_unknown
        of_x = jnp.pad(slopes.gain[None, :] * by_z, ((own, 0), (0, 0)))
        return slopes.by_unknown + of_x

    def residual(self, q: Float[Array, " q"]) -> Float[Array, " part"]:
        """Terms at `q`."""
        return self.rows(self._change(q, self.gain(q))[None, :])[0]

    def _change(
        self, q: Float[Array, " q"], gain: Complex[Array, " knot"]
    ) -> Complex[Array, " knot"]:
        """Change of G X/x̂ from the gain that would leave no residual."""
        of, z = self.sums, self.gain.split(q)[1]
        change = gain - of.gain
        if of.by_z is not None and of.shift is not None:
            change = change + gain * (of.shift + (combined(z, of.by_z) if z.size else 0.0))
        return change - of.score * as_complex(1 / jnp.where(of.power > 0, of.power, 1.0))

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms at `q` and the priors."""
        prior = 1 / self.gain.widths(q)
        return jnp.concatenate([self.residual(q), prior * (q - self.gain.centre(q))])

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the recording alone."""
        slopes = apart(self.gain.slopes, q)
        change = self._change(q, slopes.gain)
        # One matrix product gives all sums.
        rows = self.rows(jnp.concatenate([self.by_unknown(slopes), change[None, :]]))
        products = rows @ rows.T
        return NormalEquations(0.5 * products[-1, -1], products[:-1, -1], products[:-1, :-1])


class _Some(eqx.Module):
    """Terms at the knots of which some parameters are fixed.

    Attributes:
        terms: The terms.
        free: Which parameters are not fixed.
    """

    terms: AtKnots
    free: Bool[Array, " q"]

    @property
    def gain(self) -> Gain:
        """The gain at the knots."""
        return self.terms.gain

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms at `q` and the priors."""
        return self.terms(q)

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the recording alone."""
        of, free = self.terms.equations(q), self.free
        matrix = jnp.where(free[:, None] & free[None, :], of.matrix, 0.0)
        return NormalEquations(of.objective, jnp.where(free, of.gradient, 0.0), matrix)


class Around(eqx.Module):
    """The terms at one point q, linear in the parameters, without the noise of X.

    Attributes:
        at: The terms at the knots.
        q: q.
        slopes: The gain and its derivatives at the knots.
        gain: The gain at all harmonics.
        x: x̂ at all harmonics.
        power: P at all harmonics.
        score: ρ at all harmonics.
        objective: ½ Σ r².
    """

    at: AtKnots
    q: Float[Array, " q"]
    slopes: Slopes
    gain: Complex[Array, " harmonic"]
    x: Complex[Array, " harmonic"]
    power: Float[Array, " harmonic"]
    score: Complex[Array, " harmonic"]
    objective: Float[Array, ""]

    @classmethod
    def of(
        cls,
        load: Load,
        q: Float[Array, " q"],
        at: tuple[Complex[Array, " harmonic"], Spectrum] | None = None,
        every: Knots | None = None,
    ) -> "Around":
        """The terms of `load` around `q`.

        Args:
            load: The recording.
            q: The point.
            at: `load.predicted(q)` if it is known already.
            every: The knots if they are not those of `load`.
        """
        g, known = apart(load.predicted, q) if at is None else at
        every = every or load.knots

        def of_harmonics(_) -> tuple[Array, Array, Array, Array]:
            weight = jnp.where(known.selected, 2 / variance(known, g), 0.0)
            error = known.y - g * known.x
            share = as_complex(0.5 * weight * known.variance_x)
            x = known.x + jnp.conj(g) * share * error
            score = as_complex(weight) * jnp.conj(x) * error
            return x, score, weight * power(x), 0.5 * jnp.dot(weight, power(error))

        x, score, size, objective = apart(of_harmonics, q)
        real, imaginary, total = every.summed(jnp.stack([score.real, score.imag, size]))
        gain = load.at_knots(every)
        by_z = shift = None
        if load.unloaded is not None:
            by_z = every.summed((as_complex(size) * reciprocal(x))[None, :] * load.unloaded.x)
            by_z = by_z * as_complex(1 / jnp.where(total > 0, total, 1.0))[None, :]
            shift = -combined(gain.split(q)[1], by_z)
        slopes = apart(gain.slopes, q)
        sums = Sums(slopes.gain, jax.lax.complex(real, imaginary), total, by_z, shift)
        return cls(AtKnots(gain, sums), q, slopes, g, x, size, score, objective)

    @property
    def jacobian(self) -> Float[Array, "q part"]:
        """Transposed Jacobian."""
        return self.at.rows(self.at.by_unknown(self.slopes))

    @property
    def part(self) -> Float[Array, " part"]:
        """The terms."""
        return self.at.residual(self.q)

    def mean(self, values: Float[Array, "row harmonic"]) -> Float[Array, "row part"]:
        """Means of `values` around the knots, weighted with P."""
        total = self.at.sums.power
        sums = knots(values.shape[1]).summed(values * self.power[None, :])
        return jnp.tile(sums / jnp.where(total > 0, total, 1.0)[None, :], (1, 2))

    def by_falling(self) -> Complex[Array, " harmonic"]:
        """What a resistance that falls with its current adds to V_out [V²]."""
        every, of = knots(self.x.size), self.at.gain
        z = of.impedance(self.q)(frequency_variable(of.frequency))
        sensitivity = self.slopes.by_load * z * reciprocal(self.slopes.gain)
        v_out = every.between(self.slopes.gain) * self.x
        return falling_resistance.added_voltage(v_out, z, sensitivity, every)

    def by_changes(self) -> Complex[Array, "change knot"]:
        """Derivatives of the gain with respect to changes of the circuit and, last, to a gain.

        The changes are those of `etid.estimators.score_tests.other_circuit`. The gain is that of
        V_out alone. If it is 1 % too large, R_p of dry skin is wrong by a quarter, and χ² shows
        this only at 60 dB.
        """
        of = self.at.gain
        _, changes = other_circuit.changes(of.impedance(self.q), of.frequency)
        return jnp.concatenate([changes * self.slopes.by_load[None, :], self.slopes.gain[None, :]])


def _equations(_, q: Float[Array, " q"], problem: Load | AtKnots | _Some) -> NormalEquations:
    """Normal equations of a load, with the priors."""
    return _with_priors(problem.equations(q), q, problem.gain)


def _with_priors(found: NormalEquations, q: Float[Array, " q"], of: Gain) -> NormalEquations:
    prior = 1 / of.widths(q)
    rest = prior * (q - of.centre(q))
    return NormalEquations(
        found.objective + 0.5 * jnp.dot(rest, rest),
        found.gradient + prior * rest,
        found.matrix + jnp.diag(prior**2),
    ).finite()


class _Evaluated(NormalEquations):
    """Normal equations with what the standard errors and tests need at the same point.

    The last point of a fit then need not be evaluated again.

    Attributes:
        around: The terms, without constants and ρ.
    """

    around: Around

    @classmethod
    def at(cls, _, q: Float[Array, " q"], load: Load) -> "_Evaluated":
        """Evaluate a load with the priors."""
        found, around = load.evaluated(q)
        of = _with_priors(found, q, load.gain)
        around = eqx.tree_at(lambda a: (a.at.gain, a.score), around, (None, None))
        return cls(of.objective, of.gradient, of.matrix, around)

    @classmethod
    def empty(cls, q: Float[Array, " q"], load: Load) -> "_Evaluated":
        """Zeros of the same shapes."""
        shapes = eqx.filter_eval_shape(lambda q: cls.at(None, q, load), q)
        return jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shapes)


# Largest change of W, which is uncertain by 0.1 at 40 dB. At 24 dB one fit of 30 exceeds it. Two of
# 200 fits were wrong by five standard errors; both exceed it.
FAR = 0.5
NO_HUM = 5.0  # standard deviations of a wrong gain, above which it may pass for hum
NEAR = 4.0  # χ² of the likeliest start; below this value the other starts are not tried
# Half a standard error for 3000 terms.
ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3, equations=_equations)
WELL = LevenbergMarquardt(rtol=1e-4, ftol=SOLVER.ftol, equations=_equations)
SETTLED = 0.005  # [standard errors] largest distance from the minimum, for any number of harmonics
BEFORE = 0.05  # [standard errors] the same before the last step of a fit, that of Newton
LAST = 1.0  # [standard errors] longest last step; a fit that stopped farther away did not settle
# Next to a minimum, damping would only hold back what the data hardly determine.
SLIGHT = 1e-9


def refined(
    load: Load | AtKnots | _Some,
    start: Float[Array, " q"],
    solver: LevenbergMarquardt | None = None,
) -> optx.Solution:
    """The minimum over the own parameters, and over z if `start` contains it; `WELL` if no solver.

    The default is looked up here, so that a test of derivatives can ask for more digits.
    """
    with_solver = solver or WELL
    return optx.least_squares(
        lambda q, load: load(q), with_solver, start, args=load, max_steps=MAX_STEPS, throw=False
    )


def _chosen(load: Load, starts: Float[Array, "start q"]) -> Float[Array, " q"]:
    """The likeliest start, which is the last, or the best of all if χ² of the likeliest is large.

    One loop holds the only copy of the terms: each copy compiles for 0.2 s.
    """
    # The minimum does not depend on its start, and a loop of unknown length has no gradient.
    load, starts = jax.lax.stop_gradient((load, starts))
    limit = NEAR * 2 * jnp.sum(load.spectrum.selected, dtype=starts.dtype)
    likeliest = starts.shape[0] - 1

    def goes_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        number, _, least = state
        return (number >= 0) & ((number != likeliest - 1) | ~(least < limit))

    def tried(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, best, least = state
        squares = jnp.sum(load(starts[number]) ** 2)
        squares = jnp.where(jnp.isfinite(squares), squares, jnp.inf)
        better = squares <= least
        return number - 1, jnp.where(better, number, best), jnp.minimum(squares, least)

    first = jnp.array(likeliest), jnp.array(likeliest), jnp.array(jnp.inf, starts.dtype)
    return starts[jax.lax.while_loop(goes_on, tried, first)[1]]


def _near(load: Load, start: Float[Array, " own"], well: LevenbergMarquardt) -> Float[Array, " q"]:
    """The minimum at the knots of `start`: first over the own parameters, then over all."""
    load, start = jax.lax.stop_gradient((load, start))
    terms, owned = Around.of(load, start).at, start.size
    q = jnp.concatenate([start, load.gain.driver.mean])
    # One loop for both, because each loop compiles for half a second.
    fields = [jnp.array([of.rtol, of.ftol, of.damping]) for of in (ROUGHLY, well)]

    def stage(
        q: Float[Array, " q"], of: tuple[Float[Array, "3"], Bool[Array, " q"]]
    ) -> tuple[Float[Array, " q"], None]:
        (rtol, ftol, damping), free = of
        solver = dataclasses.replace(well, rtol=rtol, ftol=ftol, damping=damping)
        return refined(_Some(terms, free), q, solver).value, None

    free = jnp.stack([jnp.arange(q.size) < owned, jnp.ones(q.size, bool)])
    return jax.lax.scan(stage, q, (jnp.stack(fields), free))[0]


def fit_circuit(
    driver: AbstractGiven,
    circuit: AbstractCircuit,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: LoadUnknowns,
    element_prior: ElementPrior | None = None,
) -> tuple[Estimate, Bool[Array, ""], Bool[Array, ""]]:
    """Identify the load of one recording.

    Args:
        driver: Distribution of Z_th at the harmonics of the recording, or the measured current.
        circuit: Structure of the load.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Starts, stacked; the likeliest is the last. The start that predicts best is
            refined.
        element_prior: Prior of the elements; None without one.

    Returns:
        The estimate, whose parameters are the logarithms of the elements. Whether W is too far from
        W₀ for its linear distribution. Whether the data show another circuit, another gain of
        V_out, or a resistance that falls with its current.
    """
    load = Load.behind(driver, circuit, spectrum, sample_rate, element_prior)
    if element_prior is not None:
        placed = element_prior.placed(candidates.log_elements)
        candidates = LoadUnknowns(placed, candidates.delay_samples)

    # First at the knots of one point, and with Z_th fixed: from a distant start, a joint fit would
    # distort Z_th.
    start = _chosen(load, candidates.vector())
    well = dataclasses.replace(
        WELL, rtol=min(WELL.rtol, SETTLED / math.sqrt(2 * spectrum.x.size)), damping=SLIGHT
    )
    whole = dataclasses.replace(
        well,
        rtol=BEFORE / SETTLED * well.rtol,
        equations=_Evaluated.at,
        empty=_Evaluated.empty,
    )
    solution = refined(load, _near(load, start, well), whole)
    q, last = solution.value, solution.stats["normal_equations"]
    around = eqx.tree_at(
        lambda a: a.at.gain, last.around, load.at_knots(load.knots), is_leaf=lambda a: a is None
    )
    g, known = around.gain, load.known(q)
    part = residual(known, g)
    jacobian = around.jacobian
    prior = 1 / load.gain.widths(q) ** 2
    noise = excess(part, spectrum.selected)[: g.size]
    # Part of the noise that only this trial has: all, or that of V_out if V_th is shared.
    private = jnp.where(
        jnp.any(known.variance_x != spectrum.variance_x),
        spectrum.variance_y / variance(known, g),
        1.0,
    )
    share = signal_share(around.x, known.variance_x)
    mean_share, mean_noise, own_noise = around.mean(jnp.stack([share, noise, private * noise]))
    linear = Linear(jacobian, mean_share, mean_noise, jnp.diag(prior))
    information, count = linear.bread(), load.gain.owned - 1
    elements = information[:count]
    # Standard errors and tests are those of the last point; they do not change in a short step.
    step = jax.lax.stop_gradient(information @ last.gradient)
    gained = jnp.dot(step, last.gradient)
    step, gained = (jnp.where(gained < LAST**2, of, 0.0) for of in (step, gained))
    own, z = load.gain.split(q - step)
    used = spectrum.selected[load.knots.index]
    moved = jnp.sqrt(jnp.max(jnp.where(used, power(around.at.gain.w(z)), 0.0)))
    by_term = elements @ jacobian
    changes = around.by_changes()
    rows = around.at.rows(changes)
    rest = prior * (q - load.gain.centre(q))
    spread = jax.scipy.linalg.block_diag(jnp.diag(prior[: load.gain.owned]), driver.cov)
    found = other_circuit.scores(rows, linear, around.part, rest, spread, information, slice(count))
    other = other_circuit.Scores.of(found, gain=True)
    weight = jnp.where(known.selected, 2 / variance(known, g), 0.0)
    falling = falling_resistance.score(
        around.by_falling(),
        known.y - g * known.x,
        weight,
        share,
        noise,
        around.x,
        around.at.by_unknown(around.slopes),
        load.knots,
        rest,
        spread,
        information,
        count,
    )
    # If a wrong gain explains the excess of the low harmonics, the excess is no hum.
    others = linear.told(rows[-1:])[0] @ information
    gain = changes[-1] - combined(others, around.at.by_unknown(around.slopes))
    explained = as_complex(found.size[-1]) * around.x * load.knots.between(gain)
    unexplained = (0.5 * weight * power(known.y - g * known.x + explained))[:LOW]
    wrong_gain = (jnp.abs(found.z[-1]) > NO_HUM) & ~stands_out(unexplained, known)
    by_own, by_z = load.gain.split(elements)
    of_delay = jnp.outer(by_own.delay_samples, by_own.delay_samples) / driver.delay_width**2
    beside = jnp.zeros(())  # Σ r² of the priors of elements, which a choice of circuits must weigh
    if element_prior is not None:
        beside = jnp.sum(((own.log_elements - element_prior.centre) / element_prior.width) ** 2)
        weighed = by_own.log_elements * element_prior.precision[None, :]
        of_delay = of_delay + weighed @ by_own.log_elements.T
    of_driver = by_z @ driver.cov @ by_z.T
    shared = of_driver + (by_term * (linear.noise - own_noise)[None, :]) @ by_term.T
    # For an element without any effect the matrix product contains only rounding errors.
    unknown = jnp.diagonal(elements)
    unknown = jnp.diag(jnp.where(unknown > 1, unknown, 0.0))
    change = load.gain.split(q)[1] - driver.mean
    # Increase of the Σ r² of the calibrations.
    strain = jnp.sum((change @ inverse_root(driver.cov)) ** 2)
    squares, terms = jnp.sum(part**2), 2 * jnp.sum(spectrum.selected, dtype=q.dtype)
    freedom, deviance = terms - load.gain.owned, squares + strain + beside - gained
    estimate = Estimate(
        parameters=own.log_elements,
        delay_samples=own.delay_samples[None],
        cov=(by_term * own_noise[None, :]) @ by_term.T + of_delay + shared + unknown,
        shared_cov=shared,
        chi2=squares / freedom,
        rrse=complex_rrse(g * spectrum.x, spectrum.y, spectrum.selected),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=strain,
        hum=shows_hum(known, g) & ~wrong_gain,
        falls=falling.causes(squares, terms, other.relevant()),
        support=Support(deviance, terms, other.relevant(), *other.spread.possible()),
    )
    return estimate, moved > FAR, other.seen() | other.has_other_gain() | falling.seen()
