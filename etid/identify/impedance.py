"""Identification of a circuit from its measured impedance: frequency, Z, standard error.

Potentiostats and impedance analysers measure Z itself, without a driver in between. With standard
errors σ_k the fit minimises

    Σ_k |Z(jω_k) − Z_k|² / σ_k²

over the logarithms of the elements. Files of instruments have no standard errors. Then noise is
taken to be a part of |Z|, and the fit minimises Σ_k |ln(Z(jω_k) / Z_k)|²: the relative error of the
magnitude and the error of the phase. It has no weights, which would come from noisy impedances.

The fit starts at several corner frequencies that span the data, each with the best of several
impedance levels, and keeps the best minimum. From a single start, two layers sometimes ended as
one.

Without standard errors the residual alone says whether the circuit is right; `_judged` does.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optimistix as optx
import scipy
from jaxtyping import Array, Complex, Float

from etid.circuits.branches import in_order
from etid.circuits.circuit import AbstractCircuit
from etid.circuits.display import several
from etid.estimators.element_prior import Known, checked
from etid.identify.arguments import circuit_of, known_elements
from etid.identify.kramers_kronig import (
    EXACT,
    FAIL,
    MISFIT_CHI2,
    checked_spectrum,
    kramers_kronig,
)
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.remarks import Remark, texts
from etid.results.data import MeasuredImpedance, with_data
from etid.results.driver import AUTO
from etid.results.fit import Fit, IdentificationError, Support, complex_rrse
from etid.results.verdicts import RESULTS, first_verdict, verdict
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, best_start
from etid.solvers.matrices import inverse

LACK = 1e-4  # by chance, if the chain is given; its choice makes it three times as likely


class PassiveFit(NamedTuple):
    """What the chain of the Kramers-Kronig test leaves; it can be any passive circuit.

    Attributes:
        square: Mean square residual per degree of freedom.
        most: Sum of squares of a right circuit, which chance exceeds in `LACK` (F test).
    """

    square: float | Float[Array, ""]
    most: float | Float[Array, ""]


@program
def _fit(
    frequency: Float[Array, " frequency"],
    z: Complex[Array, " frequency"],
    noise: Float[Array, " frequency"] | PassiveFit,
    circuit: AbstractCircuit,
    free: tuple[int, ...],
) -> Fit:
    passive = noise if isinstance(noise, PassiveFit) else None
    sigma = None if isinstance(noise, PassiveFit) else noise
    known = passive is None

    rows, told = np.array(free), jnp.asarray(circuit.log_values())

    def elements(q: Float[Array, " free"]) -> Float[Array, " element"]:
        return told.at[rows].set(q)

    def residual(q: Float[Array, " free"], _) -> Float[Array, " part"]:
        fitted = circuit.with_log_values(elements(q)).response(frequency)
        missed = jnp.log(fitted / z) if sigma is None else (fitted - z) / sigma.astype(z.dtype)
        return jnp.concatenate([missed.real, missed.imag])

    # If a circuit is scaled in impedance by g and in frequency by t, R becomes R·g, C becomes
    # C/(g t).
    typical, (of_level, of_time) = circuit.log_values(), circuit.scaling()
    size = jnp.log(jnp.median(jnp.abs(z)) / jnp.median(jnp.abs(circuit.response(frequency))))
    slow = (of_time > 0) & (of_level <= 0)  # an inductor's time constant is not that of a corner
    resistance = typical[jnp.argmax(jnp.where(of_time > 0, -jnp.inf, of_level))]
    times = (typical - of_level * resistance) / jnp.where(slow, of_time, 1.0)
    shortest = jnp.where(slow, times, jnp.inf).min()
    corner = jnp.where(slow.any(), 1 / (2 * jnp.pi * jnp.exp(shortest)), 1.0)  # [Hz], roughly
    corners = jnp.exp(jnp.linspace(jnp.log(frequency.min()), jnp.log(frequency.max()), 5))
    levels = size + jnp.log(np.geomspace(0.1, 10.0, 5))

    def from_corner(faster: Float[Array, ""]) -> optx.Solution:
        starts = (typical - of_time * faster)[None, :] + levels[:, None] * of_level[None, :]
        starts = starts[:, rows]
        q0 = best_start(lambda q: residual(q, None), starts)
        solver = LevenbergMarquardt()
        return optx.least_squares(residual, solver, q0, max_steps=500, throw=False)

    every = jax.lax.map(from_corner, jnp.log(corners / corner))
    likeliest = jnp.nanargmin(every.stats["normal_equations"].objective)
    solution = jax.tree.map(lambda one: one[likeliest], every)
    q = solution.value
    equations = solution.stats["normal_equations"]
    chi2 = 2 * equations.objective / (2 * z.size - q.size)
    if passive is None:
        cov = inverse(equations.matrix) * jnp.maximum(chi2, 1.0)
        misfit, remark = chi2 > MISFIT_CHI2, jnp.zeros((), int)
    else:
        cov, excess = _judged(residual(q, None), jax.jacfwd(residual)(q, None), passive)
        misfit, remark = excess > FAIL, jnp.where(excess > EXACT, int(Remark.not_noise), 0)
    if len(free) == len(circuit.names()):  # a fixed element names its branch
        places = in_order(circuit, q)
        q, cov = q[places], cov[places][:, places]
    # Fixed elements are as they were told, to the last digit.
    values = jnp.asarray(circuit.values()).at[rows].set(jnp.exp(q))
    fitted = circuit.with_values(values)
    cov = jnp.zeros((values.size, values.size)).at[np.ix_(rows, rows)].set(cov)
    settled = solution.result == optx.RESULTS.successful
    terms = jnp.asarray(2.0 * z.size)
    support = dataclasses.replace(  # no changes of the circuit are tested
        Support.unknown(values.size), deviance=2 * equations.objective, terms=terms
    )
    return Fit(
        circuit=fitted,
        cov=cov * jnp.outer(values, values),
        shared_cov=jnp.zeros_like(cov),
        rrse=complex_rrse(jnp.asarray(fitted.response(frequency)), z),
        chi2=chi2 if known else jnp.asarray(jnp.nan),
        result=first_verdict(
            (~jnp.isfinite(values).all(), RESULTS.nonphysical),
            (fitted.is_too_steep(cov), RESULTS.nonphysical),
            (~settled, verdict("max_steps_reached")),
            (misfit, RESULTS.misfit),
            (~(jnp.sqrt(jnp.diagonal(cov)) < 1).all(), RESULTS.insensitive),
        ),
        steps=solution.stats["num_steps"],
        method="impedance",
        remarks=remark,
        support=support if known else None,
    )


def _held(circuit: AbstractCircuit, known: Known) -> tuple[AbstractCircuit, tuple[int, ...]]:
    """The circuit with its fixed elements, and the numbers of the free ones.

    Raises:
        ValueError: The circuit has no such element, a value is not positive, or none is free.
    """
    checked(known, circuit)
    values, names = np.array(circuit.values()), circuit.names()
    for name, value, _ in known:
        values[names.index(name)] = value
    held = {name for name, *_ in known}
    free = tuple(row for row, name in enumerate(names) if name not in held)
    if not free:
        raise ValueError("fixed holds every element; leave at least one free")
    return circuit.with_values(values), free


def _judged(
    e: Float[Array, " part"], slope: Float[Array, "part element"], passive: PassiveFit
) -> tuple[Float[Array, "element element"], Float[Array, ""]]:
    """Covariance of the logarithms, and the rms part of the residual that is not noise.

    Three signs show a residual that is not white noise, each of which says how large the noise is:

    - runs: neighbours miss alike. With autocorrelation ρ, (1 − ρ) of the mean square is noise
      (von Neumann 1941);
    - another passive circuit misses by less: an F test against the Kramers-Kronig chain;
    - tails: a few impedances make most of the mean square, and the median does not see them.

    The covariance is the larger one, element by element, of two: that of equal noise at all
    frequencies, and the sandwich of the jackknife (MacKinnon and White 1985), which needs no equal
    noise and contains the effect of each single impedance. A residual that is not noise has fewer
    independent values, by (1 − ρ) / (1 + ρ) (Bartlett 1935), but one at least.
    """
    n, p = slope.shape
    parts = e.reshape(2, -1)
    square = jnp.sum(e**2) / (n - p)
    of_steps = jnp.mean((parts[:, 1:] - parts[:, :-1]) ** 2) / 2
    rho = 1 - of_steps / jnp.where(square > 0, square, 1.0)
    usual = (jnp.median(jnp.abs(e)) / 0.6745) ** 2  # the median of the size of a normal number
    # By chance 1 spectrum in 4 000 has such runs, 5 of 1 000 000 of 40 frequencies such tails.
    signs = [rho > 3.5 / n**0.5, jnp.sum(e**2) > passive.most, square > 2.5**2 * usual]
    noise = jnp.stack([of_steps, passive.square, usual])
    excess = jnp.sqrt(jnp.max(jnp.where(jnp.stack(signs), square - noise, 0.0)))
    equal = inverse(slope.T @ slope)
    alone = slope * (e / (1 - jnp.sum((slope @ equal) * slope, axis=1)))[:, None]
    cov = equal @ (alone.T @ alone) @ equal
    grown = jnp.fmax(square * jnp.diagonal(equal) / jnp.diagonal(cov), 1.0)  # NaN if all are 0
    grown *= jnp.where(excess > 0, jnp.clip((1 + rho) / (1 - rho), 1.0, n), 1.0)
    return cov * jnp.sqrt(jnp.outer(grown, grown)), excess


def _passive_fit(
    f: Float[np.ndarray, " frequency"], z: Complex[np.ndarray, " frequency"], elements: int
) -> PassiveFit:
    """The residual of the Kramers-Kronig test; without limit if there are too few frequencies."""
    try:
        found = kramers_kronig(f, z)
    except ValueError:
        return PassiveFit(np.inf, np.inf)
    missed = float(np.sum(np.abs(np.log(found.fitted / z)) ** 2))
    free, more = 2 * f.size - found.parameters, found.parameters - elements
    if more <= 0:
        return PassiveFit(missed / free, np.inf)
    ratio = float(scipy.special.fdtri(more, free, 1 - LACK))
    return PassiveFit(missed / free, missed * (1 + ratio * more / free))


def _remarks(z: Complex[np.ndarray, " frequency"]) -> Remark:
    """Obvious causes of a fit that is not successful."""
    if not np.imag(z).any():
        return Remark.no_phase
    return Remark.positive_imaginary if np.median(np.imag(z)) > 0 else Remark(0)


@in_float64
def identify_impedance(
    frequency: npt.ArrayLike,
    impedance: npt.ArrayLike,
    *,
    stderr: float | npt.ArrayLike | None = None,
    circuit: AbstractCircuit | str | None = None,
    fixed: Mapping[str, float] | None = None,
    throw: bool = True,
) -> Fit:
    """Identify a circuit from its impedance.

    Args:
        frequency: Frequencies [Hz], > 0.
        impedance: Complex impedance [Ω] at each frequency.
        stderr: Standard error [Ω] of the real and of the imaginary part: one number, or one for
            each frequency. If not given, the noise is taken to be a part of |Z|, which the residual
            shows. χ² is then NaN. A residual that is not noise is a `misfit` where it exceeds 1 %
            of |Z|, and else widens the standard errors, with the remark `not_noise`.
        circuit: Structure of the circuit, or a circuit string; `SkinRC` if not given. Its values
            matter little.
        fixed: Known values of elements by name [SI], as in `{"alpha_1": 0.9}`. Their standard
            errors are 0.
        throw: Raise an error if the verdict is not successful.

    Returns:
        Elements, standard errors and verdict. `fit.plot()` draws the fit and the measured points.

    Raises:
        ValueError: The shapes of the arrays differ, there are too few impedances for the elements,
            a number is missing, not finite or not positive where it must be, or `fixed` is not of
            this circuit, or leaves no element free.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    if isinstance(circuit, str) and circuit == AUTO:
        raise ValueError(
            "the circuit 'auto' chooses for recordings, not for an impedance; fit each candidate, "
            "and compare verdict and chi2"
        )
    f, z, sigma = checked_spectrum(frequency, impedance, stderr)
    structure, free = _held(circuit_of(circuit), known_elements(fixed, None))
    if 2 * f.size <= len(free):
        given, wanted = several(f.size, "impedance"), several(len(free), "element")
        raise ValueError(f"{given} cannot determine {wanted}")
    rising = np.argsort(f, kind="stable")  # neighbours are compared
    noise = _passive_fit(f[rising], z[rising], len(free)) if sigma is None else sigma[rising]
    put = jax.device_put
    fit = jax.device_get(_fit(put(f[rising]), put(z[rising]), put(noise), structure, free))
    if fit.verdict != "successful":
        fit = dataclasses.replace(fit, remarks=np.asarray(fit.remarks | int(_remarks(z))))
    fit = with_data(fit, MeasuredImpedance(f, z, sigma))
    if throw and fit.verdict != "successful":
        causes = " ".join([fit.note, *texts(int(fit.remarks))])
        raise IdentificationError(f"impedance: {fit.verdict}. {causes}", fit)
    return fit
