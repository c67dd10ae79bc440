"""One load behind a driver, of which V_th, V_out and the current were recorded.

Two equations hold at every harmonic. Both have the same true X, which is eliminated:

    Y = G X e^(−jωτ),      G = Z_L / (Z_L + Z_th),
    I = H X e^(−jωτ_i),    H = 1 / (Z_L + Z_th).

The first term is Y − G X, with variance σ₁² = σ_y² + |G|² σ_x². The second is I − H x₁, where x₁ is
X as X and Y together estimate it, with variance σ₂² = σ_i² + |H|² σ_x² σ_y² / σ₁². The terms are
independent, and together they are the likelihood of the three records (see
`etid.estimators.maximum_likelihood.terms`). The trigger delays τ and τ_i are fitted both.

The records determine Z_th themselves, by (X − Y) / I. If the current contradicts the calibrations,
the strain of the fit shows it. A score test finds another scale of the current: as a change of R_L,
it changes all impedances alike.
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
from etid.estimators.estimate import DELAY_WIDTH, MAX_STEPS, SOLVER, Estimate
from etid.estimators.maximum_likelihood.gain import Gain
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.load_fit import FAR, SETTLED, SLIGHT
from etid.estimators.maximum_likelihood.terms import (
    apart,
    excess,
    informed,
    residual,
    shows_hum,
    variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import falling_resistance, other_circuit
from etid.estimators.starts import current_starts
from etid.results.fit import Support, complex_rrse
from etid.signals.harmonics import Spectrum, real_parts, signal_share
from etid.signals.transfer import as_complex, reciprocal
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations, best_start


class _CurrentOf(GivenDriver):
    """The same driver; its gain is that from V_th to the current through the load."""

    def gain(
        self, load: Complex[Array, " harmonic"], w: Complex[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        """1 / (Z_L + Z_th) at W₀ + w [S]."""
        return reciprocal(load + self.z_th(w))


class Seen(eqx.Module):
    """The records at some parameters.

    Attributes:
        gains: G and H with their delays.
        first: X and Y; X is estimated by the calibrations.
        second: X as X and Y estimate it, and the current.
    """

    gains: Complex[Array, "2 harmonic"]
    first: Spectrum
    second: Spectrum

    def shows_hum(self) -> Bool[Array, ""]:
        """Whether Y or I shows mains hum."""
        return shows_hum(self.first, self.gains[0]) | shows_hum(self.second, self.gains[1])

    def true_x(self) -> Spectrum:
        """X as all three records estimate it, and its variance."""
        return informed(self.second, [self.second], [self.gains[1]])

    def parts(self) -> Float[Array, "2 part"]:
        """Terms of Y and of I."""
        both = zip((self.first, self.second), self.gains, strict=True)
        return jnp.stack([residual(of, g) for of, g in both])

    def scaled(self, change: Complex[Array, "row 2 harmonic"]) -> Float[Array, "row part"]:
        """Changes of the terms if the predictions of Y and I change."""
        g, h = self.gains
        variances = variance(self.first, g), variance(self.second, h)
        shared = h * jnp.conj(g) * as_complex(self.first.variance_x / variances[0])
        rest = jnp.stack([change[:, 0], change[:, 1] - shared[None, :] * change[:, 0]], axis=1)
        selected = jnp.stack([self.first.selected, self.second.selected])
        weight = jnp.where(selected, jnp.sqrt(2 / jnp.stack(variances)), 0.0)
        return -real_parts(rest * as_complex(weight)[None]).reshape(change.shape[0], -1)


class LoadWithCurrent(eqx.Module):
    """One recording of three records, with all data that its terms need.

    The parameters of the solver are the logarithms of the elements, τ, τ_i, and z unless z = z₀.

    Attributes:
        load: X and Y.
        current: Gain from X to I.
        i: Harmonics of the current [A].
        variance_i: E|noise|² of each of them [A²].
    """

    load: Load
    current: Gain
    i: Complex[Array, " harmonic"]
    variance_i: Float[Array, " harmonic"]

    @classmethod
    def behind(
        cls,
        driver: GivenDriver,
        circuit: AbstractCircuit,
        spectrum: Spectrum,
        current: tuple[Complex[Array, " harmonic"], Float[Array, " harmonic"]],
        sample_rate: Float[Array, ""],
        prior: ElementPrior | None = None,
    ) -> "LoadWithCurrent":
        """A recording that was made with `driver`, its current, and a prior of the elements."""
        load = Load.behind(driver, circuit, spectrum, sample_rate, prior)
        fields = {one.name: getattr(driver, one.name) for one in dataclasses.fields(driver)}
        # How little the delays of V_out scatter tells nothing about those of the current.
        fields["delay_width"] = jnp.array(DELAY_WIDTH)
        of_current = dataclasses.replace(load.gain, driver=_CurrentOf(**fields))
        return cls(load, of_current, *current)

    @property
    def elements(self) -> int:
        """Number of elements."""
        return self.load.gain.owned - 1

    def each(self, q: Float[Array, " q"]) -> tuple[Float[Array, " own"], Float[Array, " own"]]:
        """The parameters in the order of `Gain`, for Y and for I."""
        return jnp.delete(q, self.elements + 1), jnp.delete(q, self.elements)

    def centre(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior means of the parameters."""
        of_y, of_i = (self.load.gain.centre(one) for one in self.each(q))
        return jnp.insert(of_y, self.elements + 1, of_i[self.elements])

    def widths(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Prior standard deviations of the parameters."""
        of_y, of_i = (self.load.gain.widths(one) for one in self.each(q))
        return jnp.insert(of_y, self.elements + 1, of_i[self.elements])

    def seen(self, q: Float[Array, " q"]) -> Seen:
        """The records at these parameters."""
        of_y, of_i = self.each(q)
        g, first = self.load.predicted(of_y)
        learned = informed(first, [first], [g])
        second = dataclasses.replace(learned, y=self.i, variance_y=self.variance_i)
        return Seen(jnp.stack([g, self.current(of_i)]), first, second)

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms of the records and the priors."""
        rest = (q - self.centre(q)) / self.widths(q)
        return jnp.concatenate([self.residual(q), rest])

    def residual(self, q: Float[Array, " q"]) -> Float[Array, " part"]:
        """Terms of the records alone."""
        return apart(self.seen, q).parts().ravel()

    def rrse(self, seen: Seen) -> Float[Array, ""]:
        """RRSE of the record that is predicted worse."""
        predicted = seen.gains * seen.first.x[None, :]
        y, i = (
            complex_rrse(one, record, seen.first.selected)
            for one, record in zip(predicted, (seen.first.y, self.i), strict=True)
        )
        return jnp.maximum(y, i)

    def equations(self, q: Float[Array, " q"]) -> NormalEquations:
        """Normal equations of the records alone; the matrix is their information."""

        def objective(
            q: Float[Array, " q"],
        ) -> tuple[Float[Array, ""], Complex[Array, " harmonic"]]:
            seen = self.seen(q)
            return 0.5 * jnp.sum(seen.parts() ** 2), seen.true_x().x

        (value, x), gradient = apart(jax.value_and_grad(objective, has_aux=True), q)
        jacobian = apart(lambda q: self.seen(q).scaled(self.slopes(q, x)), q)
        return NormalEquations(value, gradient, jacobian @ jacobian.T)

    def slopes(
        self, q: Float[Array, " q"], x: Complex[Array, " harmonic"]
    ) -> Complex[Array, "q 2 harmonic"]:
        """Derivatives of Y and I, for the true X."""
        of_y, of_i = self.each(q)
        y, i = (gain.slopes(one) for gain, one in ((self.load.gain, of_y), (self.current, of_i)))
        e = self.elements
        none = jnp.zeros_like(x)[None, :]
        by_y = jnp.concatenate([y.by_unknown[: e + 1], none, y.by_unknown[e + 1 :]]) * x[None, :]
        by_i = jnp.concatenate([i.by_unknown[:e], none, i.by_unknown[e:]]) * x[None, :]
        found = jnp.stack([by_y, by_i], axis=1)
        if self.load.unloaded is None or q.size == e + 2:
            return found
        moved = self.load.unloaded.x[:, None, :] * jnp.stack([y.gain, i.gain])[None]
        return found.at[e + 2 :].add(moved)


def _equations(_, q: Float[Array, " q"], of: LoadWithCurrent) -> NormalEquations:
    found = of.equations(q)
    prior = 1 / of.widths(q)
    rest = prior * (q - of.centre(q))
    return NormalEquations(
        found.objective + 0.5 * jnp.dot(rest, rest),
        found.gradient + prior * rest,
        found.matrix + jnp.diag(prior**2),
    ).finite()


# Standard deviations and relative change of an element, from which on the scale of the current is
# wrong. By chance one fit in 16 000 exceeds the first; a driver of too low order can imitate less
# than the second.
DISAGREES, SCALE = 4.0, 1e-3
ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3, equations=_equations)
WELL = LevenbergMarquardt(rtol=1e-4, ftol=SOLVER.ftol, damping=SLIGHT, equations=_equations)


