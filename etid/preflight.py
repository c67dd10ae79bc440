"""Pre-flight: what can be seen to be wrong with a recording before anything is fitted."""

import numpy as np
from jaxtyping import Float

from etid.filtering import TAPS
from etid.measurement import RIPPLE
from etid.noise import noise_std
from etid.recording import Recording
from etid.spectra import counted_pulse_rate, whole_periods

SHORTEST = 4 * TAPS + 104  # samples: the interpolation's edges and a hundred and some to fit
FLAT = (
    8.0  # standard deviations of the noise that a signal must exceed, peak to peak, beyond chance
)
RAIL = 3  # equal extreme samples in a row that a noisy or sloping signal does not produce
JUMP = 8.0  # converter steps by which a clipped signal enters and leaves its rail
POWER = 1.01  # of v_out over v_th; a passive load takes power, and gains match better than this
SEAM = 3  # samples on both sides of the joint between two periods
STEP = 4.0  # standard deviations of the noise by which they may differ there
SHIFT = 50e-6  # [s] that a load may delay v_out; R_th C_p is below 10 µs


def preflight(recording: Recording, *, periodic: bool = False) -> str | None:
    """Name the verdict that forbids a fit, or None.

    Verdicts: `too_short`, `nonfinite_samples`, `flat`, `saturated`, `misaligned`, `not_periodic`.

    Args:
        recording: Unloaded and loaded voltage.
        periodic: Whether whole pulse periods are needed.
    """
    v_th, v_out = recording.v_th, recording.v_out
    if v_th.size < SHORTEST:
        return "too_short"
    if not (np.isfinite(v_th).all() and np.isfinite(v_out).all()):
        return "nonfinite_samples"
    if any(_is_flat(recording, name) for name in ("v_th", "v_out")):
        return "flat"
    if any(_is_saturated(recording, name) for name in ("v_th", "v_out")):
        return "saturated"
    if _is_misaligned(v_th, v_out, recording.sample_rate):
        return "misaligned"
    if periodic and not is_periodic(recording):
        return "not_periodic"
    return None


def recorded_periods(recording: Recording) -> tuple[int, int]:
    """How many whole periods a recording holds by its own clock, and how many samples they are."""
    counted = counted_pulse_rate(recording.v_th, recording.sample_rate, recording.pulse_rate)
    return whole_periods(recording.v_out.size, recording.sample_rate, counted)


def is_periodic(recording: Recording) -> bool:
    """Whether the record holds whole pulse periods, each like the other where they are joined.

    Periods are a whole number of samples long to within half a sample, which matters where the
    signal is steep at the joint.
    """
    periods, samples = recorded_periods(recording)
    if periods == 0:
        return False
    rest = abs(periods * recording.sample_rate / recording.pulse_rate - samples)
    rest = min(rest, 0.5)  # a clock that is off has been counted
    for name in ("v_th", "v_out"):
        v = getattr(recording, name)
        joint = np.concatenate([v[samples - SEAM : samples], v[:SEAM]])
        sigma = float(noise_std(v, resolution(recording, name)))
        if rest * np.abs(np.diff(joint)).max() > STEP * max(sigma, RIPPLE * np.ptp(v)):
            return False
    return True


def resolution(recording: Recording, name: str) -> float:
    """Converter step [V] of one record, 0 if it is not known."""
    return recording.samples[name].resolution or 0.0


def _is_flat(recording: Recording, name: str) -> bool:
    v = getattr(recording, name)
    sigma = float(noise_std(v, resolution(recording, name)))
    return bool(np.ptp(v) <= FLAT * sigma or np.ptp(v) == 0)


def _is_saturated(recording: Recording, name: str) -> bool:
    """Samples at the converter's rails, or a flat top entered and left in jumps."""
    v = getattr(recording, name)
    step = resolution(recording, name)
    if recording.adc_range is not None:
        low, high = recording.adc_range
        return bool((v <= low + step / 2).any() or (v >= high - step / 2).any())
    for extreme in (v.max(), v.min()):
        at_rail = v == extreme
        edges = np.flatnonzero(np.diff(np.concatenate([[0], at_rail.astype(np.int8), [0]])))
        for start, stop in edges.reshape(-1, 2):
            inside = start > 0 and stop < v.size
            if stop - start < RAIL or not inside:
                continue
            floor = step if step > 0 else np.ptp(v) / 2**16
            jump = min(abs(v[start - 1] - extreme), abs(v[stop] - extreme))
            if jump > JUMP * floor:
                return True
    return False


def _is_misaligned(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], sample_rate: float
) -> bool:
    x, y = v_th - v_th.mean(), v_out - v_out.mean()
    if y @ y > POWER * (x @ x):
        return True
    size = 2 * x.size
    correlation = np.fft.irfft(np.fft.rfft(y, size) * np.conj(np.fft.rfft(x, size)), size)
    lag = int(np.argmax(correlation))
    lag = lag - size if lag > size // 2 else lag
    return abs(lag) > max(1.0, SHIFT * sample_rate)
