"""What a fit was made from, and what can be done with it.

Pictures, draws and profiles belong to higher layers. A fit has them as methods, which import them
when they are called.
"""

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import jax
import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import Circuit
from etid.printing import Overview, Overviewed, rounded, several
from etid.recordings.recording import Recording
from etid.results.driver import Driver
from etid.results.instrument import Budget
from etid.results.posterior import Posterior, Profile

if TYPE_CHECKING:
    import matplotlib.axes

    from etid.results.residual import Residual

Shown = Literal["pulse", "impedance", "residual"]
AnyAxes = np.ndarray | Sequence["matplotlib.axes.Axes"] | None
Size = tuple[float, float] | None  # width and height [inch]
_Kind = TypeVar("_Kind", bound="HasSource")


def _of_higher_layer(module: str, name: str) -> Callable[..., Any]:
    return getattr(importlib.import_module(module), name)


def drawn(x: Any, **options: Any) -> Any:
    """`etid.plot` of an object."""
    return _of_higher_layer("etid.plotting", "plot")(x, **options)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MeasuredImpedance(Overviewed):
    """An impedance as an instrument measured it.

    Attributes:
        frequency: Frequencies [Hz].
        z: Impedance [Ω].
        stderr: Standard errors of the real and of the imaginary part [Ω]; None if not known.
    """

    frequency: Float[np.ndarray, " frequency"]
    z: Complex[np.ndarray, " frequency"]
    stderr: Float[np.ndarray, " frequency"] | None

    def _overview(self) -> Overview:
        errors = [""] * self.z.size
        if self.stderr is not None:
            errors = [f"± {rounded(one / 1e3)}" for one in self.stderr]
        rows = [
            (rounded(f, 4), f"{z.real / 1e3:.5g}", f"{z.imag / 1e3:.5g}", error)
            for f, z, error in zip(self.frequency, self.z, errors, strict=True)
        ]
        heads = ("frequency [Hz]", "Re Z [kΩ]", "Im Z [kΩ]", "of each part")
        return Overview(f"Impedance at {several(self.z.size, 'frequency')}", rows, heads)

    def plot(self, *, axes: AnyAxes = None, size: Size = None, title: str | None = "") -> Any:
        """Draw the points; the same as `etid.plot(spectrum)`, with its arguments."""
        return drawn(self, axes=axes, size=size, title=title)


