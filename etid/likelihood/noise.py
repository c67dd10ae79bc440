"""What the residual of a fit says of its noise: its variance by frequency, and mains hum.

The weights of a fit are those of the noise that the record shows, but no model is exact. The
covariance (Jᵀ C J in place of Jᵀ J, White 1980) therefore uses the variance of the residual.
"""

from jaxtyping import Bool, Complex, Float

from etid.precision import namespace
from etid.results.verdicts import left
from etid.signals.harmonics import local_sum
from etid.signals.knots import Knots
from etid.signals.mains import lines
from etid.signals.transfer import AnyArray

MISFIT_CHI2 = 1.5  # the record gives the noise to about 5 %, so chi2 is known to 10 %
MISFIT_RRSE = (
    1e-3  # of the signal; the best converters and transformers leave this part unexplained
)
# χ² of the condensed terms, from which on a residual is smooth. Of good recordings it is 0.7, and
# at most 1.0 of a thousand at 40 to 72 dB.
SMOOTH = 1.5
SURE = 4.0  # standard deviations by which a local variance must exceed the mean
LOW = 128  # number of first harmonics that are tested for mains hum
HUM = 14.4  # times the mean; an exponential exceeds it as rarely as a normal number exceeds five σ


def excess(
    squares: Float[AnyArray, "*row bin"], used: Bool[AnyArray, "*row bin"]
) -> Float[AnyArray, "*row bin"]:
    """Variance of a residual around each harmonic, relative to the expected variance; at least 1.

    It is the mean over `harmonics.WINDOW` harmonics where this surely exceeds the mean over all
    harmonics, and otherwise the mean over all. `squares` are relative to their expectation.
    """
    xp = namespace(squares)
    total, of = xp.where(used, 2 * squares, 0.0), xp.where(used, 2.0, 0.0)
    overall = total.sum(-1) / xp.maximum(of.sum(-1), 1.0)
    overall = xp.maximum(overall, 1.0)[..., None]
    freedom = xp.maximum(local_sum(of), 1.0)
    local = local_sum(total) / freedom
    sure = local > overall * (1 + SURE * xp.sqrt(2 / freedom))
    return xp.where(sure, local, overall)


def pull_of_ignored(
    knots: Knots,
    weight: Float[AnyArray, "*row output bin"],
    gains: Complex[AnyArray, "*row output knot"],
    by_q: Complex[AnyArray, "*row q output knot"],
) -> Float[AnyArray, "*row q"]:
    """Gradient of the expected ½ Σ r² by noise n of X that the weights leave out.

    With X + n in place of X it is larger by ½ Σ w |G|² E|n|², w = 2/σ². `weight` is w E|n|².
    """
    xp = namespace(by_q)
    slope = (xp.conj(gains)[..., None, :, :] * by_q).real
    return (knots.summed(weight)[..., None, :, :] * slope).sum((-2, -1))


def shows_hum(
    squares: Float[AnyArray, "*row output bin"],
    frequency: Float[AnyArray, "*row bin"],
    used: Bool[AnyArray, "*row output bin"],
) -> Bool[AnyArray, "*row"]:
    """Whether the squares of an output show mains hum; without hum their mean is 1."""
    xp = namespace(squares)
    squares, used = squares[..., :LOW], used[..., :LOW]
    suspect = lines(frequency[..., :LOW])[..., None, :]
    others = used & ~suspect
    around = xp.where(others, squares, 0.0).sum(-1) / xp.maximum(others.sum(-1), 1)
    loudest = xp.where(suspect, squares, 0.0).max(-1)
    return (loudest > HUM * xp.maximum(around, 1.0)).any(-1)


def misses(
    chi2: Float[AnyArray, "*row"],
    error: Float[AnyArray, "*row"],
    least: float = MISFIT_RRSE,
    limit: float = MISFIT_CHI2,
) -> Bool[AnyArray, "*row"]:
    """Whether the residual exceeds the noise, both in standard deviations and in volts.

    A part `least` of the signal may remain unexplained, and noise explains a χ² of `limit`.
    """
    return (chi2 > limit) & (left(chi2, error) > least)


def is_smooth(
    terms: Float[AnyArray, "*row part"], parameters: int, limit: float = SMOOTH
) -> Bool[AnyArray, "*row"]:
    """Whether a residual is smooth in frequency and more than noise.

    Condensed to the knots it keeps its squares, while those of noise become few.

    Args:
        terms: The condensed terms at the minimum; 0 where nothing is known.
        parameters: Number of parameters of the fit.
        limit: Their χ², from which on it is smooth.
    """
    return (terms**2).sum(-1) > limit * ((terms != 0).sum(-1) - parameters)
