"""Measured impedances from files of potentiostats; the readers are those of impedance.py."""

import importlib
import os
import pathlib

import numpy as np
from jaxtyping import Complex, Float

from etid.files.channel import needs
from etid.recordings.errors import located
from etid.recordings.recording import RecordingError

INSTRUMENTS = (
    "gamry", "autolab", "parstat", "zplot", "versastudio", "powersuite", "biologic",
    "chinstruments",
)  # fmt: skip


def read_impedance(
    path: str | os.PathLike[str], instrument: str | None = None
) -> tuple[Float[np.ndarray, " frequency"], Complex[np.ndarray, " frequency"]]:
    """Frequencies [Hz] and impedance [Ω] of a file, for `identify_impedance`.

    Args:
        path: The file.
        instrument: Program that wrote it: one of `INSTRUMENTS`. If not given, the file is a table
            of frequency, real and imaginary part with commas, without a header.

    Raises:
        RecordingError: The file cannot be read, the instrument is not known, or the package
            impedance is not installed.
    """
    file = pathlib.Path(path)
    if instrument is not None and instrument not in INSTRUMENTS:
        raise RecordingError(
            f"is {instrument!r}", field="instrument", remedy=f"Use one of {', '.join(INSTRUMENTS)}"
        )
    if not file.is_file():
        raise RecordingError("there is no such file", file=str(file), remedy="Check the path")
    try:
        readers = importlib.import_module("impedance.preprocessing")
    except ImportError:
        raise needs("impedance", "eis", str(file)) from None
    # The readers raise any error for a file of another instrument, even UnboundLocalError.
    with located(str(file), foreign=Exception, remedy="Name its instrument"):
        frequency, impedance = readers.readFile(str(file), instrument)
        found = np.asarray(frequency, float), np.asarray(impedance, complex)
        if found[0].size == 0 or found[0].shape != found[1].shape:
            raise RecordingError("holds no impedances", remedy="Name the instrument")
    return found
