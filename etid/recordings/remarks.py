"""What was done to a recording before it was fitted, in words.

A verdict says how a fit ended. A remark says that the recording was not used as it is: a part was
left out, or its noise was weighed in another way. A fit with a remark can be successful.
"""

import enum

import numpy as np


class Remark(enum.IntFlag):
    """What was done to a recording before the fit; several may hold."""

    mains_hum = enum.auto()
    periods_left_out = enum.auto()
    aligned = enum.auto()
    coarse_converter = enum.auto()
    pulse_rate_counted = enum.auto()


_TEXTS = {
    Remark.mains_hum: "Mains hum was found and its harmonics were left out.",
    Remark.periods_left_out: "A disturbed pulse period was found and left out.",
    Remark.aligned: "v_out is more than one sample late or early, and was aligned with v_th.",
    Remark.coarse_converter: (
        "The converter's steps exceed the noise; the rounding error was weighed as such."
    ),
    Remark.pulse_rate_counted: (
        "The pulses are not as far apart as pulse_rate says; the rate was counted in the record."
    ),
}


def words(remarks: int | np.integer) -> str:
    """Names of the remarks, separated by blanks; empty if there is none."""
    return " ".join(str(one.name) for one in Remark if one & int(remarks))


def texts(remarks: int | np.integer) -> list[str]:
    """A sentence for each remark."""
    return [_TEXTS[one] for one in Remark if one & int(remarks)]


def remarks_of(text: str) -> int:
    """The remarks of `words`.

    Raises:
        ValueError: A word is not a remark.
    """
    known = {str(one.name): one for one in Remark}
    unknown = sorted(set(text.split()) - known.keys())
    if unknown:
        raise ValueError(f"{unknown} are not remarks; those are {', '.join(known)}")
    return int(sum(known[word] for word in set(text.split())))
