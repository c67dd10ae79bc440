"""Verdicts: the outcome of an identification, for each lane.

`RESULTS` extends `optimistix.RESULTS`. A member is an integer under `jit`. It prints as a message:
the cause, then the remedy.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from etid.precision import Module, namespace
from etid.printing import Overviewed, per_cent
from etid.signals.transfer import AnyArray


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]  # equinox enumerations extend by inheritance
    """Outcome of one identification. `USABLE` are those whose result can be used.

    Three members come from optimistix and lineax: `successful`, `max_steps_reached` (the iteration
    did not converge) and `nonfinite` (inf or NaN appeared during the fit).
    """

    unstable = (
        "The identified filters are unstable with this load: they cannot predict the voltage. "
        "Use the default method, or repeat the calibration with less noise."
    )
    nonphysical = (
        "An element is negative or not a number, an exponent exceeds 1, or the source impedance "
        "is not passive. Most likely the record is too noisy: record more periods, and check that "
        "v_th, v_out and r_load belong together."
    )
    insensitive = (
        "The recording does not determine a parameter: its standard error exceeds its value. "
        "Record more periods, reduce the noise, or fit a simpler circuit."
    )
    resolution = (
        "The steps of the converter are too coarse: with their rounding error, the standard error "
        "of a parameter exceeds its value. Use a finer range, more bits, or an amplifier."
    )
    misfit = (
        "The model misses the recording by more than its noise. Most likely it is another "
        "circuit, or for a driver a higher order: let etid choose it (auto), and look at the "
        "residual."
    )
    approximate = (
        "The circuit, or Z_th of a driver, is not exact, and nothing that has a name explains what "
        "it leaves beyond the noise. If ± are too large, look at the residual by frequency."
    )
    changed = (
        "The load or the driver changed during the record: the pulse periods differ by more than "
        "noise, as if an element or the amplitude changed. Make a shorter record, or cut the "
        "record to a part in which nothing changes."
    )
    order_too_low = (
        "The calibrations show a pole of the source impedance that the driver does not have. Raise "
        "`order` by one or two."
    )
    resistors_disagree = (
        "The calibrations with different known resistors show different source impedances. One "
        "r_load is wrong, belongs to another record, or has a capacitance across it; print the "
        "driver to see which one. Measure the resistors, and give every r_load in ohm."
    )
    implausible = (
        "The source impedance at 1 kHz lies outside `plausible`. Most likely r_load is not in "
        "ohm, or another load was connected: correct r_load. If the driver really is like this, "
        "set `plausible` [ohm]."
    )
    wrong_unit = (
        "The current, v_out, or their ratio has no size that a load at an electrode can have. "
        "Give the current in ampere and not in mA, and v_out in volt. Or are the two exchanged?"
    )
    unconnected = (
        "v_out equals v_th within the noise: no load draws a current, or both are the same "
        "record. Check the channels, and the contact of the finger or of the resistor."
    )
    inconsistent = (
        "The recording contradicts calibrations or what was stated: the driver changed, r_load, "
        "the scale of a current, its delay or a filter is wrong, or the load is another circuit. "
        "Let etid choose the circuit (auto), or calibrate again."
    )
    out_of_bounds = (
        "Recording and bounds contradict each other: without its bounds an element lies more than "
        "three standard errors outside. Correct the bounds, or fit another circuit."
    )
    driver_unclear = (
        "The calibrations leave the source impedance too uncertain: this recording moves it "
        "further than the fit can follow, or has two solutions. Calibrate with a second resistor, "
        "raise the sample rate, or state the delay of the instrument."
    )
    biased = (
        "Noise, aliases or a low sample rate shifted the estimate by several standard errors. Use "
        "the default method; if it is the default, use an anti-alias filter, or pulses whose "
        "period is not a whole number of samples."
    )
    flat = "A record carries no signal above its noise. Check the contact and the channel."
    repeated = (
        "The noise is exactly that of an earlier pulse. Noise never repeats, so this buffer was "
        "not filled anew. Check the acquisition."
    )
    saturated = (
        "The converter or an amplifier before it clipped. Lower the gain or the stimulus and "
        "record again. If nothing clipped, state the range of the converter (adc_range)."
    )
    nonfinite_samples = "A record contains NaN or infinite samples. Cut them out or record again."
    too_short = "The record is too short to identify anything. Record a whole pulse and its tail."
    misaligned = (
        "v_out carries more power than v_th, or is not aligned in time with v_th or the current. "
        "Align the records on the edge of the pulse, and check that they are not exchanged, their "
        "unit and polarity."
    )
    rate_mismatch = (
        "The distance between the pulses of v_th or the current contradicts sample_rate and "
        "pulse_rate, or that between the pulses of v_out. Correct the wrong number, or record both "
        "with one clock."
    )
    not_periodic = (
        "The record holds no whole pulse period, or begins in the middle of an edge. "
        "Record a whole number of periods, or use the default method."
    )
    unreadable = "The recording could not be read from its file; `etid check` says why."
    driver_failed = (
        "The driver of this fit was not identified successfully. Its own verdict says why: correct "
        "the calibration before you use the elements."
    )


USABLE = ("successful", "approximate")
"""Verdicts of results that can be used: their standard errors hold."""

_NAMES = {int(item._value): name for name, item in RESULTS._name_to_item.items()}


def left(chi2: Float[AnyArray, "*row"], error: Float[AnyArray, "*row"]) -> Float[AnyArray, "*row"]:
    """What a model leaves beyond the noise, from χ² and RRSE; relative to the signal, too."""
    xp = namespace(chi2, error)
    return error * xp.sqrt(xp.maximum(1 - 1 / chi2, 0.0))


def leaving(model: str, chi2: Float[AnyArray, ""], error: Float[AnyArray, ""]) -> str:
    """A sentence on what a model leaves, if ± contain it."""
    part = float(left(np.asarray(chi2), np.asarray(error)))
    # Over all harmonics the noise may hide it.
    size = f"{per_cent(part)} of the signal" if part > 0 else "less than the noise"
    return f"{model} leaves {size}; ± contain it."


def verdict(name: str) -> RESULTS:
    """The verdict with this name."""
    return RESULTS._name_to_item[name]


def first_verdict(*conditions: tuple[Bool[Array, ""] | np.bool_, RESULTS]) -> RESULTS:
    """The first verdict whose condition is true, else `successful`."""
    result = verdict("successful")
    for condition, item in reversed(conditions):
        if isinstance(condition, np.bool_):  # known while a program is traced
            result = item if condition else result
        else:
            result = RESULTS.where(condition, item, result)
    return result


def verdict_names(result: RESULTS) -> np.ndarray:
    """Names of the verdicts of all lanes, as an array of strings of the same shape."""
    values = np.asarray(result._value)
    return np.vectorize(_NAMES.__getitem__, otypes=[object])(values).astype(str)


def usable(result: RESULTS) -> Bool[AnyArray, "*lane"]:
    """Whether results can be used, while a program is traced, too."""
    number: Any = result._value  # members compare themselves by programs that compile
    codes = [int(verdict(one)._value) for one in USABLE]
    if isinstance(number, jax.core.Tracer):
        return functools.reduce(operator.or_, [number == one for one in codes])
    return np.isin(np.asarray(number), codes)


def counts(names: np.ndarray) -> dict[str, int]:
    """How often each verdict occurs, most frequent first."""
    found, number = np.unique(names, return_counts=True)
    order = np.argsort(-number, kind="stable")
    return {str(found[i]): int(number[i]) for i in order}


def counted(names: np.ndarray) -> str:
    """How often each verdict occurs, as text."""
    return ", ".join(f"{number} {name}" for name, number in counts(names).items())


class Judged(Overviewed, Module):
    """An outcome with a verdict, or a batch of outcomes.

    Attributes:
        result: The verdict; for a batch, the verdict of each lane.
    """

    result: eqx.AbstractVar[RESULTS]

    @property
    def verdict(self) -> Any:
        """Name of the verdict; an array of names for a batch."""
        value = np.asarray(self.result._value)
        return verdict_names(self.result) if value.ndim else _NAMES[value.item()]

    @property
    def usable(self) -> Any:
        """Whether the verdict is one of `USABLE`; an array for a batch."""
        found = np.asarray(usable(self.result))
        return found if found.ndim else bool(found)


def verdicts_of(names: np.ndarray) -> RESULTS:
    """The verdicts of many lanes from their names: the inverse of `verdict_names`."""
    values = [int(verdict(str(name))._value) for name in np.ravel(names)]
    return _of_codes(np.reshape(np.array(values, int), np.shape(names)))


def first_reason(reasons: Sequence[tuple[Bool[AnyArray, "*row"], str]]) -> RESULTS:
    """The verdicts of rows: the first whose reason holds, else `successful`."""
    conditions, names = zip(*reasons, strict=True)
    codes = [int(verdict(name)._value) for name in names]
    xp = namespace(*conditions)
    return _of_codes(xp.select(list(conditions), codes, int(verdict("successful")._value)))


def _of_codes(codes: Int[AnyArray, "*row"]) -> RESULTS:
    leaves, tree = jax.tree.flatten(RESULTS.successful)
    return jax.tree.unflatten(tree, [codes.astype(leaves[0].dtype)])


@functools.cache
def own_part(verdict: str, note: str, spectrum: bool = False) -> str:
    """What a note says beyond the message of its verdict."""
    common = message(verdict, spectrum)
    return " ".join((note.replace(common, " ") if common else note).split())


# A spectrum has no periods, no driver and no choice of method, so its remedies are others.
_OF_SPECTRUM = {
    "misfit": (
        "The circuit misses the impedance by more than its noise. Fit another circuit, and look at "
        "the residual. Or is the impedance disturbed? etid.kramers_kronig tests it."
    ),
    "max_steps_reached": (
        "The iteration did not converge; the fit reports the best iterate. Fit a simpler circuit, "
        "or hold an element that is known (fixed)."
    ),
    "nonphysical": (
        "An element is not a number, or an exponent exceeds 1. Fit a capacitor in place of the "
        "constant-phase element, and check the unit of the impedance and the sign of its imaginary "
        "part."
    ),
    "insensitive": (
        "The impedance does not determine a parameter: its standard error exceeds its value, or it "
        "could be three times as large. Measure at more frequencies, fit a simpler circuit, or "
        "hold an element (fixed)."
    ),
    "out_of_bounds": (
        "Impedance and bounds contradict each other: without its bounds an element lies more than "
        "three standard errors outside. Correct the bounds, or fit another circuit."
    ),
    "nonfinite_samples": "The impedance contains NaN or infinite numbers. Leave them out.",
    "unreadable": "These arrays are no impedance; the note says why.",
}


@functools.cache
def message(name: str, spectrum: bool = False) -> str:
    """Meaning and remedy of a verdict, of a fit to a measured spectrum if this is set.

    It is empty for `successful`.
    """
    if spectrum and name in _OF_SPECTRUM:
        return _OF_SPECTRUM[name]
    if name == "max_steps_reached":  # lineax recommends an argument that etid does not have
        return (
            "The iteration did not converge; the fit reports the best iterate. "
            "Average more periods."
        )
    if name == "nonfinite":  # optimistix names no cause
        return (
            "inf or NaN appeared during the fit. Most likely the numbers are far from those of an "
            "electrode: check the units and r_load."
        )
    return RESULTS[RESULTS._name_to_item[name]]
