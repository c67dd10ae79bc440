"""Remarks: texts about a fit beside its verdict.

Most remarks state that the recording was not used as it was recorded: a part was left out, a record
was shifted, or the noise got another weight. One states that another circuit is likely too. A fit
with a remark can be successful.
"""

import enum
import functools

import numpy as np


class Remark(enum.IntFlag):
    """What a user must know of a fit beside its verdict; several remarks can apply."""

    mains_hum = enum.auto()
    periods_left_out = enum.auto()
    aligned = enum.auto()
    coarse_converter = enum.auto()
    pulse_rate_counted = enum.auto()
    circuits_close = enum.auto()
    small_delays = enum.auto()
    falls_with_current = enum.auto()
    at_bound = enum.auto()
    current_unused = enum.auto()
    follows_late = enum.auto()
    not_noise = enum.auto()
    positive_imaginary = enum.auto()
    no_phase = enum.auto()
    periods_shifted = enum.auto()
    gain_doubtful = enum.auto()


_TEXTS = {
    Remark.mains_hum: (
        "Mains hum was found. Between the harmonics of the pulses it was subtracted; the harmonics "
        "that it covers were left out."
    ),
    Remark.periods_left_out: "A disturbed pulse period was found; it was left out.",
    Remark.aligned: (
        "v_out or the current was more than one sample late or early; the records were aligned."
    ),
    Remark.coarse_converter: (
        "The steps of the converter exceed the noise; the fit weighted the rounding errors by size."
    ),
    Remark.pulse_rate_counted: (
        "The distance of the pulses does not match pulse_rate; the rate was measured in the "
        "record. Or was a sample lost or recorded twice in both records? Then ± are too large, or "
        "the fit is biased."
    ),
    Remark.circuits_close: (
        "Another circuit is likely too; the standard errors contain the difference between them."
    ),
    Remark.small_delays: (
        "The trigger delays of the study scatter less than their errors; the scatter limits each."
    ),
    Remark.falls_with_current: (
        "The residual looks like a resistance that falls with the current, a dependence on the "
        "amplitude; record several amplitudes and use identify_amplitudes."
    ),
    Remark.at_bound: (
        "Without its bounds an element would lie outside. The estimate is the mean of what the "
        "bounds leave; its distribution is not symmetric, and fit.posterior() shows it."
    ),
    Remark.current_unused: (
        "A current was recorded too, and this fit does not use it: it carries no signal, or a "
        "period was left out, or a method was given. identify_skin without a method uses driver "
        "and current at once."
    ),
    Remark.follows_late: (
        "The residual looks like a resistance that follows its current late, as of skin whose "
        "recovery after a pulse is slower than its fall; etid has no model of it."
    ),
    Remark.not_noise: (
        "The residual is not white noise. Up to 1 % of Z, as by errors of calibration, this widens "
        "the standard errors; above, it is a misfit."
    ),
    Remark.positive_imaginary: (
        "Im Z is positive at most frequencies, as of an inductance. If the file holds -Im Z, give "
        "the complex conjugate."
    ),
    Remark.no_phase: (
        "Z is real at all frequencies. If it is the magnitude alone, give |Z| exp(i phase)."
    ),
    Remark.periods_shifted: (
        "From one pulse period to another, v_out is shifted by whole samples: a sample was lost or "
        "recorded twice. The periods were aligned; check the recorder."
    ),
    Remark.gain_doubtful: (
        "The residual looks like another gain of v_out, too weakly to prove it. The standard "
        "errors contain what this gain would change; check the gains of both records."
    ),
}


@functools.cache  # files hold few combinations, 10^5 times each
def words(remarks: int | np.integer) -> str:
    """Names of the remarks, separated by spaces; empty if there is none."""
    return " ".join(str(remark.name) for remark in Remark if remark & int(remarks))


def texts(remarks: int | np.integer) -> list[str]:
    """One sentence for each remark."""
    return [_TEXTS[remark] for remark in Remark if remark & int(remarks)]


@functools.cache
def remarks_of(text: str) -> int:
    """Remarks from a text of `words`; raises KeyError if one of them is no remark."""
    return sum(int(Remark[word]) for word in set(text.split()))
