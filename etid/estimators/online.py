"""What fits of a tracker are in words: the reports of their files do not load `etid.display`."""

from etid.circuits.directions import DIRECTIONS
from etid.estimators.estimator import Description
from etid.estimators.registry import register_description
from etid.likelihood.noise import MISFIT_CHI2, MISFIT_RRSE

METHOD = "online"
MOVED, SPREAD = DIRECTIONS["gain"].moves, DIRECTIONS["spread"].least
SEEN_IN_PULSES = 5.3  # standard deviations that noise exceeds once in 10⁷ pulses
LATEST = 1.5  # [samples] delay of a pulse: up to 1 by the trigger and 0.5 by the window

register_description(
    METHOD,
    Description(
        words="on-line tracking",
        text="The loads were identified on-line, anew with each pulse, by an extended Kalman "
        "filter in information form, iterated at each pulse (Bell and Cathey, 1993). In bands of "
        "frequency of each pulse, the ratio of the loaded to the unloaded voltage was compared "
        "with Z_L / (Z_L + Z_th) exp(-jωτ), in continuous time and with what has aliased; the "
        "trigger delay τ of each pulse was one more unknown. The logarithms of the elements follow "
        "a random walk. After a change (generalised likelihood ratio, Willsky and Jones, 1976, or "
        "moving mean of the innovations, Lowry et al., 1992) an electrode began anew. Z_th "
        "is that of the calibrations.",
        conditions=(
            "the last pulse passed the checks for flat, clipped and missing samples",
            "its iteration settled",
            "its residual does not exceed the noise (χ² per degree of freedom of at most "
            f"{MISFIT_CHI2:g} or of what noise exceeds once in ten million pulses, or an "
            f"unexplained part of at most {100 * MISFIT_RRSE:g} % of the signal)",
            "score tests, summed over the pulses since the electrode began anew, find no "
            "difference between the gains of the two records that moves an element by "
            f"{100 * MOVED:g} %, and no spread of time constants above {SPREAD:g} (at most "
            f"{SEEN_IN_PULSES:g} standard deviations)",
            f"its trigger delay is at most {LATEST:g} samples",
            "no change of the driver was seen since the calibrations",
            "every relative standard error is below 1",
        ),
        errors="accumulate the information of all pulses; to them the error of Z_th and of the "
        "unloaded voltage was added, which no number of pulses lessens",
        noise="The variance of the noise was estimated at each pulse from the quiet between two "
        "pulses, at six frequencies and without a parabola through each block, and for each band "
        "of frequency from the unloaded record and the pulses before. A line of the mains between "
        "the harmonics was a sine of unknown amplitude and phase.",
        cited=("bell1993", "willsky1976", "lowry1992"),
    ),
)
