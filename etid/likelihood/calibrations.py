"""The likelihood of the calibrations of a driver.

It is that of `etid.likelihood.profile`. Calibrations that share an unloaded record are outputs of
one input, so that all of them tell of the same X; the others have inputs of their own. The
objective is that of all harmonics; gradient, curvature, covariance and score tests are condensed.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float, Int

from etid.likelihood.gains import FAULTS, Slopes
from etid.likelihood.noise import excess
from etid.likelihood.profile import (
    Condensed,
    Profile,
    Records,
    States,
    added,
)
from etid.likelihood.sandwich import Linear
from etid.likelihood.shared import Calibrated
from etid.likelihood.source import Source, Tolerances
from etid.likelihood.source_prior import DELAY_WIDTH, SourcePrior, delay_width
from etid.likelihood.transient import (
    DISTURBANCES,
    ENDS,
    are_seen,
    disturbed,
    ends,
    states_of_calibrations,
    width_of,
)
from etid.precision import array_function, namespace
from etid.results.driver import Calibration, HarmonicDriver
from etid.results.feed import SourceImpedance
from etid.results.instrument import Instrument
from etid.signals import modal
from etid.signals.harmonics import Spectrum, same_unloaded, signal_share
from etid.signals.hold import DELAY, NODES, images
from etid.signals.hold import added as added_by
from etid.signals.knots import Knots, knots
from etid.signals.transfer import (
    AnyArray,
    as_complex,
    combined,
    delayed,
    frequency_variable,
    power,
    reciprocal,
)
from etid.solvers.matrices import inverse_root

DENSE = 32  # density of the knots: the floor of the driver's valley is flat


class Near(NamedTuple):
    """The calibrations near a point.

    Attributes:
        q: The point.
        profiles: The likelihood of each unloaded record and its outputs at all harmonics.
        condensed: The same of all of them at the knots.
        slopes: The gains and their derivatives at the knots; their z is Z_th.
        states_by_q: Derivatives of what the states make of the outputs at the knots, but for those
            by the gains; None for whole periods.
    """

    q: Float[AnyArray, "*row q"]
    profiles: list[Profile]
    condensed: Condensed
    slopes: Slopes
    states_by_q: Complex[AnyArray, "*row q record knot"] | None = None

    @property
    def objective(self) -> Float[AnyArray, "*row"]:
        """½ Σ r² of the records, at all harmonics."""
        return added([of.objective for of in self.profiles])

    @property
    def jacobian(self) -> Float[AnyArray, "*row q part"]:
        """Transposed Jacobian of the condensed terms."""
        return self.rows(self.slopes)

    def rows(self, slopes: Slopes) -> Float[AnyArray, "*row q part"]:
        """Derivatives of the condensed terms at other gains."""
        return self.condensed.rows(slopes.by_q, self.states_by_q)

    def terms(
        self, q: Float[AnyArray, "*row q"], gains: Complex[AnyArray, "*row record knot"]
    ) -> Float[AnyArray, "*row part"]:
        """The condensed terms at q."""
        if self.states_by_q is None:
            return self.condensed.terms(gains)
        moved = (as_complex(q - self.q)[..., None, None] * self.states_by_q).sum(-3)
        return self.condensed.terms(gains, moved)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Calibrations:
    """The likelihood of the calibrations of a driver.

    In all methods `common` is the vector of the parameters of Z_th and of the delays of the
    calibrations [samples], followed by the errors of the instrument in their standard deviations:
    gain, crosstalk, capacitance, then the known resistor of each calibration and the capacitance
    across it, which those of equal value share. A gain g, a crosstalk κ, an error θ of the resistor
    R and a capacitance C across it change the gains to

        V_out / V_th = (1 + g) R' / (R' + Z_th) + κ,      R' = R (1 + θ) ‖ C.

    Attributes:
        source: Z_th identified from the calibrations.
        calibration: Resistors and delays of the calibrations.
        spectra: Harmonics of the calibrations.
        rate: Sampling rate of the calibrations [Hz].
        delay_width: Prior standard deviation of every trigger delay, of loads too [samples].
        instrument: Tolerances of the instrument; None if it has none.
    """

    source: SourceImpedance
    calibration: Calibration
    spectra: Spectrum
    rate: AnyArray
    delay_width: AnyArray = DELAY_WIDTH
    instrument: Instrument | None = None

    @classmethod
    def of(cls, driver: HarmonicDriver) -> "Calibrations":
        """The calibrations of an identified driver."""
        rate = namespace(driver.sample_rate).asarray(driver.sample_rate)
        width = DELAY if driver.spectra.held else delay_width(driver.instrument, rate)
        of = driver.source, driver.calibration, driver.spectra, rate, width
        return cls(*of, instrument=driver.instrument)

    @property
    def tolerances(self) -> Float[AnyArray, " error"]:
        """Standard deviation of each error of the instrument."""
        of, count = self.instrument, self.calibration.r_load.shape[0]
        return np.zeros(0) if of is None else of.deviations(count)

    def at(self, common: Float[AnyArray, " common"]) -> "Calibrations":
        """The same with these parameters as those that were identified."""
        errors = None if self.instrument is None else self.errors(common)
        delays = self.delays(common)
        of = dataclasses.replace(self.calibration, delay_samples=delays, errors=errors)
        return dataclasses.replace(self, source=self.source_of(common), calibration=of)

    @functools.cached_property
    def unknowns(self) -> int:
        """Number of parameters of Z_th and of delays, which the errors of the instrument follow."""
        return self._of_source + self.calibration.r_load.shape[0]

    @functools.cached_property
    def _of_source(self) -> int:
        delta = self.source.departure
        return self.source.modes + (0 if delta is None else delta.coefficients.shape[0])

    @functools.cached_property
    def _sections(self) -> int:
        return self.source.log_omega.shape[0]

    @property
    def terms(self) -> Float[AnyArray, ""]:
        """Number of real terms of the records."""
        return 2.0 * self.spectra.selected.sum()

    def parameters(self, common: Float[AnyArray, "*row common"]) -> AnyArray:
        """The parameters of Z_th among the common parameters (*row parameter)."""
        return common[..., : self._of_source]

    def delays(self, common: Float[AnyArray, "*row common"]) -> AnyArray:
        """The trigger delays of the calibrations [samples] (*row record)."""
        return common[..., self._of_source : self.unknowns]

    def errors(self, common: Float[AnyArray, "*row common"]) -> AnyArray:
        """The errors of the instrument among the common parameters (*row error)."""
        return common[..., self.unknowns :]

    def source_of(self, common: Float[AnyArray, " common"]) -> SourceImpedance:
        """Z_th with these common parameters."""
        return self.source.of_vector(self.parameters(common))

    @property
    def prior(self) -> SourcePrior:
        """The weak prior of Z_th."""
        return SourcePrior.of(self.source, self.rate, self.calibration.r_load.mean())

    @property
    def knots(self) -> Knots:
        """Knots of the harmonics."""
        return knots(self.spectra.x.shape[-1], DENSE)

    def records(self) -> list[Records]:
        """Each unloaded record with the outputs of all calibrations.

        An output is used with the first input that is its own unloaded record.
        """
        s = self.spectra
        xp, found = namespace(s.x), []
        free = np.ones(s.x.shape[0], bool)
        for number in range(s.x.shape[0]):
            x = s.x[number]
            mine = xp.stack([xp.asarray(same_unloaded(x, other)) for other in s.x]) & free
            free = free & ~mine
            if xp is np and not mine.any():
                continue
            of_x = s.frequency[number], x, s.variance_x[number]
            found.append(Records(*of_x, s.y, s.variance_y, s.selected & mine[:, None]))
        return found

    @array_function
    def profiles(
        self,
        common: Float[AnyArray, "*row common"],
        gains: Complex[AnyArray, "*row record bin"] | None = None,
    ) -> list[Profile]:
        """The likelihood of each unloaded record and its outputs; other gains may be given."""
        gains = self.gains(common) if gains is None else gains
        states = self.states(common, gains)
        return [Profile.of(of, gains, states) for of in self.records()]

    def states(
        self, common: Float[AnyArray, "*row common"], gains: Complex[AnyArray, "*row record bin"]
    ) -> States | None:
        """What the states at the ends of the records make; None for whole periods."""
        s = self.spectra
        if s.whole:
            return None
        rate, first = self.rate, s.frequency[0, 0]
        of_ends = disturbed(ends(s.x.shape[-1]) * (first / rate), first)
        decays = modal.decays(self.parameters(common), self._sections, s.frequency[0])
        decays = disturbed(decays * first, first)
        return states_of_calibrations(gains, decays, of_ends, width_of(s.y, s.selected))

    @property
    def unknown_states(self) -> Int[AnyArray, ""] | int:
        """Number of states of the records."""
        if self.spectra.whole:
            return 0
        first, count = self.spectra.frequency[0, 0], self.calibration.r_load.shape[0]
        added = namespace(first).where(are_seen(first), 2 * DISTURBANCES, 0)
        return count * (self.source.order + ENDS + added)

    def _states_by_q(
        self, common: Float[AnyArray, "*row common"], profiles: list[Profile], slopes: Slopes
    ) -> Complex[AnyArray, "*row common record knot"]:
        """∂/∂c of what the states make, at the same X − V."""
        xp, count = namespace(common), self.calibration.r_load.shape[0]
        p = added([of.states for of in profiles])
        each = self.source.order + DISTURBANCES  # the others are those of the outputs
        p = p[..., : count * each].reshape(*p.shape[:-1], count, each)[..., : self.source.order]
        f, first = self._frequency(self.knots)[0], self.spectra.frequency[0, 0]
        moved = modal.decays_by_parameters(self.parameters(common), self._sections, p * first, f)
        by_source = -xp.moveaxis(moved, -2, -3) * slopes.gains[..., None, :, :]
        rest = xp.zeros(
            (*by_source.shape[:-3], common.shape[-1] - self._of_source, *by_source.shape[-2:])
        )
        return xp.concatenate([by_source, as_complex(rest)], -3)

    @array_function
    def squares(self, profiles: list[Profile]) -> Float[AnyArray, "*row record bin"]:
        """|innovation|² of each calibration over its variance; 0 where a harmonic is not used."""
        xp = namespace(profiles[0].x)
        return added([xp.where(of.weight > 0, of.squares, 0.0) for of in profiles])

    def start(self) -> Float[AnyArray, " common"]:
        """The common parameters identified from the calibrations alone."""
        errors = self.calibration.errors
        if self.instrument is None or errors is None:
            errors = namespace(self.tolerances).zeros_like(self.tolerances)
        parts = self.source.vector(), self.calibration.delay_samples, errors
        return namespace(*parts).concatenate(parts)

    @array_function
    def gains(
        self, common: Float[AnyArray, "*row common"], every: Knots | None = None
    ) -> Complex[AnyArray, "*row record bin"]:
        """Gains R e^(−jωτ) / (R + Z_th) with the known resistors, at all harmonics or at knots."""
        f = self._frequency(every)
        turn, gains = self._turn(common, f), self._gains(common, f)
        if self.spectra.held:
            gains = gains + added_by(self._gains(common, self._nodes), self._images(every))
        return gains * turn

    def _frequency(self, every: Knots | None) -> Float[AnyArray, "record bin"]:
        of = self.spectra.frequency
        return of if every is None else every.at(of)

    @property
    def _nodes(self) -> Float[AnyArray, "record node"]:
        """Frequencies beyond the bins whose gains a hold needs [Hz]."""
        at = NODES * self.rate
        return namespace(at).broadcast_to(at, (self.spectra.x.shape[0], NODES.size))

    @functools.cached_property
    def _of_every(self) -> Complex[AnyArray, "part bin"]:
        return images(self.spectra.frequency[0] / self.rate)

    def _images(self, every: Knots | None) -> Complex[AnyArray, "part bin"]:
        return self._of_every if every is None else self._of_every[:, every.index]

    def _turn(
        self, common: Float[AnyArray, "*row common"], f: Float[AnyArray, "record bin"]
    ) -> Complex[AnyArray, "*row record bin"]:
        """e^(−jωτ) of each calibration."""
        late = self.delays(common)
        one = as_complex(namespace(late, f).ones_like(f + late[..., None]))
        return delayed(one, f, late, self.rate)

    def _gains(
        self, common: Float[AnyArray, "*row common"], f: Float[AnyArray, "record bin"]
    ) -> Complex[AnyArray, "*row record bin"]:
        """The gains without delays."""
        z_th = self.source.impedance(self.parameters(common), f)
        return self._without_delays(common, f, z_th)[0]

    def _without_delays(
        self,
        common: Float[AnyArray, "*row common"],
        f: Float[AnyArray, "record bin"],
        z_th: Complex[AnyArray, "*row record bin"],
    ) -> tuple[AnyArray, AnyArray, AnyArray | None]:
        """The gains, and their derivatives with respect to Z_th and to the errors."""
        xp, r_load = namespace(common, z_th), self.calibration.r_load
        known = resistance = as_complex(r_load)[:, None]
        # Records with equal values are of one resistor: they have the errors of the first of them.
        first = (r_load[:, None] == r_load[None]).argmax(1)
        off, s = as_complex(self.tolerances * self.errors(common)), frequency_variable(f)
        right = known  # R (1 + θ)
        if self.instrument is not None:
            of_each = off[..., FAULTS:].reshape(*off.shape[:-1], 2, -1)[..., first, None]
            right = known * (1 + of_each[..., 0, :, :])
            resistance = right * reciprocal(1 + s * of_each[..., 1, :, :] * right)
        loop = reciprocal(resistance + z_th)
        gains = resistance * loop
        by_z = -gains * loop
        if self.instrument is None:
            return gains, by_z, None
        gain, crosstalk = off[..., 0, None, None], off[..., 1, None, None]
        turned = gains * (resistance + z_th) * reciprocal(resistance)
        of_loads = xp.stack([gains, turned, xp.zeros_like(gains)], -3)  # nothing is across a skin
        # ∂R'/∂θ = R R'² / (R (1 + θ))²,      ∂R'/∂C = −s R'²
        by_r = -(1 + gain) * by_z * z_th * resistance
        each = xp.stack([by_r * known * reciprocal(right * right), -s * by_r], -3)
        alone = xp.eye(known.shape[0])[first].T[:, :, None]
        each = (alone * each[..., None, :, :]).reshape(*by_z.shape[:-2], -1, *by_z.shape[-2:])
        by_error = xp.concatenate([of_loads, each], -3)
        by_error = by_error * self.tolerances[:, None, None]
        return (1 + gain) * gains + crosstalk * turned, (1 + gain) * by_z, by_error

    @array_function
    def slopes(self, common: Float[AnyArray, "*row common"], every: Knots | None = None) -> Slopes:
        """The gains and their derivatives, at all harmonics or at knots."""
        f, xp = self._frequency(every), namespace(common, self.spectra.x)
        z_th, gains, by_z, by_q = self._slopes(common, f)
        turn = self._turn(common, f)
        if self.spectra.held:
            _, of_nodes, _, by_nodes = self._slopes(common, self._nodes)
            of = self._images(every)
            gains, by_q = gains + added_by(of_nodes, of), by_q + added_by(by_nodes, of)
        gains, by_z, by_q = gains * turn, by_z * turn, by_q * turn[..., None, :, :]
        by_delay = (-gains * frequency_variable(f / self.rate))[..., None, :, :]
        by_delay = np.eye(f.shape[0])[:, :, None] * by_delay
        before, after = by_q[..., : self._of_source, :, :], by_q[..., self._of_source :, :, :]
        return Slopes(z_th, gains, by_z, by_z, xp.concatenate([before, by_delay, after], -3))

    def _slopes(
        self, common: Float[AnyArray, "*row common"], f: Float[AnyArray, "record bin"]
    ) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Z_th, the gains without delays, their derivatives by Z_th, and by all but the delays."""
        xp = namespace(common, self.spectra.x)
        z_th, by_source = self.source.slopes(self.parameters(common), f)
        gains, by_z, by_error = self._without_delays(common, f, z_th)
        rows = [by_source * by_z[..., None, :, :]]
        rows += [] if by_error is None else [by_error]
        return z_th, gains, by_z, xp.concatenate(rows, -3)

    @array_function
    def around(
        self,
        common: Float[AnyArray, " common"],
        directions: Float[AnyArray, "common z"],
        frequency: Float[AnyArray, " bin"],
    ) -> Source:
        """Z_th with these common parameters, for loads; its z are steps along `directions`."""
        xp, source = namespace(common, frequency), self.source_of(common)
        z_th, by_source = source.with_slopes(frequency)
        resistance = self.calibration.r_load.mean()
        loaded = z_th + as_complex(resistance)
        by_source = by_source * reciprocal(loaded)
        zero, tolerances = xp.zeros(directions.shape[1]), None
        if self.instrument is not None:
            sizes = self.tolerances[:FAULTS]
            by_z = self.errors(directions.T)[:, :FAULTS] * sizes
            faults = sizes * self.errors(common)[:FAULTS]
            tolerances = Tolerances(faults, by_z, None, xp.zeros(()), zero)
        return Source(
            frequency=frequency,
            loaded=loaded,
            w_slope=-by_source[source.log_omegas].sum(0),
            by_z=combined(directions[: by_source.shape[0]].T, by_source),
            resistance=resistance,
            mean=zero,
            cov=xp.diag(zero),
            delay_width=xp.asarray(self.delay_width),
            tolerances=tolerances,
            decays=modal.decays(source.vector()[: source.modes], self._sections, frequency),
        )

    @array_function
    def calibrated(
        self, common: Float[AnyArray, " common"], directions: Float[AnyArray, "common z"]
    ) -> Calibrated:
        """The calibrations, whose unloaded record a load may have; for z see `around`."""
        found, s = self.slopes(common), self.spectra
        by_z = combined(directions.T, found.by_q.reshape(common.shape[0], -1))
        by_z = by_z.reshape(-1, *found.gains.shape)
        y = self.without_states(self.profiles(common, found.gains))
        return Calibrated(s.x, y, s.variance_y, s.selected, found.gains, by_z)

    def without_states(self, profiles: list[Profile]) -> Complex[AnyArray, "*row record bin"]:
        """The outputs without what the states make of them."""
        made = [of.made for of in profiles if of.made is not None]
        return self.spectra.y - added(made) if made else self.spectra.y

    @array_function
    def near(self, common: Float[AnyArray, "*row common"]) -> Near:
        """The calibrations near these common parameters."""
        every, gains = self.knots, self.gains(common)
        profiles, slopes = self.profiles(common, gains), self.slopes(common, every)
        states, by_q = self.states(common, gains), None
        if states is not None:
            by_q = self._states_by_q(common, profiles, slopes)
        condensed = Condensed.of(profiles, every, states)
        return Near(common, profiles, condensed, slopes, by_q)

    @array_function
    def linear(self, near: Near) -> Linear:
        """The condensed terms, linear in the common parameters, at one point."""
        xp, shares = namespace(near.q), []
        for records, of in zip(self.records(), near.profiles, strict=True):
            told = xp.where(records.used, power(of.gains) / records.variance_y, 0.0)
            variance = 1 / (1 / records.variance_x + told.sum(0))  # of X̂
            shares.append(xp.where(of.weight > 0, signal_share(of.x, variance), 0.0))
        values = xp.stack([added(shares), self.noise(near.profiles)])
        means = near.condensed.means(near.profiles, self.knots, values)
        return Linear(near.jacobian, means[0], means[1], priors=self.weak(near.q)[1])

    @array_function
    def noise(self, profiles: list[Profile]) -> Float[AnyArray, "*row record bin"]:
        """`excess` of the innovations of each calibration."""
        return excess(self.squares(profiles), self.spectra.selected)

    def following(self, linear: Linear) -> Float[AnyArray, "known error"]:
        """Changes of Z_th and of the delays at their minimum by the errors of the instrument."""
        curvature, known = linear.curvature().expected, self.unknowns
        root = inverse_root(curvature[:known, :known])
        return -root @ (root.T @ curvature[:known, known:])

    def gradient(self, near: Near, linear: Linear) -> Float[AnyArray, " common"]:
        """Gradient of the condensed terms and of the weak priors."""
        return linear.jacobian @ near.condensed.part + self.rest(near.q)

    def rest(self, common: Float[AnyArray, " common"]) -> Float[AnyArray, " common"]:
        """Gradient of the weak priors."""
        terms, rows = self.weak(common)
        return rows @ terms

    @array_function
    def weak(
        self, common: Float[AnyArray, "*row common"]
    ) -> tuple[Float[AnyArray, "*row term"], Float[AnyArray, "*row common term"]]:
        """The terms of the weak priors and their derivatives."""
        xp, kept, size = namespace(common), self.source.modes, common.shape[-1]
        terms, by_source = self.prior.with_slopes(common[..., :kept])
        none = xp.zeros((*common.shape[:-1], size - kept, terms.shape[-1]))
        ends = self._of_source - kept, self.unknowns - kept
        first, delays, errors = np.split(np.ones(size - kept), ends)
        others = xp.concatenate([first, delays / self.delay_width, errors])
        rows = np.eye(size)[:, kept:] * others + xp.zeros((*common.shape, 1))
        terms = xp.concatenate([terms, common[..., kept:] * others], -1)
        return terms, xp.concatenate([xp.concatenate([by_source, none], -2), rows], -1)

    @array_function
    def strain(self, common: Float[AnyArray, " common"]) -> Float[AnyArray, ""]:
        """Increase of the Σ r² of the calibrations over its value at their own minimum.

        r is in standard deviations of the noise of the calibrations. If loads and calibrations
        agree, the increase is about the number of common parameters.
        """
        start, at = self.start(), []
        for c in (common, start):
            profiles = self.profiles(c)
            at.append((2 * self.squares(profiles), self.weak(c)[0] ** 2, self.noise(profiles)))
        (squares, weak, _), (before, weak_before, noise) = at
        return ((squares - before) / noise).sum() + (weak - weak_before).sum()
