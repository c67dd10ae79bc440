"""The last step of a fit of several amplitudes: with the whole covariance of the residual.

The noise of X reaches V(X) through a resistor that depends on its current: little within a pulse,
and fully between the pulses, where the resistance is large. So the noise of the residual is small
exactly where the elements act. Weights for each harmonic cannot say that; they are those of the
noise between the pulses, and R_s and I_0 would have 1.3 to 1.7 times the smallest possible error.
One step of Gauss and Newton from such a fit is efficient (Le Cam's one-step estimator; van der
Vaart, Asymptotic Statistics, 1998, section 5.7):

    q + H⁻¹ (B r − p),      B = Jᵀ C⁻¹,      C = Σ_y + A Σ_x Aᵀ.

A is the derivative of V by X, J are those of V by the unknowns, and r is the residual, all at the
likeliest X of both records; p is the gradient of the priors. C has as many rows as the record has
harmonics, and conjugate gradients give Jᵀ C⁻¹ without it.

The covariance is H⁻¹ (B C Bᵀ) H⁻¹. H is B J with J at the part of X that is signal: noise in the
derivatives makes the gradient noisier, but is no information.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.likelihood.linear import inverse
from etid.likelihood.noise import excess
from etid.likelihood.sandwich import Curvature
from etid.nonlinear.amplitudes import Amplitudes
from etid.nonlinear.iterative import conjugate
from etid.nonlinear.response import AbstractResponse
from etid.signals.harmonics import ALIASED, signal_share
from etid.signals.transfer import power

# Of a right side. The standard errors are within 0.2 % of those with 1 %; with 10 % they would be
# 1 % larger.
LEFT, STEPS = 0.03, 40

_Numbers = Complex[np.ndarray, "*row record harmonic"]


class Step(NamedTuple):
    """The last step of a fit.

    Attributes:
        change: What the unknowns change by.
        curvature: Information of the records and the priors, and covariance of the gradient by the
            records.
        slopes: Derivatives of the predictions by the unknowns of each record, times the weights.
    """

    change: Float[np.ndarray, " q"]
    curvature: Curvature
    slopes: Complex[np.ndarray, "own record harmonic"]


class _Linearised(NamedTuple):
    """The terms around some X; all vectors are scaled by the weights.

    Attributes:
        response: The response to X.
        weight: 1/σ of the terms.
        variance_x: Variances of X; half of each belongs to its real part.
        variance_y: Variances of Y.
    """

    response: AbstractResponse
    weight: Float[np.ndarray, "record harmonic"]
    variance_x: Float[np.ndarray, "record harmonic"]
    variance_y: Float[np.ndarray, "record harmonic"]

    def along(self, x: _Numbers) -> _Numbers:
        """A times a change of X [V]."""
        return self.weight * self.response.along(x)

    def back(self, vector: _Numbers) -> _Numbers:
        """Σ_x Aᵀ times a vector: a change of X [V]."""
        return 0.5 * self.variance_x * self.response.back(self.weight * vector)

    def covariance(self, vector: _Numbers) -> _Numbers:
        """C times a vector."""
        own = 0.5 * self.weight**2 * self.variance_y * vector
        return own + self.along(self.back(vector))

    def solved(self, vector: _Numbers) -> _Numbers:
        """C⁻¹ times a vector."""
        return conjugate(self.covariance, vector, LEFT, STEPS)


def last_step(of: Amplitudes, q: Float[np.ndarray, " q"]) -> Step:
    """The step from the minimum `q` of the terms to the efficient estimate."""
    own, spectra, weight = of.own(q), of.spectra, of.weight

    def linearised(x: _Numbers, variance_x: Float[np.ndarray, "record harmonic"]) -> _Linearised:
        return _Linearised(of.recorded.at(own, x), weight, variance_x, spectra.variance_y)

    noisy = linearised(spectra.x, _unknown_hum(of, spectra.x))
    x = spectra.x + noisy.back(noisy.solved(of.terms(noisy.response.predicted)))
    share = signal_share(x, spectra.variance_x * spectra.variance_y / of.variance(own))
    # Without hum: it is no random error, and its size would hide that of the noise.
    noise = linearised(x, spectra.variance_x)
    quiet = noise._replace(variance_x=_unknown_hum(of, x))
    slopes = weight * quiet.response.slopes()
    of_signal = weight * of.recorded.at(own, x * share).slopes()
    rest = of.terms(quiet.response.predicted) - quiet.along(spectra.x - x)
    b = quiet.solved(slopes)
    inflated = b * np.sqrt(excess(0.5 * power(rest), spectra.selected))
    score = _products(noise.covariance(inflated), inflated)
    expected, gradient = _products(b, of_signal), _products(b, rest[None])[..., 0]
    curvature = np.diag(1 / of.width**2), np.zeros((q.size, q.size))
    pull = -of.priors(q) / of.width
    for number in range(of.count):
        places = of.places(number)
        for whole, part in zip(curvature, (expected, score), strict=True):
            whole[np.ix_(places, places)] += 0.5 * (part[number] + part[number].T)
        pull[places] += gradient[number]
    return Step(inverse(curvature[0]) @ pull, Curvature(*curvature), slopes)


def _products(
    one: Complex[np.ndarray, "a record harmonic"], other: Complex[np.ndarray, "b record harmonic"]
) -> Float[np.ndarray, "record a b"]:
    """Σ over real and imaginary parts, for each record."""
    left, right = (np.moveaxis(of, 0, 1) for of in (one, other))
    return np.real(left @ right.conj().swapaxes(-1, -2))


def _unknown_hum(of: Amplitudes, x: _Numbers) -> Float[np.ndarray, "record harmonic"]:
    """Variances of X; its size is unknown where mains hum covers it, below the aliases."""
    below = of.spectra.frequency < ALIASED * of.recorded.sample_rate
    return np.where(~of.spectra.selected & below, power(x), of.spectra.variance_x)
