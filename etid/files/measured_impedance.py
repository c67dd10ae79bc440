"""Measured impedances from files of potentiostats; the readers are those of impedance.py."""

import os
import pathlib

import numpy as np
from jaxtyping import Complex, Float

from etid.files.channel import optional
from etid.recordings.errors import located, require_file
from etid.recordings.recording import RecordingError


def read_impedance(
    path: str | os.PathLike[str], instrument: str | None = None
) -> tuple[Float[np.ndarray, " frequency"], Complex[np.ndarray, " frequency"]]:
    """Frequencies [Hz] and impedance [Ω] of a file, for `identify_impedance`.

    Args:
        path: The file.
        instrument: Program that wrote it: `gamry`, `autolab`, `parstat`, `zplot`, `versastudio`,
            `powersuite`, `biologic` or `chinstruments`. If not given, the file is a table of
            frequency, real and imaginary part with commas, without a header.

    Raises:
        RecordingError: The file cannot be read, the instrument is not known, or the package
            impedance is not installed.
    """
    file = pathlib.Path(path)
    instruments = (
        "gamry", "autolab", "parstat", "zplot", "versastudio", "powersuite", "biologic",
        "chinstruments",
    )  # fmt: skip
    if instrument is not None and instrument not in instruments:
        raise RecordingError(
            f"is {instrument!r}", field="instrument", remedy=f"Use one of {', '.join(instruments)}"
        )
    require_file(str(file))
    readers = optional("impedance.preprocessing", "eis", str(file), "impedance")
    # The readers raise any error for a file of another instrument, even UnboundLocalError.
    with located(str(file), foreign=Exception, remedy="Name its instrument"):
        frequency, impedance = readers.readFile(str(file), instrument)
        frequency, z = np.asarray(frequency, float), np.asarray(impedance, complex)
        if frequency.size == 0 or frequency.shape != z.shape:
            raise RecordingError("holds no impedances", remedy="Name the instrument")
    return frequency, z
