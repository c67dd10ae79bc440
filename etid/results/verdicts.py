"""Verdicts: how an identification ended, in words, for every lane.

`RESULTS` extends `optimistix.RESULTS`. A member is an integer under `jit` and prints as its
message: the cause, then what to do.
"""

import jax
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]  # equinox enumerations extend by inheritance
    """How one identification ended. `successful` is the only good one.

    Three members come from optimistix and lineax: `successful`, `max_steps_reached` (the iteration
    did not settle) and `nonfinite` (inf or NaN appeared during the fit).
    """

    unstable = (
        "The identified filters are unstable with this load, so the voltage cannot be predicted. "
        "Use method='output_error', or repeat the calibration with less noise."
    )
    nonphysical = (
        "An element is negative or not a number, an exponent exceeds 1 by more than its error, or "
        "the source impedance is not passive. "
        "The record is too noisy for this method, the trigger moved between the records, or "
        "v_th, v_out and r_load do not belong together."
    )
    insensitive = (
        "The recording does not determine a parameter: its standard error exceeds its value. "
        "Record more periods, reduce the noise, or fit a simpler circuit."
    )
    resolution = (
        "The converter's steps are too coarse: with their rounding error, the standard error of a "
        "parameter exceeds its value. Use a finer range, more bits, or an amplifier."
    )
    misfit = (
        "The prediction misses the recording by far more than its noise (chi2), or in the way of "
        "another relaxation, or of one that is spread over time constants. The circuit is wrong, "
        "the trigger moved between the records, the signal drifted or clipped, or output error met "
        "mains hum."
    )
    changed = (
        "The load or the driver changed during the record: its pulse periods differ by more than "
        "noise, in the way of an element or of the amplitude. Record shorter, or cut the record to "
        "a part in which nothing changes."
    )
    order_too_low = (
        "The calibrations show a pole of the source impedance that the driver lacks. Raise `order` "
        "by one or two."
    )
    resistors_disagree = (
        "The calibrations with different known resistors show different source impedances. One "
        "r_load is wrong, or belongs to another record; print the driver to see which may be. "
        "Measure the resistors, and give every r_load in ohm."
    )
    implausible = (
        "The source impedance at 1 kHz lies outside `plausible`. Is r_load in ohm, and was that "
        "resistor connected? If the driver really is like this, set `plausible` [ohm]."
    )
    unconnected = (
        "v_out equals v_th to within their noise: nothing is connected that draws a current, or "
        "both are the same record. Check the contact and the channels."
    )
    inconsistent = (
        "The recording and the calibrations contradict each other about the source impedance, or "
        "their unloaded voltages differ by more than amplitude and delay. "
        "The driver changed in between, or r_load is not what it is said to be. Calibrate again."
    )
    driver_unclear = (
        "The calibrations are so noisy that this recording moves the source impedance further than "
        "they can be followed. Repeat them with less noise, more periods or a second resistor, or "
        "identify all recordings together with identify_jointly."
    )
    biased = (
        "Noise has shifted the estimate by several standard errors: Steiglitz-McBride from the "
        "minimum of its own model, a non-parametric fit from what it would be without noise. Or "
        "the sample rate is too low for the interpolation of output error, which misses the "
        "recording by more than its noise. Use the default method."
    )
    flat = "A record carries no signal above its noise. Check the contact and the channel."
    saturated = "The converter clipped. Lower the gain or the stimulus and record again."
    nonfinite_samples = "A record contains NaN or infinite samples. Cut them out or record again."
    too_short = "The record is too short to identify anything. Record a whole pulse and its tail."
    misaligned = (
        "v_out carries more power than v_th, or is not aligned with it in time. "
        "Swap the two records, or align them on the edge of the pulse."
    )
    rate_mismatch = (
        "The pulses of v_th are not as far apart as sample_rate and pulse_rate say, and every time "
        "constant would be wrong by that. Correct the number that is wrong."
    )
    not_periodic = (
        "The record holds no whole pulse period, or begins in the middle of an edge. "
        "Record a whole number of periods, or use method='output_error'."
    )
    unreadable = "The recording could not be read from its file; `etid check` says why."
    driver_failed = (
        "The driver this fit rests on was not identified successfully; its own verdict says why. "
        "Repeat the calibration before trusting the elements."
    )


# lineax' own text advises an argument that etid does not have.
_MESSAGES = {
    "max_steps_reached": (
        "The iteration did not settle; its best iterate is reported. "
        "Average more periods, or use method='output_error'."
    ),
}
_NAMES = {int(item._value): name for name, item in RESULTS._name_to_item.items()}


def verdict(name: str) -> RESULTS:
    """The verdict of this name."""
    return RESULTS._name_to_item[name]


def first_verdict(*conditions: tuple[Bool[Array, ""], RESULTS]) -> RESULTS:
    """The first verdict whose condition holds, else successful."""
    result = verdict("successful")
    for condition, item in reversed(conditions):
        result = RESULTS.where(condition, item, result)
    return result


def verdict_names(result: RESULTS) -> np.ndarray:
    """Names of the verdicts of all lanes, as an array of strings with the lanes' shape."""
    values = np.asarray(result._value)
    return np.vectorize(_NAMES.__getitem__, otypes=[object])(values).astype(str)


def verdicts_of(names: np.ndarray) -> RESULTS:
    """The verdicts of many lanes from their names; the inverse of `verdict_names`."""
    item = RESULTS.successful
    values = [int(verdict(str(name))._value) for name in np.ravel(names)]
    leaves, tree = jax.tree.flatten(item)
    return jax.tree.unflatten(tree, [np.reshape(values, np.shape(names)).astype(leaves[0].dtype)])


def message(name: str) -> str:
    """What a verdict means and what to do; empty for `successful`."""
    return _MESSAGES.get(name, RESULTS[RESULTS._name_to_item[name]])
