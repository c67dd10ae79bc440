"""Identification of a circuit from its measured impedance: frequency, Z, standard error.

Potentiostats and impedance analysers measure Z itself, without a driver in between. With standard
errors σ_k the fit minimises

    Σ_k |Z(jω_k) − Z_k|² / σ_k²

over the logarithms of the elements. Files of instruments have no standard errors. Then noise is
taken to be a part of |Z|, and the fit minimises Σ_k |ln(Z(jω_k) / Z_k)|²: the relative error of the
magnitude and the error of the phase. It has no weights, which would come from noisy impedances.

The fit starts at several corner frequencies that span the data, each with several impedance levels,
and keeps the best minimum. From a single start, two layers sometimes ended as one.

Without standard errors the residual alone says whether the circuit is right; `_judged` does.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
from jaxtyping import Complex, Float

from etid.circuits.branches import in_order
from etid.circuits.circuit import AbstractCircuit, too_steep, with_slopes
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
from etid.likelihood.linear import LevenbergMarquardt, NormalEquations
from etid.precision import array_function, in_float64, one_thread
from etid.recordings.remarks import Remark, texts
from etid.results.data import MeasuredImpedance, with_data
from etid.results.driver import AUTO
from etid.results.fit import Fit, IdentificationError, Support, complex_rrse
from etid.results.verdicts import RESULTS, first_verdict, verdict
from etid.signals.harmonics import real_parts
from etid.solvers.matrices import inverse

LACK = 1e-4  # by chance, if the chain is given; its choice makes it three times as likely
CORNERS = 5  # over the band
LEVELS = np.log(np.geomspace(0.1, 10.0, 5))  # around that of the data
# Three steps in a row that reduce the sum of squares by less than this part end a fit, at a
# distance of less than 1e-4 standard errors from its minimum.
ENOUGH = 1e-8
ROUNDING = 1e-13  # of Z, below which a residual is none


class PassiveFit(NamedTuple):
    """What the chain of the Kramers-Kronig test leaves; it can be any passive circuit.

    Attributes:
        square: Mean square residual per degree of freedom.
        most: Sum of squares of a right circuit, which chance exceeds in `LACK` (F test).
    """

    square: float
    most: float


@dataclasses.dataclass(frozen=True)
class _Spectrum:
    """The terms of a spectrum, whose unknowns are the logarithms of the free elements.

    Attributes:
        frequency: Frequencies [Hz].
        z: Impedance [Ω].
        sigma: Standard errors [Ω]; None if the noise is a part of |Z|.
        circuit: Structure of the circuit.
        told: Logarithms of its elements, of which those that are not free are known.
        free: Numbers of the free elements.
    """

    frequency: Float[np.ndarray, " frequency"]
    z: Complex[np.ndarray, " frequency"]
    sigma: Float[np.ndarray, " frequency"] | None
    circuit: AbstractCircuit
    told: Float[np.ndarray, " element"]
    free: list[int]

    def logs(self, q: Float[np.ndarray, "row free"]) -> Float[np.ndarray, "row element"]:
        """Logarithms of all elements."""
        logs = np.tile(self.told, (len(q), 1))
        logs[:, self.free] = q
        return logs

    def equations(self, q: Float[np.ndarray, "row free"]) -> NormalEquations:
        """The normal equations."""
        z, slopes = with_slopes(self.circuit, self.logs(q), self.frequency[None])
        scale = z if self.sigma is None else self.sigma
        missed = np.log(z / self.z) if self.sigma is None else (z - self.z) / scale
        slopes = slopes[:, self.free] / np.broadcast_to(scale, z.shape)[:, None]
        return NormalEquations.of(real_parts(missed), real_parts(slopes))

    def of(self, rows: np.ndarray) -> "_Spectrum":
        """The terms of some rows: they are those of all."""
        del rows
        return self

    def starts(self) -> Float[np.ndarray, "start free"]:
        """Each corner frequency with each impedance level.

        If a circuit is scaled in impedance by g and in frequency by t, R becomes R·g, C becomes
        C/(g t).
        """
        typical, (of_level, of_time) = self.told, self.circuit.scaling()
        slow = (of_time > 0) & (of_level <= 0)  # an inductor's time constant is not of a corner
        resistance = typical[np.argmax(np.where(of_time > 0, -np.inf, of_level))]
        corner = 1.0  # [Hz], roughly
        if slow.any():
            times = (typical - of_level * resistance)[slow] / of_time[slow]
            corner = 1 / (2 * np.pi * np.exp(times.min()))
        first, last = np.log(self.frequency[[0, -1]] / corner)
        faster = np.linspace(first, last, CORNERS)
        usual = np.median(np.abs(self.circuit.response(self.frequency)))
        levels = np.log(np.median(np.abs(self.z)) / usual) + LEVELS
        moved = levels[:, None] * of_level - faster[:, None, None] * of_time
        return (typical + moved.reshape(-1, typical.size))[:, self.free]


@array_function
def _fit(spectrum: _Spectrum, passive: PassiveFit | None) -> Fit:
    """The fit of a spectrum, of rising frequency; `passive` judges it without standard errors."""
    circuit, free, f, z = spectrum.circuit, spectrum.free, spectrum.frequency, spectrum.z
    starts = spectrum.starts()
    weight = 1.0 if spectrum.sigma is None else np.abs(z) / spectrum.sigma
    search = LevenbergMarquardt(damping=1e-2, steps=500, patience=3, relative=ENOUGH)
    exact = z.size * float(np.mean((ROUNDING * weight) ** 2))
    found = search(spectrum, starts, spectrum.equations(starts), exact)
    best = int(np.argmin(found.equations.objective))
    q, squares = found.q[best], 2 * found.equations.objective[best]
    settled = np.isfinite(squares) & ~found.moves[best]
    chi2 = squares / (2 * z.size - q.size)
    equations = spectrum.equations(q[None])
    assert equations.terms is not None
    assert equations.rows is not None
    if passive is None:
        cov = inverse(equations.matrix[0]) * np.maximum(chi2, 1.0)
        misfit, remark = chi2 > MISFIT_CHI2, 0
    else:
        cov, excess = _judged(equations.terms[0], equations.rows[0].T, passive)
        misfit, remark = excess > FAIL, int(Remark.not_noise) if excess > EXACT else 0
    values = np.array(circuit.values())
    if len(free) == values.size:  # a fixed element names its branch
        places = np.asarray(in_order(circuit, q))
        q, cov = q[places], cov[np.ix_(places, places)]
    values[free] = np.exp(q)  # fixed elements are as they were told, to the last digit
    whole = np.zeros((values.size, values.size))
    whole[np.ix_(free, free)] = cov
    fitted = circuit.of_fit(values)
    support = dataclasses.replace(  # no changes of the circuit are tested
        Support.unknown(values.size), deviance=np.asarray(squares), terms=np.asarray(2.0 * z.size)
    )
    return Fit(
        circuit=fitted,
        cov=whole * np.outer(values, values),
        shared_cov=np.zeros_like(whole),
        rrse=np.asarray(complex_rrse(np.asarray(fitted.response(f)), z)),
        chi2=np.asarray(chi2 if passive is None else np.nan),
        result=first_verdict(
            (~np.isfinite(values).all(), RESULTS.nonphysical),
            (np.bool_(too_steep(circuit, np.log(values), whole)), RESULTS.nonphysical),
            (~settled, verdict("max_steps_reached")),
            (misfit, RESULTS.misfit),
            (~(np.sqrt(np.diagonal(whole)) < 1).all(), RESULTS.insensitive),
        ),
        steps=np.asarray(found.steps[best]),
        method="impedance",
        remarks=np.asarray(remark),
        support=support if passive is None else None,
    )


def _held(circuit: AbstractCircuit, known: Known) -> tuple[AbstractCircuit, list[int]]:
    """The circuit with its fixed elements, and the numbers of the free ones.

    Raises:
        ValueError: The circuit has no such element, a value is not positive, or none is free.
    """
    checked(known, circuit)
    values, names = np.array(circuit.values()), circuit.names()
    for name, value, _ in known:
        values[names.index(name)] = value
    held = {name for name, *_ in known}
    free = [row for row, name in enumerate(names) if name not in held]
    if not free:
        raise ValueError("fixed holds every element; leave at least one free")
    return circuit.with_values(values), free


def _judged(
    e: Float[np.ndarray, " part"], slope: Float[np.ndarray, "part element"], passive: PassiveFit
) -> tuple[Float[np.ndarray, "element element"], np.float64]:
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
    square = np.sum(e**2) / (n - p)
    of_steps = np.mean((parts[:, 1:] - parts[:, :-1]) ** 2) / 2
    rho = 1 - of_steps / np.where(square > 0, square, 1.0)
    usual = (np.median(np.abs(e)) / 0.6745) ** 2  # the median of the size of a normal number
    # By chance 1 spectrum in 4 000 has such runs, 5 of 1 000 000 of 40 frequencies such tails.
    signs = [rho > 3.5 / n**0.5, np.sum(e**2) > passive.most, square > 2.5**2 * usual]
    noise = np.stack([of_steps, passive.square, usual])
    excess = np.sqrt(np.max(np.where(np.stack(signs), square - noise, 0.0)))
    equal = inverse(slope.T @ slope)
    alone = slope * (e / (1 - np.sum((slope @ equal) * slope, axis=1)))[:, None]
    cov = equal @ (alone.T @ alone) @ equal
    grown = np.fmax(square * np.diagonal(equal) / np.diagonal(cov), 1.0)  # NaN if all are 0
    grown *= np.where(excess > 0, np.clip((1 + rho) / (1 - rho), 1.0, n), 1.0)
    return cov * np.sqrt(np.outer(grown, grown)), excess


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
    """Obvious causes of an unusable fit."""
    if not np.imag(z).any():
        return Remark.no_phase
    return Remark.positive_imaginary if np.median(np.imag(z)) > 0 else Remark(0)


@in_float64
@one_thread()
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
        throw: Raise an error if the result cannot be used.

    Returns:
        Elements, standard errors and verdict. `fit.plot()` draws the fit and the measured points.

    Raises:
        ValueError: The shapes of the arrays differ, there are too few impedances for the elements,
            a number is missing, not finite or not positive where it must be, or `fixed` is not of
            this circuit, or leaves no element free.
        IdentificationError: The result cannot be used and `throw` is set.
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
    f_up, z_up = f[rising], z[rising]
    passive = _passive_fit(f_up, z_up, len(free)) if sigma is None else None
    noise = None if sigma is None else sigma[rising]
    fit = _fit(_Spectrum(f_up, z_up, noise, structure, structure.log_values(), free), passive)
    if not fit.usable:
        fit = dataclasses.replace(fit, remarks=np.asarray(fit.remarks | int(_remarks(z))))
    fit = with_data(fit, MeasuredImpedance(f, z, sigma))
    if throw and not fit.usable:
        causes = " ".join([fit.note, *texts(int(fit.remarks))])
        raise IdentificationError(f"impedance: {fit.verdict}. {causes}", fit)
    return fit
