"""Who the rivals are, how each is set, and where it should work."""

from collections.abc import Mapping
from typing import Any, NamedTuple

SCENES: Mapping[str, Mapping[str, Any]] = {  # settings of `benchmarks.ladder.rung`, all dry skin
    "60 dB, delays": {},
    "80 dB, no delays": {"snr_db": 80.0, "trigger_jitter_rms": 0.0},
}
LATE, EXACT = SCENES


class Rival(NamedTuple):
    """One estimator of another package."""

    name: str  # as tables and charts show it
    package: str  # whose version is shown
    setting: str  # how it is set, in a line
    works: str = EXACT  # a scene in which it should work, of `SCENES`
    # whether it minimises the residuals of `harmonic_fit`: what etid reaches, it should reach
    strong: bool = False
    # of `.rivals/`, made from the requirements of that name beside this file
    environment: str = "common"
    program: Mapping[str, str] = {}  # what must be on the path besides, by its Debian packages
    estimator: str = ""  # which one of a module that has several for all draws at once


def _by_octave(estimator: str, setting: str) -> Rival:
    octave = {"octave-cli": "octave octave-control"}
    return Rival(f"Octave {estimator}", "control", setting, program=octave, estimator=estimator)


_PERIOD = "one averaged period of current and voltage at 1 MHz"
_ORDER = "first order from current to voltage, 1 MHz"
_STATE = "one state from current to voltage, 1 MHz"
_ADVANCED = "the input advanced by a sample; no delay"
_SAME = "the same residuals, compiled"
_SPECTRUM = "spectrum in kΩ, nF, MHz, weighted by its noise; no delay"
_MINPACK = "MINPACK, logarithms, errors in both records, delays fitted"
_LMFIT = "the same spectrum and weights, by the lmfit model it makes"
_NARX = "linear, first order, free run, from current to voltage, 1 MHz; no delay"
_NO_PENALTY = f"{_STATE}, L-BFGS without penalties; no delay"

RIVALS: Mapping[str, Rival] = {  # by module, and by estimator where it has several
    "scipy_harmonics": Rival("SciPy least_squares, harmonics", "scipy", _MINPACK, LATE, True),
    "lmfit_leastsq": Rival("lmfit leastsq", "lmfit", "the same residuals", LATE, True),
    "optimistix_lm": Rival("optimistix LM", "optimistix", f"{_SAME}, tolerances 1e-8", LATE, True),
    "jaxopt_lm": Rival("jaxopt LM", "jaxopt", f"{_SAME}, Cholesky, tolerances 1e-8", LATE, True),
    "scipy_lfilter": Rival(
        "SciPy least_squares, lfilter", "scipy", f"{_PERIOD}, Tustin, a delay of V_th"
    ),
    "impedance_py": Rival("FFT, impedance.py", "impedance", _SPECTRUM),
    "impedance_fitter": Rival(
        "FFT, ImpedanceFitter", "impedancefitter", _LMFIT, environment="impedancefitter"
    ),
    "sippy_oe": Rival("SIPPY OE", "sippy_unipi", f"{_ORDER}, {_ADVANCED}"),
    "fastcan_narx": Rival("fastcan NARX", "fastcan", _NARX),
    "jax_sysid_linear": Rival("jax-sysid", "jax-sysid", _NO_PENALTY, environment="jax_sysid"),
    "octave_arx": _by_octave("arx", f"{_ORDER}, {_ADVANCED}"),
    "octave_n4sid": _by_octave("n4sid", f"{_STATE}; no delay"),
}
