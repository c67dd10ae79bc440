"""The likelihood of plain arrays, for models and samplers of others.

It is the one that `identify_skin` maximises: gains of the load and of Z_th, the unknown unloaded
voltage profiled out (`etid.likelihood.profile`). Its parameters q are

    ln of each element,   the trigger delay [samples],   z,

with a second delay if the current was measured besides.

z is what the calibrations leave open of Z_th, in their standard deviations; a priori it is normal.
"""

import math

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimator import serving
from etid.estimators.lanes import Harmonics, HarmonicsWithCurrent, unstacked
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.rows import (
    calibrated,
    fit_lane,
    fit_rows,
    load_of,
    source_of,
)
from etid.estimators.maximum_likelihood.verdict import ACCEPT
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import require
from etid.identify.options import candidates_of
from etid.identify.samples import given
from etid.likelihood.gains import Gains
from etid.likelihood.load import Load, Near
from etid.likelihood.own_prior import OwnPrior
from etid.likelihood.starts import starts
from etid.precision import Module, array_function, in_float64, is_traced, namespace
from etid.printing import Overview, Overviewed, several, significant
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import MEASURED_CURRENT, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.fits import concatenated
from etid.signals.harmonics import real_parts
from etid.signals.transfer import AnyArray, as_complex


class Likelihood(Overviewed, Module):
    """The likelihood of one recording, or of several with equal rates along leading axes.

    `Likelihood.of` makes it from arrays. All methods are functions of arrays: JAX can trace,
    differentiate and map them, and with arrays of NumPy nothing is compiled.

    The parameters q are the logarithms of the elements, the trigger delay [samples], and z, what
    the calibrations leave open of Z_th [standard deviations]; `names` lists them.

    Attributes:
        lane: Harmonics of the records, or bins of records of any length, with their noise.
        feed: The driver, or a measured current.
        known: What the calibrations tell of Z_th at these frequencies.
        load: All that the likelihood needs.
    """

    lane: Harmonics
    feed: ContinuousDriver | MeasuredCurrent
    known: GivenDriver
    load: Load

    @classmethod
    @in_float64
    @array_function
    def of(
        cls,
        v_th: Float[AnyArray, "*row time"],
        v_out: Float[AnyArray, "*row time"],
        driver: Driver | None = None,
        circuit: AbstractCircuit | str | None = None,
        *,
        sample_rate: float,
        pulse_rate: float,
        current: Float[AnyArray, "*row time"] | None = None,
        resolution: float = 0.0,
        prior: OwnPrior | None = None,
    ) -> "Likelihood":
        """The likelihood of bare arrays, whose noise is measured; there is no pre-flight.

        Args:
            v_th: Unloaded voltage [V], or the current [A] through the load without a driver.
            v_out: Loaded voltage [V].
            driver: Identified driver, by maximum likelihood; none if the current was measured.
            circuit: As in `identify_skin`, without `"auto"`.
            sample_rate: Samples per second [Hz].
            pulse_rate: Pulses per second [Hz]. Several whole periods are harmonics, any other
                records bins.
            current: Current [A] through the load, if it was measured besides V_th; for several
                whole periods.
            resolution: Step of the converter [V] at the terminal; 0 if not known.
            prior: What is known of the elements: a function of a circuit, whose elements are
                numbers, that returns terms r in standard deviations, −ln p = ½ Σ r² + constant.
                Correlated normals of the logarithms are r = L⁻¹ (ln e − μ) with L Lᵀ their
                covariance. JAX traces it where it traces the likelihood; in NumPy its slopes are
                differences.

        Raises:
            ValueError: The driver or the circuit cannot be used, a value is not finite, or the
                records with a current hold no two whole periods.
        """
        if driver is None:
            feed = MEASURED_CURRENT
        else:
            require("driver", driver, Driver)
            feed = serving(driver, ContinuousDriver, str(MAXIMUM_LIKELIHOOD))
        structure, *others = candidates_of(circuit)
        if others:
            raise ValueError("a likelihood is of one circuit, not of 'auto'; fit each, and compare")
        if not (0 < 2 * pulse_rate < sample_rate < math.inf and resolution >= 0):
            raise ValueError(
                f"sample_rate is {sample_rate:g} Hz, pulse_rate {pulse_rate:g} Hz, resolution "
                f"{resolution:g} V; pulses must be slower than samples, and none negative"
            )
        shapes = {np.shape(of) for of in (v_th, v_out, v_out if current is None else current)}
        if len(shapes) > 1:
            raise ValueError(
                f"the records have the shapes {', '.join(map(str, sorted(shapes)))}; they must "
                "have one, (…, time)"
            )
        for name, one in {"v_th": v_th, "v_out": v_out, "current": current}.items():
            if one is None or is_traced(one) or (lost := np.sum(~np.isfinite(one))) == 0:
                continue
            raise ValueError(
                f"{name} has {several(int(lost), 'value')} that {'is' if lost == 1 else 'are'} not "
                "finite; cut the records to samples that are, or give a Recording to identify_skin"
            )
        of = feed, MAXIMUM_LIKELIHOOD, sample_rate, pulse_rate
        lane, known = given(v_th, v_out, *of, resolution)
        assert isinstance(lane, Harmonics)  # as all lanes of maximum likelihood are
        if current is not None:
            if driver is None or not lane.periodic:
                raise ValueError(
                    "a current beside V_th needs a driver and two whole pulse periods; without a "
                    "driver, pass the current in place of V_th"
                )
            by_current, _ = given(v_th, current, *of, 0.0)
            assert isinstance(by_current, Harmonics)
            lane = HarmonicsWithCurrent.of_both(lane, by_current)
        told = None if prior is None else ElementPrior.by(prior, structure)
        load = load_of(lane, source_of(known), structure, told, calibrated(known))
        return cls(lane, feed, known, load)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters q."""
        gains = self.load.gains
        count = self.load.centre.shape[-1] - gains.owned
        delays = ("delay", "current_delay")[: gains.outputs.count]
        return (*gains.circuit.names(), *delays, *(f"z_{i}" for i in range(count)))

    def _overview(self) -> Overview:
        lane, kind = self.lane, type(self.load.gains.circuit).__name__
        feed = (
            f"a driver of order {self.feed.order}" if isinstance(self.feed, Driver) else "a current"
        )
        frequency, selected = (
            np.reshape(of, (-1, of.shape[-1]))[0] for of in (lane.frequency, lane.selected)
        )
        used = frequency[selected]
        count = several(int(np.prod(lane.x.shape[:-1])), "recording")
        what = "harmonic" if lane.periodic else "bin"
        band = f"{several(used.size, what)} up to {significant(float(used.max()) / 1e3, 3)} kHz"
        said = f"Parameters: {', '.join(self.names)}."
        return Overview(f"Likelihood of {kind} fed by {feed}: {count}, {band}", notes=[said])

    @in_float64
    @array_function
    def start(self) -> Float[AnyArray, "*row q"]:
        """Parameters to begin with: Steiglitz-McBride on the harmonics, without bias by noise."""
        return starts(self.load)[0]

    @in_float64
    @array_function
    def q(
        self,
        circuit: AbstractCircuit,
        delay: Float[AnyArray, "*row"] | float = 0.0,
        z: Float[AnyArray, "*row z"] | float = 0.0,
        current_delay: Float[AnyArray, "*row"] | float = 0.0,
    ) -> Float[AnyArray, "*row q"]:
        """The parameters of a circuit.

        Args:
            circuit: Circuit of the kind of the likelihood.
            delay: Trigger delay of V_out [s].
            z: Deviations of Z_th from what the calibrations say [standard deviations].
            current_delay: Trigger delay of a current beside V_th [s].

        Returns:
            The parameters.
        """
        gains, centre = self.load.gains, self.load.centre
        logs, mean = circuit.log_values(), centre[gains.owned :]
        xp, delays = namespace(logs, delay, z), (delay, current_delay)[: gains.outputs.count]
        late = [xp.asarray(of * gains.sample_rate, float)[..., None] for of in delays]
        parts = logs, *late, mean + xp.asarray(z, float)
        rows = np.broadcast_shapes(*(of.shape[:-1] for of in parts))
        return xp.concatenate([xp.broadcast_to(of, (*rows, of.shape[-1])) for of in parts], -1)

    @in_float64
    @array_function
    def circuit(self, q: Float[AnyArray, "*row q"]) -> AbstractCircuit:
        """The circuit of some parameters."""
        xp, logs = namespace(q), self.load.gains.split(q)[0]
        return self.load.gains.circuit.of_fit(xp.moveaxis(xp.exp(logs), -1, 0))

    @in_float64
    @array_function
    def residual(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row term"]:
        """Terms r in standard deviations, the priors of delay, z and elements among them.

        −log p = ½ Σ r² + constant. Solvers of least squares minimise it (optimistix, jaxopt).
        """
        profile, states = self.load.profile(q, self._at_knots)
        xp = namespace(q, profile.x)
        # 2/σ² is 0 where a harmonic is not used; its root has no derivative there.
        used = profile.weight > 0
        scale = xp.where(used, xp.sqrt(xp.where(used, profile.weight, 1.0)), 0.0)
        terms = real_parts(profile.innovations * as_complex(scale))
        every = [terms.reshape(*terms.shape[:-2], -1), self.load.rest(q)]
        if states is not None and profile.states is not None:
            every.append(profile.states / states.width)
        return xp.concatenate(every, -1)

    @in_float64
    @array_function
    def log_prob(
        self,
        circuit: AbstractCircuit,
        delay: Float[AnyArray, "*row"] | float = 0.0,
        z: Float[AnyArray, "*row z"] | float = 0.0,
        current_delay: Float[AnyArray, "*row"] | float = 0.0,
    ) -> Float[AnyArray, "*row"]:
        """Logarithm of the likelihood and of the priors, up to a constant.

        Recordings of one driver share z; add the prior of z once then.

        Args:
            circuit: As in `q`.
            delay: As in `q`.
            z: As in `q`.
            current_delay: As in `q`.
        """
        return -self.load.objective(self.q(circuit, delay, z, current_delay))

    @in_float64
    @array_function
    def information(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row q q"]:
        """Fisher information about the parameters q, with that of the priors.

        The elements are in logarithms, so that their errors are relative. Its inverse is the
        Cramer-Rao bound of the covariance.
        """
        jacobian = Near.of(self.load, self._at_knots, q).jacobian
        return jacobian @ jacobian.swapaxes(-1, -2) + self.load.told(q).matrix

    @in_float64
    def fit(self) -> Fit:
        """The fit of `identify_skin`, with elements, covariance and verdict.

        JAX can trace it, map it over recordings, and differentiate elements and delays.
        """
        own, circuit, method = self.load.own, self.load.gains.circuit, str(MAXIMUM_LIKELIHOOD)
        prior = None
        if own is not None:
            prior = ElementPrior.by(own, circuit)
            method = f"{method} with the prior {getattr(own, '__qualname__', own)}"
        of = self.feed, self.known, circuit, method, prior, (), ACCEPT
        if is_traced(self) or self.lane.x.ndim == 1:
            return fit_lane(self.lane, *of)
        return concatenated(fit_rows(unstacked(self.lane), *of))

    @property
    def _at_knots(self) -> Gains:
        return self.load.gains.at(self.load.knots.index)
