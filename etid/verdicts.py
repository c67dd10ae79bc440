"""Verdicts: how an identification ended, in words, for every lane.

`RESULTS` extends `optimistix.RESULTS`. A member is an integer under `jit` and prints as its message: the cause, then what to do.
"""

import optimistix as optx


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]  # equinox enumerations extend by inheritance
    """How one identification ended. `successful` is the only good one."""

    max_steps_reached = (
        "The iteration did not settle within its steps; the best iterate is reported. "
        "Raise `max_steps`, average more periods, or use method='output_error'."
    )
    stalled = (
        "The solver can no longer change the parameters although it is not at a minimum. "
        "The model does not fit this recording, or the start was too far: check load and units."
    )
    unstable = (
        "The identified filters are unstable with this load, so the voltage cannot be predicted. "
        "Use method='output_error', which keeps the source impedance stable."
    )
    nonphysical = (
        "An element is negative or not a number, or the source impedance is not passive. "
        "The record is too noisy for this method or v_th, v_out and r_load do not belong together."
    )
    insensitive = (
        "The recording does not determine a parameter: its standard error exceeds its value. "
        "Record more periods or a steeper pulse, or fit a simpler circuit."
    )
    misfit = (
        "The prediction misses the recording by far more than its noise (chi2). The circuit is "
        "wrong, the trigger moved between the records, or the signal drifted or clipped."
    )
    flat = (
        "A record carries no signal above its noise. Check the electrode contact and the channel."
    )
    saturated = (
        "The converter clipped. Lower the gain or the range of the stimulus and record again."
    )
    nonfinite_samples = "A record contains NaN or infinite samples. Cut them out or record again."
    too_short = "The record is too short to identify anything. Record at least one whole pulse and 200 samples."
    not_periodic = (
        "The record does not repeat at its pulse_rate, or holds less than two periods of it. "
        "Correct pulse_rate, record more periods, or use a time-domain method."
    )
    misaligned = (
        "v_out is larger than v_th: the two records are swapped, or not aligned in time. "
        "Swap them, or align them on the pulse's edge."
    )
    unreadable = "The recording could not be read from its file; `etid check` says why."
    driver_failed = (
        "The driver this fit rests on was not identified successfully; its own verdict says why. "
        "Repeat the calibration before trusting the elements."
    )
