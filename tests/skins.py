"""Skins of these tests, and how far from them a fit is."""

import dataclasses
from typing import Any

import numpy as np

import etid

DRY = etid.SkinRC(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
DAMP = etid.SkinRC(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9)


def relative(fit):
    """Relative standard errors."""
    return np.asarray(fit.stderr.values()) / np.asarray(fit.circuit.values())


def off(fit, truth: Any = DRY):
    """Errors of the elements of one fit or of several, in standard errors.

    Args:
        fit: One fit, or several along the first axis.
        truth: A circuit or a load, or values [SI] for each fit or for all.
    """
    truth = dataclasses.astuple(truth) if hasattr(truth, "__dataclass_fields__") else truth
    error = np.asarray(fit.circuit.values()) - np.asarray(truth)
    return error / np.asarray(fit.stderr.values())


def sampled(coefficients, first=0, samples=10_000):
    """Waves at 200 kHz of these Fourier coefficients of 60 Hz and its multiples (wave, harmonic).

    The transform of three periods, which are 10 000 samples, is exact between them too.
    """
    spectra = np.zeros((len(coefficients), 5_001), complex)
    spectra[:, 3 : 3 * np.shape(coefficients)[-1] + 1 : 3] = coefficients
    wave = np.fft.irfft(spectra, 10_000, norm="forward")
    return wave[:, (first + np.arange(samples)) % 10_000]
