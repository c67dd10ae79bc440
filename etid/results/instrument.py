"""Errors of an instrument that no recording shows, and what each adds to the standard errors."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Array, Float

from etid.circuits.directions import DIRECTIONS, ON_LOADS
from etid.precision import Module, namespace
from etid.printing import Overview, Overviewed, per_cent
from etid.signals.transfer import AnyArray

_Number = float | Float[Array | np.ndarray, ""]
_Kind = TypeVar("_Kind", bound="Instrument")

# Errors of which a budget shows the effect, of this size where nobody stated them [relative, F].
BUDGETED = {name: of.usual for name, of in DIRECTIONS.items() if of.usual}
# Those that a fit estimates with the elements; the others are later than its calibrations.
ERRORS = {name: size for name, size in BUDGETED.items() if DIRECTIONS[name].records}
OF_RESISTORS = tuple(name for name in ERRORS if name not in ON_LOADS)
LATER = tuple(name for name in BUDGETED if name not in ERRORS)
TOLERANCES = tuple(name for name, of in DIRECTIONS.items() if of.largest)
NARROW = 1e-3  # of a tolerance that nobody stated: a prior that no recording changes


class Instrument(Module):
    """Standard deviations of errors of the instrument, each of mean 0 and independent.

    Some errors change a recording almost as the elements do: at 60 dB 0.1 % of gain moves R_p of
    dry skin by 2 %, and χ² stays 1. What is known of them comes from a data sheet (JCGM 100, the
    GUM: type B). The fit estimates each error with its elements, so that the standard errors
    contain it, as far as the recording does not determine it.

    Attributes:
        gain: Of the gain of V_out relative to that of V_th, in all recordings [relative].
        r_load: Of each known resistor [relative].
        c_load: Of the capacitance across each known resistor, of its carrier and leads, that the
            skins did not have [F].
        crosstalk: Of the part of V_th that V_out shows in all recordings [relative].
        capacitance: Of a capacitance across the skin that the calibrations did not have [F].
        drift: Of the change of each parameter of Z_th between calibration and skin [relative].
        delay: Of the delay of each V_out after its V_th [s]; None leaves the delays open.
    """

    gain: _Number = 0.0
    r_load: _Number = 0.0
    c_load: _Number = 0.0
    crosstalk: _Number = 0.0
    capacitance: _Number = 0.0
    drift: _Number | None = 0.0
    delay: _Number | None = None

    def __check_init__(self) -> None:
        for name in TOLERANCES:
            largest, unit = DIRECTIONS[name].largest, DIRECTIONS[name].unit
            value, least = getattr(self, name), "above 0" if name == "delay" else "at least 0"
            if value is None or hasattr(value, "shape"):  # arrays, which may be traced
                continue
            number = isinstance(value, int | float) and 0 <= value < largest
            if not number or (name == "delay" and value == 0):
                raise ValueError(
                    f"{name} of an instrument is {value!r}; it is a standard deviation [{unit}], "
                    f"{least} and below {largest:g}"
                )

    @classmethod
    def read(cls: type[_Kind], text: str) -> _Kind:
        """The instrument of a text such as `"gain=1e-3 drift=0.01"`.

        Raises:
            ValueError: A part is no `name=number`, or a name is not known or stands twice.
        """
        found: dict[str, float] = {}
        for part in text.split():
            name, _, number = part.partition("=")
            if name not in TOLERANCES or name in found:
                raise ValueError(f"{part!r} is none of {', '.join(TOLERANCES)}, each at most once")
            try:
                found[name] = float(number)
            except ValueError:
                raise ValueError(f"{part!r} is no number; write {name}=1e-3") from None
        return cls(**found)

    def deviations(self, resistors: int) -> Float[AnyArray, " error"]:
        """Standard deviations of `ON_LOADS`, then each of `OF_RESISTORS` of each known resistor."""
        each = *ON_LOADS, *(name for name in OF_RESISTORS for _ in range(resistors))
        told = [getattr(self, name) for name in each]
        xp = namespace(*told)
        return xp.stack([xp.asarray(one, float) for one in told])

    def budgeted(self) -> Float[AnyArray, " error"]:
        """The tolerance of each of `BUDGETED`; 0 if none is stated."""
        told = [getattr(self, name, None) for name in BUDGETED]
        told = [0.0 if one is None else one for one in told]
        xp = namespace(*told)
        return xp.stack([xp.asarray(one) for one in told])

    def complete(self: _Kind) -> _Kind:
        """The same with the size in `BUDGETED` for each error that nobody stated."""
        own = {name: getattr(self, name) for name in ERRORS}
        sizes = {name: namespace(of).where(of > 0, of, ERRORS[name]) for name, of in own.items()}
        return dataclasses.replace(self, **sizes)

    def narrow(self: _Kind) -> _Kind:
        """The same with a small deviation for each of `ERRORS` that nobody stated."""
        narrow = {name: NARROW * size for name, size in ERRORS.items()}
        return type(self)(**(narrow | self.stored())).as_arrays()

    def stored(self) -> dict[str, float]:
        """The tolerances that are stated, by name."""
        told = {name: getattr(self, name) for name in TOLERANCES}
        numbers = {name: float(np.asarray(of)) for name, of in told.items() if of is not None}
        return {name: of for name, of in numbers.items() if of}

    def listed(self) -> tuple[str, ...]:
        """The tolerances that are stated, such as `"gain 0.001"`."""
        return tuple(f"{name} {value!r}" for name, value in self.stored().items())

    def text(self) -> str:
        """The text that `read` reads."""
        return " ".join(f"{name}={value!r}" for name, value in self.stored().items())

    def as_arrays(self: _Kind) -> _Kind:
        """The same with arrays, which a traced program takes as operands; None without a drift."""
        told = {name: np.asarray(value) for name, value in self.stored().items()}
        errors = {name: told.get(name, np.zeros(())) for name in ERRORS}
        return type(self)(**errors, drift=told.get("drift"), delay=told.get("delay"))


class Effects(Module):
    """What errors of the instrument do to the elements of a fit, or of a batch of fits.

    Attributes:
        moved: Relative change of each element by an error of each of `BUDGETED`: by one standard
            deviation where a tolerance is stated, and by an error of the size in `BUDGETED` where
            it is not. NaN where this is not known.
        stated: The tolerance that is stated [relative, F]; 0 without one.
        discrepancy: Relative standard deviation of each element by what its circuit leaves; 0 where
            the noise explains the residual. It is in ±.
    """

    moved: Float[Array | np.ndarray, "*lane error element"]
    stated: Float[Array | np.ndarray, "*lane error"]
    discrepancy: Float[Array | np.ndarray, "*lane element"]

    @classmethod
    def of_errors(
        cls,
        moved: Float[AnyArray, "*row error element"],
        later: Float[AnyArray, "*row later element"],
        stated: Float[AnyArray, "*row_or_not budgeted"],
    ) -> "Effects":
        """The effects of the errors of `Instrument.deviations` and of `LATER`."""
        xp, count = namespace(moved), len(ON_LOADS)
        shape = *moved.shape[:-2], len(OF_RESISTORS), -1, moved.shape[-1]
        of_each = moved[..., count:, :].reshape(shape)  # the resistors are independent
        of_resistors = xp.sqrt((of_each**2).sum(-2))
        every = xp.concatenate([xp.abs(moved[..., :count, :]), of_resistors, xp.abs(later)], -2)
        order = [(*ON_LOADS, *OF_RESISTORS, *LATER).index(name) for name in BUDGETED]
        stated = xp.broadcast_to(stated, (*moved.shape[:-2], len(BUDGETED)))
        return cls(every[..., np.array(order), :], stated, xp.zeros_like(moved[..., 0, :]))

    @classmethod
    def unknown(cls, elements: int, *lane: int) -> "Effects":
        """Those of fits whose estimator does not compute them: NaN."""
        sizes = (len(BUDGETED), elements), (len(BUDGETED),), (elements,)
        return cls(*(np.full((*lane, *size), np.nan) for size in sizes))

    @property
    def unstated(self) -> dict[str, Float[np.ndarray, " element"]]:
        """The effects of the errors that nobody stated, by source; for one fit."""
        of = zip(BUDGETED, np.asarray(self.stated), np.asarray(self.moved), strict=True)
        return {name: moved for name, told, moved in of if told == 0 and np.isfinite(moved).all()}


def largest(
    unstated: Mapping[str, Float[np.ndarray, " element"]],
    names: Sequence[str],
    errors: Float[np.ndarray, " element"],
) -> str:
    """A sentence on the error of the instrument that nobody stated and that exceeds ± most.

    Args:
        unstated: Relative changes of the elements by errors of the sizes in `BUDGETED`, by source.
        names: The elements.
        errors: Their relative standard errors.

    Returns:
        Empty if no such error moves an element by more than its standard error.
    """
    beside = [
        (float(moved[i] / errors[i]), source, i)
        for source, moved in unstated.items()
        for i in np.flatnonzero(
            (moved > errors) & (errors > 0)
        ).tolist()  # 0 if an element is fixed
    ]
    if not beside:
        return ""
    _, source, i = max(beside)
    what = DIRECTIONS[source].in_words.format(_size(source, BUDGETED[source]))
    return f"Not in ±: {what} would move {names[i]} by {per_cent(float(unstated[source][i]))}."


def _size(source: str, size: float) -> str:
    """The size of an error, as in "0.1 %"."""
    in_farad = DIRECTIONS[source].unit == "F"
    return f"{size * 1e12:g} pF" if in_farad else f"{100 * size:g} %"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Budget(Overviewed):
    """The uncertainty budget of a fit (JCGM 100, the GUM). All numbers are relative.

    Attributes:
        names: The elements.
        parts: Standard deviation that each source adds to each element, by the source: the
            recording, what the circuit leaves, its driver (noise of the calibrations, and drift),
            and each stated tolerance of the instrument.
        tolerances: The stated tolerances [relative, F].
        unstated: Size of the change of each element by an error of the instrument that nobody
            stated, of the size in `BUDGETED`.
    """

    names: tuple[str, ...]
    parts: Mapping[str, Float[np.ndarray, " element"]]
    tolerances: Mapping[str, float]
    unstated: Mapping[str, Float[np.ndarray, " element"]]

    @property
    def together(self) -> Float[np.ndarray, " element"]:
        """Relative standard errors of the elements, from all sources."""
        return np.sqrt(sum(part**2 for part in self.parts.values()))

    @property
    def largest(self) -> str:
        """A sentence on the error that nobody stated and that exceeds the standard errors most."""
        return largest(self.unstated, self.names, self.together)

    def _overview(self) -> Overview:
        shown = dict[str, Float[np.ndarray, " element"]]()
        for source, part in self.parts.items():
            size = self.tolerances.get(source)
            shown[source if size is None else f"{source} {_size(source, size)}"] = part
        shown["together"] = self.together
        for source, change in self.unstated.items():
            shown[f"if {source} {_size(source, BUDGETED[source])}"] = change
        rows = [(name, *(f"± {per_cent(of)}" for of in part)) for name, part in shown.items()]
        return Overview("Budget of the standard errors", rows, ("", *self.names))