class HasSource(Generic[Circuit]):
    """A result that may know its recording and its driver, or its measured impedance.

    They are no fields, so JAX does not see them. A result that JAX or `dataclasses.replace` makes
    from another one has none.
    """

    __slots__ = ("_data",)  # equinox would make an entry of `__dict__` part of the tree structure

    @property
    def recording(self) -> Recording | None:
        """The recording; None if it is not known."""
        known = getattr(self, "_data", (None, None))[0]
        return known if isinstance(known, Recording) else None

    @property
    def described(self) -> Mapping[str, Any]:
        """The path, the labels and the numbers that describe the recording, as far as known."""
        known = getattr(self, "_data", (None, None))[0]
        if isinstance(known, Recording):
            return vars(known.metadata)
        return known if isinstance(known, Mapping) else {}

    @property
    def measured(self) -> MeasuredImpedance | None:
        """The impedance of `identify_impedance`; None for all other fits."""
        known = getattr(self, "_data", (None, None))[0]
        if isinstance(known, Mapping):
            known = known.get("measured")
        return known if isinstance(known, MeasuredImpedance) else None

    @property
    def driver(self) -> Driver | None:
        """The driver of the recording; None if there is none, or if it is not known."""
        return getattr(self, "_data", (None, None))[1]

    @property
    def of_impedance(self) -> bool:
        """Whether it is a fit of a measured impedance, known or not."""
        of: Any = self
        return of.method.partition("(")[0] == "impedance"

    def without_source(self, call: str) -> ValueError:
        """The error of a call such as `fit.residual` that needs what the result was made from."""
        if self.of_impedance:
            return ValueError(
                "this fit is of a file, which holds no impedances; identify the impedance again, "
                f"and call {call} of that fit"
            )
        return ValueError(
            "this fit does not know its recording and its driver; pass both, as in "
            f"{call}(recording, driver)"
        )

    def source_or_own(
        self, recording: Recording | None, driver: Driver | None
    ) -> tuple[Recording | None, Driver | None]:
        """The arguments if there is a recording among them, else what the result knows."""
        return (self.recording, self.driver) if recording is None else (recording, driver)

    def plot(
        self,
        recording: Recording | None = None,
        driver: Driver | None = None,
        *,
        show: Shown = "pulse",
        axes: AnyAxes = None,
        size: Size = None,
        title: str | None = "",
    ) -> np.ndarray:
        """Draw the fit; the same as `etid.plot(fit)`.

        Args:
            recording: Its recording. `identify_skin` tells it to the fit; one of several fits, as
                in `fits[0]`, does not know it.
            driver: Its driver, if `recording` is given.
            show: `"pulse"`, `"impedance"`, which is the same for a fit of `identify_impedance`, or
                `"residual"`, the picture of `residual`.
            axes: As in `etid.plot`.
            size: As in `etid.plot`.
            title: As in `etid.plot`; None leaves the titles out.

        Returns:
            The axes of the picture, (axis,), for further changes.

        Raises:
            TypeError: The recording is not known.
            ValueError: The fit has no `residual`.
        """
        drawn = _of_higher_layer("etid.plotting", "plot")
        return drawn(self, recording, driver, show=show, axes=axes, size=size, title=title)

    def residual(
        self, recording: Recording | None = None, driver: Driver | None = None
    ) -> "Residual":
        """What the fit leaves of its recording, and whether it is noise.

        The elements are those of the fit; Z_th and the trigger delay follow the recording within
        what is known of them, as in the fit.

        Args:
            recording: As in `plot`; another one of the same load tests the fit.
            driver: As in `plot`.

        Returns:
            The residual in time and by frequency, and its correlations; `print` says whether
            something is left. Of a fit of `identify_impedance` it is that of Z by frequency.

        Raises:
            ValueError: The recording is not known or the fit does not allow it, the fit is a batch
                or has no elements, or the driver has no continuous source impedance.
        """
        return _of_higher_layer("etid.identify.residual", "residual")(self, recording, driver)

    def report(self) -> str:
        """The fit as text: more than `print` shows, as MATLAB's `present`.

        Returns:
            The circuit with its formula; elements, standard errors, 95 % intervals and correlation
            coefficients; quality, method and verdict with its message; the numbers of data and
            elements with AIC and BIC; path and labels of the recording.

        Raises:
            ValueError: This is a batch.
        """
        return _of_higher_layer("etid.results.presented", "report")(self)

    def posterior(
        self,
        recording: Recording | None = None,
        driver: Driver | None = None,
        *,
        draws: int = 1000,
        seed: int = 0,
    ) -> Posterior[Circuit]:
        """The distribution of the elements, by importance sampling around the fit.

        The prior is uniform in the logarithms of the elements, times the priors of the fit. The
        trigger delay and the uncertain part of Z_th are drawn too. If the recording does not
        exclude that an element is 0, the draws cover the surroundings of the fit.

        Args:
            recording: As in `plot`.
            driver: As in `plot`.
            draws: Number of draws. 1000 take a tenth of a second; `effective` says what they are
                worth.
            seed: Seed of the draws.

        Returns:
            Weighted draws, with intervals.

        Raises:
            ValueError: The recording is not known, or the fit is a batch, or comes from another
                method than maximum likelihood, or its data do not determine all elements.
        """
        drawn = _of_higher_layer("etid.identify.posterior", "posterior")
        return drawn(self, recording, driver, draws=draws, seed=seed)

    def profile(
        self, name: str, recording: Recording | None = None, driver: Driver | None = None
    ) -> Profile:
        """The deviance as a function of one element; all other parameters are fitted again.

        Args:
            name: The element, as in `"c_p"`.
            recording: As in `plot`.
            driver: As in `plot`.

        Returns:
            The profile, with an interval.

        Raises:
            ValueError: The circuit has no such element, or as in `posterior`.
        """
        return _of_higher_layer("etid.identify.profile", "profile")(self, recording, driver, name)

    def budget(self, recording: Recording | None = None, driver: Driver | None = None) -> Budget:
        """What each source of error adds to the standard errors: noise, driver, instrument.

        It also shows what errors of the instrument would do that nobody stated, as in
        `etid.Instrument`. A measured current has no driver, and none of these errors.

        Args:
            recording: As in `plot`.
            driver: As in `plot`.

        Returns:
            The budget; `print` shows a table.

        Raises:
            ValueError: As in `posterior`, or the driver has no harmonics of its calibrations, or
                a joint fit was not given an instrument.
        """
        return _of_higher_layer("etid.identify.posterior", "budget")(self, recording, driver)


def with_data(
    result: _Kind,
    source: Recording | MeasuredImpedance | Mapping[str, Any],
    driver: Driver | None = None,
) -> _Kind:
    """The same result, which knows its recording and its driver, or its measured impedance.

    A result of a table knows what describes its recording.
    """
    known = jax.tree.map(lambda leaf: leaf, result)  # another object
    object.__setattr__(known, "_data", (source, driver))
    return known
