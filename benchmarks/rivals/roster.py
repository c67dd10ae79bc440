"""Who the rivals are, how each is set, and where it should work."""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Rival(NamedTuple):
    """One estimator of another package.

    Attributes:
        name: As tables and charts show it.
        environment: Of `.rivals/`, made from the requirements of that name beside this file.
        package: Whose version is shown.
        setting: How it is set, in a line.
        works: A scene in which it should work, of `SCENES`.
        program: What must be on the path besides, by its Debian packages.
    """

    name: str
    environment: str
    package: str
    setting: str
    works: str
    program: Mapping[str, str] = {}


SCENES: Mapping[str, Mapping[str, Any]] = {  # settings of `benchmarks.ladder.rung`, all dry skin
    "60 dB, delays": {},
    "80 dB, no delays": {"snr_db": 80.0, "trigger_jitter_rms": 0.0},
}

_OCTAVE = {"octave-cli": "octave octave-control"}
RIVALS: Mapping[str, Rival] = {  # by module
    "scipy_harmonics": Rival(
        "SciPy least_squares, harmonics",
        "common",
        "scipy",
        "MINPACK, logarithms, errors in both records, delays fitted",
        "60 dB, delays",
    ),
    "lmfit_leastsq": Rival(
        "lmfit leastsq", "common", "lmfit", "the same residuals", "60 dB, delays"
    ),
    "optimistix_lm": Rival(
        "optimistix LM",
        "common",
        "optimistix",
        "the same residuals, compiled, tolerances 1e-8",
        "60 dB, delays",
    ),
    "jaxopt_lm": Rival(
        "jaxopt LM",
        "common",
        "jaxopt",
        "the same residuals, compiled, Cholesky, tolerances 1e-8",
        "60 dB, delays",
    ),
    "scipy_lfilter": Rival(
        "SciPy least_squares, lfilter",
        "common",
        "scipy",
        "one averaged period of current and voltage at 1 MHz, Tustin, a delay of V_th",
        "80 dB, no delays",
    ),
    "impedance_py": Rival(
        "FFT, impedance.py",
        "common",
        "impedance",
        "spectrum in kΩ, nF, MHz, weighted by its noise; no delay",
        "80 dB, no delays",
    ),
    "impedance_fitter": Rival(
        "FFT, ImpedanceFitter",
        "impedancefitter",
        "impedancefitter",
        "the same spectrum and weights, by the lmfit model it makes",
        "80 dB, no delays",
    ),
    "sippy_oe": Rival(
        "SIPPY OE",
        "common",
        "sippy_unipi",
        "first order from current to voltage, 1 MHz, the input advanced by a sample; no delay",
        "80 dB, no delays",
    ),
    "fastcan_narx": Rival(
        "fastcan NARX",
        "common",
        "fastcan",
        "linear, first order, free run, from current to voltage, 1 MHz; no delay",
        "80 dB, no delays",
    ),
    "jax_sysid_linear": Rival(
        "jax-sysid",
        "jax_sysid",
        "jax-sysid",
        "one state from current to voltage, 1 MHz, L-BFGS without penalties; no delay",
        "80 dB, no delays",
    ),
    "octave_arx": Rival(
        "Octave arx",
        "common",
        "control",
        "first order from current to voltage, 1 MHz, the input advanced by a sample; no delay",
        "80 dB, no delays",
        _OCTAVE,
    ),
    "octave_n4sid": Rival(
        "Octave n4sid",
        "common",
        "control",
        "one state from current to voltage, 1 MHz; no delay",
        "80 dB, no delays",
        _OCTAVE,
    ),
}