def refined(
    of: LoadWithCurrent, start: Float[Array, " q"], solver: LevenbergMarquardt = WELL
) -> optx.Solution:
    """The minimum over the own parameters, and over z if `start` contains it."""
    return optx.least_squares(
        lambda q, of: of(q), solver, start, args=of, max_steps=MAX_STEPS, throw=False
    )


def fit_circuit(
    driver: GivenDriver,
    circuit: AbstractCircuit,
    spectrum: Spectrum,
    current: tuple[Complex[Array, " harmonic"], Float[Array, " harmonic"]],
    sample_rate: Float[Array, ""],
    element_prior: ElementPrior | None = None,
) -> tuple[Estimate, Bool[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """Identify the load of one recording of three records.

    Args:
        driver: Distribution of Z_th at the harmonics of the recording.
        circuit: Structure of the load.
        spectrum: V_th and V_out.
        current: Harmonics of the current [A], and their variances [A²].
        sample_rate: Its sampling rate [Hz].
        element_prior: Prior of the elements; None without one.

    Returns:
        As `etid.estimators.maximum_likelihood.load_fit.fit_circuit`, and whether the scale of the
        current contradicts the driver. χ² is that of both equations, RRSE that of the record that
        is predicted worse.
    """
    of = LoadWithCurrent.behind(driver, circuit, spectrum, current, sample_rate, element_prior)
    count = of.elements

    i, y = (jnp.where(spectrum.selected, one, 0) for one in (current[0], spectrum.y))
    variances = current[1], spectrum.variance_y
    starts = current_starts(spectrum.frequency, (i, y), variances, circuit)
    starts = starts if element_prior is None else element_prior.placed(starts)
    # First with Z_th fixed: from a distant start, a joint fit would distort Z_th.
    start = best_start(of, jnp.pad(starts, ((0, 0), (0, 2))))
    alone = refined(of, start, ROUGHLY).value
    well = dataclasses.replace(WELL, rtol=min(WELL.rtol, SETTLED / math.sqrt(4 * spectrum.x.size)))
    solution = refined(of, jnp.concatenate([alone, driver.mean]), well)
    q = solution.value
    own, z = q[: count + 2], q[count + 2 :]
    seen = apart(of.seen, q)
    part = seen.parts()
    moved = jnp.max(jnp.where(spectrum.selected, jnp.abs(of.load.gain.w(z)), 0.0))

    true = seen.true_x()
    rows = apart(lambda q: seen.scaled(of.slopes(q, true.x)), q)
    prior = 1 / of.widths(q) ** 2
    share = jnp.tile(signal_share(true.x, true.variance_x), 4)
    noise = jax.vmap(excess)(part, jnp.stack([seen.first.selected, seen.second.selected])).ravel()
    linear = Linear(rows, share, noise, jnp.diag(prior))
    information = linear.bread()
    rest = prior * (q - of.centre(q))
    spread = jax.scipy.linalg.block_diag(jnp.diag(prior[: count + 2]), driver.cov)

    rows_of_changes = seen.scaled(changes(of, driver, q, seen, true.x))
    told = rest, spread, information, slice(count)
    found = other_circuit.scores(rows_of_changes, linear, part.ravel(), *told)
    other = other_circuit.Scores.of(_part(found, slice(-2)), gain=True)
    of_current, falls = _part(found, -2), _part(found, -1)

    squares, terms = jnp.sum(part**2), 4 * jnp.sum(spectrum.selected, dtype=q.dtype)
    chi2 = squares / (terms - count - 2)
    # The rows are changes of measured minus predicted records: a fall has a negative score there.
    falling = falling_resistance.Falling(-falls.z, falls.moved, falls.z**2 * jnp.maximum(chi2, 1.0))

    elements = information[:count]
    by_term = elements @ rows
    by_z = elements[:, count + 2 :]
    of_driver = by_z @ driver.cov @ by_z.T
    of_own = (elements[:, : count + 2] * prior[None, : count + 2]) @ elements[:, : count + 2].T
    change = z - driver.mean
    strain = jnp.dot(change, jnp.linalg.solve(driver.cov, change))
    beside = jnp.sum((rest**2 / jnp.where(prior > 0, prior, 1.0))[:count])
    estimate = Estimate(
        parameters=own[:count],
        delay_samples=own[count:],
        cov=(by_term * noise[None, :]) @ by_term.T + of_own + of_driver,
        shared_cov=of_driver,
        chi2=chi2,
        rrse=of.rrse(seen),
        result=solution.result,
        steps=solution.stats["num_steps"],
        strain=strain,
        hum=seen.shows_hum(),
        falls=falling.causes(squares, terms, other.relevant()),
        support=Support(
            squares + strain + beside, terms, other.relevant(), *other.spread.possible()
        ),
    )
    wrong = other.seen() | other.has_other_gain() | falling.seen()
    return estimate, moved > FAR, wrong, disagrees(of_current)


def disagrees(scale: other_circuit.Score) -> Bool[Array, ""]:
    """Whether the score of the scale of the current shows that it is wrong."""
    return (jnp.abs(scale.z) > DISAGREES) & (scale.moved > SCALE)


def _part(scores: other_circuit.Score, which: int | slice) -> other_circuit.Score:
    return jax.tree.map(lambda leaf: leaf[which], scores)


def changes(
    of: LoadWithCurrent,
    driver: GivenDriver,
    q: Float[Array, " q"],
    seen: Seen,
    x: Complex[Array, " harmonic"],
) -> Complex[Array, "change 2 harmonic"]:
    """Changes of Y and I by another circuit, gains of V_out and I, and a falling resistance."""
    gain, (own, _), (g, h) = of.load.gain, of.each(q), seen.gains
    z, circuits = other_circuit.changes(gain.impedance(own), gain.frequency)
    z_th = driver.z_th(gain.w(gain.split(own)[1]))
    loop = reciprocal(z + z_th)
    by_load = jnp.stack([g * x * reciprocal(z) * z_th * loop, -h * x * loop])
    v_out, current, none = g * x, h * x, jnp.zeros_like(x)
    every = of.load.knots
    fall = falling_resistance.added_voltage(v_out, every.at(z), every.at(z_th * loop), every)
    skew = h * reciprocal(g) * z  # e^(−jω(τ_i − τ))
    others = [[v_out, none], [none, current], [fall, -fall * skew * reciprocal(z_th)]]
    return jnp.concatenate(
        [circuits[:, None, :] * by_load[None], jnp.stack([jnp.stack(one) for one in others])]
    )
