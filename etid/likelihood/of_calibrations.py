"""Score tests of the calibrations of a driver: for a missing pole, and of the known resistors.

Both project the effect of the common parameters out of further changes of the calibrations
(`etid.likelihood.sandwich`).

**A missing pole.** A Z_th whose order is too low can fit a calibration with χ² = 1 and a residual
of the size of the noise. It can still be wrong by 5 %. At 60 dB, order 3 in place of 5 or 6 changes
R_s by three per cent, ten of its standard errors. The missing part is smooth in frequency, and
noise is not. Rao's score test therefore tests for one more section,

    ∂Z_th = (g + h x) / (1 + 2ζx + x²),      x = s/ω,

at g = h = 0, for three dampings and for each ω of a grid that covers the band. A single pole is
ζ = 1 with g = h. The statistic has two degrees of freedom, and the largest of all sections decides.
In the map of failures (`python -m benchmarks failure_map`) it is at most 15 if the order is high
enough. It is at least 116 if a lower order changes an element by five of its standard errors.

**Resistors.** Only ratios to Z_th are observable. The error of a single resistor is therefore not
visible: Z_th has the same relative error. Several resistors must show the same Z_th. For each
resistor the score test estimates how far its value differs from the value that the others show,
with

    ∂G/∂ log R = G Z_th / (R + Z_th) = G (1 − G₀),      G = G₀ e^(−jωτ),

and how large a capacitance C is across it, which changes log R by −s R C. A missing pole and such a
capacitance imitate each other. The likelier of both is named: if the order was too low, the
statistic of a section is four times that of a capacitance, and if 1 to 10 pF were across a
resistor, that of the capacitance is 1.0 to 3 times the other.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.likelihood.calibrations import Calibrations, Near
from etid.likelihood.sandwich import Linear
from etid.precision import array_function, namespace
from etid.signals.transfer import AnyArray, combined, frequency_variable

MISSING_POLE = (
    36.0  # χ² of two degrees of freedom; by chance one of about 100 sections has it once in 10⁶
)
DAMPINGS = (0.1, 0.3, 1.0)
GRID = 36  # frequencies, eight per decade
BEYOND = 3.0  # factor by which the grid exceeds the band; poles beyond the band still have effect
# Standard errors; by chance one calibration in two million exceeds this.
RESISTOR = 5.0
# Relative error. Resistors of 0.1 % and meters are better. A smaller error changes an element by no
# more than this.
SMALLEST = 0.005
# [F] A larger capacitance across the known resistor changes an element by 1 % or more at 60 dB.
BRIDGE = 0.25e-12
# Part of the excess of chi2 that one wrong resistor must explain. Otherwise the records have
# another fault, which can imitate a wrong resistor.
EXPLAINED = 0.5


def grid(lowest: Float[AnyArray, ""], highest: Float[AnyArray, ""]) -> Float[AnyArray, " pole"]:
    """Frequencies of the sections [Hz] for a band."""
    lowest = lowest / BEYOND
    return lowest * (highest * BEYOND / lowest) ** np.linspace(0.0, 1.0, GRID)


@array_function
def sections(
    frequency: Float[AnyArray, " frequency"], highest: Float[AnyArray, ""]
) -> Complex[AnyArray, "section 2 frequency"]:
    """∂Z_th/∂g and ∂Z_th/∂h of all sections.

    Args:
        frequency: Frequencies [Hz].
        highest: End of the band, which begins with the first frequency [Hz].
    """
    xp, at = namespace(frequency), grid(frequency[0], highest)
    x = xp.tile(frequency[None, :] / at[:, None], (len(DAMPINGS), 1))
    zeta = np.repeat(DAMPINGS, GRID)[:, None]
    by_g = 1 / (1 - x * x + 2j * zeta * x)
    return xp.stack([by_g, 1j * x * by_g], axis=1)


@array_function
def missing_pole(
    calibrations: Calibrations, near: Near, linear: Linear
) -> Float[AnyArray, " section"]:
    """Score statistic of each section: χ² with two degrees of freedom if the section is absent.

    It is NaN if a section has no effect. `near` and `linear` are those of the minimum.
    """
    spectra, xp = calibrations.spectra, namespace(near.q)
    # The harmonics of the records differ so little that the sections are equal.
    frequency = calibrations.knots.at(spectra.frequency[0])
    highest = xp.where(spectra.selected, spectra.frequency, frequency[0]).max()
    by_z = sections(frequency, highest).reshape(-1, 1, frequency.shape[0])
    directions, others = linear.projected(near.condensed.rows(by_z * near.slopes.by_z))
    score = directions @ near.condensed.part - others @ calibrations.rest(near.q)
    s, t = score.reshape(-1, 2).T  # of g and of h
    by_g, by_h = xp.moveaxis(directions.reshape(s.shape[0], 2, -1), 1, 0)
    aa, ab, bb = (of @ linear.noise for of in (by_g * by_g, by_g * by_h, by_h * by_h))
    of_priors = (others @ linear.precision).reshape(s.shape[0], 2, -1)
    more = of_priors @ others.reshape(s.shape[0], 2, -1).swapaxes(-1, -2)
    aa, ab, bb = aa + more[:, 0, 0], ab + more[:, 0, 1], bb + more[:, 1, 1]
    return (s * s * bb - 2 * s * t * ab + t * t * aa) / (aa * bb - ab * ab)


def likeliest_section(
    calibrations: Calibrations, near: Near, linear: Linear
) -> Float[np.ndarray, "2"]:
    """ω [rad/s] and ζ of the section that the score test shows best, in NumPy."""
    spectra = calibrations.spectra
    best = np.nanargmax(missing_pole(calibrations, near, linear))
    f = grid(spectra.frequency[0, 0], spectra.frequency[spectra.selected].max())
    return np.array([2 * np.pi * f[best % GRID], DAMPINGS[best // GRID]])


class Mismatch(NamedTuple):
    """What each known resistor shows beyond its value and the other calibrations.

    Attributes:
        off: Excess of log R, and its standard error.
        across: Capacitance across the resistor [F], and its standard error.
    """

    off: Float[AnyArray, "2 record"]
    across: Float[AnyArray, "2 record"]


@array_function
def mismatch(calibrations: Calibrations, near: Near, linear: Linear) -> Mismatch:
    """What is wrong with each known resistor; `near` and `linear` are those of the minimum.

    Stated tolerances are in the errors, because `linear` has the errors of the instrument.
    """
    slopes, every, xp = near.slopes, calibrations.knots, namespace(near.q)
    records = slopes.gains.shape[0]
    alone = np.eye(records)[:, :, None]
    by_resistor = alone * (-slopes.z * slopes.by_z)
    # ∂ log Z / ∂C of Z = R ‖ C at C = 0 is −s R.
    s = frequency_variable(every.at(calibrations.spectra.frequency))
    across = -s * calibrations.calibration.r_load[:, None]
    changes = xp.concatenate([by_resistor, across * by_resistor])
    rows = near.condensed.rows(changes)
    directions, others = linear.projected(rows)
    own = (rows * linear.share * directions).sum(1)
    score = directions @ near.condensed.part - others @ calibrations.rest(near.q)
    # Estimate the noise after the change that explains most: its error must not count as noise.
    best = xp.argmax(score**2 / own)
    made = combined(others[best], slopes.by_q.reshape(linear.jacobian.shape[0], -1))
    change = (made.reshape(slopes.gains.shape) - changes[best]) * (score / own)[best]
    at = calibrations.profiles(near.q, near.profiles[0].gains + every.between(change))
    noise = near.condensed.means(near.profiles, every, calibrations.noise(at)[None])[0]
    of_priors = ((others @ linear.precision) * others).sum(1)
    error = xp.sqrt((noise * directions**2).sum(1) + of_priors) / own
    found = xp.stack([score / own, error]).reshape(2, 2, -1)
    # Of a capacitance the value that was entered is 0: the others show its excess, up to the sign.
    return Mismatch(found[:, 0], np.array([[-1.0], [1.0]]) * found[:, 1])


@array_function
def disagree(
    mismatch: Float[AnyArray, "2 record"],
    chi2: Float[AnyArray, ""],
    terms: Float[AnyArray, ""],
    smallest: float = SMALLEST,
) -> Bool[AnyArray, ""]:
    """Whether a known resistor is seen to be wrong by more than `smallest`."""
    off, error = mismatch
    squares = (off / error) ** 2
    # The errors use the noise without the wrong resistor; χ² uses the noise of the records.
    xp = namespace(off)
    left = xp.maximum(chi2 / (1 + squares / terms), 1.0)
    explained = squares * left > EXPLAINED * (chi2 - 1) * terms
    return ((squares > RESISTOR**2) & (xp.abs(off) > smallest) & explained).any()


def bridged(
    across: Float[AnyArray, "2 record"],
    chi2: Float[AnyArray, ""],
    terms: Float[AnyArray, ""],
    missing_pole: Float[AnyArray, ""],
) -> Bool[AnyArray, ""]:
    """Whether a capacitance across a known resistor is seen, and no likelier missing pole."""
    likelier = ((across[0] / across[1]) ** 2).max() > missing_pole
    return likelier & disagree(across, chi2, terms, BRIDGE)
