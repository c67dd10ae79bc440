"""Control of the stimulation: the amplitude of the next pulse at every electrode.

    controller = etid.display.Controller.of(tracker, probability=0.999)
    command = controller.command(state, charge=100e-9)
    ... give the pulses with command.amplitude, record v_out ...
    state = tracker.update(state, v_out, command.amplitude)

All amplitudes are primary amplitudes relative to that of the tracker's unloaded record; the driver
is linear. For a wanted charge Q the amplitude is Q / q, where q is the charge per unit of amplitude
that the elements and Z_th predict (`etid.display.current`). The limits are applied in this order:

| limit | amplitude at most |
|---|---|
| `peak` | cap / (p + k σ_p), the cap on the current |
| `charge` | cap / r (q + k σ_q), the cap on the charge per phase |
| `confirmed` | the larger of a_s, and 1.25 times the amplitude that a pulse has confirmed |
| `guard` | cap / p_s, with the peak current p_s through a short circuit |
| `voltage` | cap / largest unloaded voltage |
| `slew` | amplitude before + slew |

A stimulator of a few bits gives whole steps. What is wanted is rounded to the nearest step, and
limits are rounded down.

k is the quantile of the normal distribution for the stated probability; σ contains the noise of the
pulses, the random walk of the skin until the next pulse, and the error of the calibration. A pulse
after a pause lacks the tail of the pulse before, whose current has the other sign. A transformer
passes no direct current, and the tail decays, so that the charge is at most r = T / (T − phase) of
that in the steady state.

**Limits that hold whatever the estimate says** are `guard`, `voltage` and `slew`. The skin may
become wet between two pulses, and no controller can know this before the pulse. Through a passive
load of resistors and capacitors that follow a series resistor, the largest current is that through
a short circuit. An amplitude below the guard therefore keeps the current below its cap even at the
first pulse after a change. The *charge* of this pulse is at most `Command.worst`, that through a
short circuit.

**The cap on the charge** holds at all other pulses, also if records are wrong. With a_s, a short
circuit carries 1/1.25 of the cap. An electrode gets more only after pulses that fitted their
prediction, 1.25 times as much at each. The first raise is still safe with a short circuit. It
shows whether the record follows the amplitude of its own electrode: another channel does not.

**An electrode whose verdict is not good** gets the fallback amplitude, which is at most a_s, or
less if a limit says so. Until it starts again, it gets no more than at the last pulse. The command
says `fallback` for it, and its charge is NaN. **An electrode whose last window was an old one**
(`etid.display.repeats`) gets 0 until a window is new, because nothing that it is given can be
seen. The command says `repeated`.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.display.current import CurrentModel
from etid.display.state import ElectrodeState, TrackerState
from etid.display.tracker import Tracker, for_each
from etid.estimators.unknowns import LoadUnknowns
from etid.identify.arguments import number_of, require
from etid.precision import Kept, in_float64
from etid.printing import Overview, Overviewed, number, rounded, several
from etid.results.verdicts import counts, usable
from etid.solvers.matrices import inverse_of_few

REASONS = np.array(
    ["wanted", "peak", "charge", "confirmed", "guard", "voltage", "slew", "fallback", "repeated"]
)
FALLBACK, REPEATED = len(REASONS) - 2, len(REASONS) - 1
LARGEST_CAP = 0.1  # [A] stimulators of nerves and skin stay below it
RAISE = 1.25  # of an amplitude that a pulse has confirmed, to the next pulse


@dataclasses.dataclass(frozen=True)
class Command(Overviewed):
    """What to give at the next pulse.

    Attributes:
        amplitude: Primary amplitude at each electrode, relative to that of the unloaded record.
        charge: Expected charge per phase [C]; NaN where there is no good estimate.
        charge_stderr: Its standard error [C].
        peak: Expected largest current [A]; NaN where there is no good estimate.
        worst: Charge if the load has become a short circuit since the last pulse [C].
        reason: What determined the amplitude: `wanted`, the name of a limit, `fallback`, or
            `repeated`.
    """

    amplitude: Float[np.ndarray, " lane"]
    charge: Float[np.ndarray, " lane"]
    charge_stderr: Float[np.ndarray, " lane"]
    peak: Float[np.ndarray, " lane"]
    worst: Float[np.ndarray, " lane"]
    reason: np.ndarray

    def _overview(self) -> Overview:
        found = ", ".join(f"{number} {name}" for name, number in counts(self.reason).items())
        rows = [
            (
                str(at),
                str(reason),
                f"{amplitude:.3f}",
                number(1e9 * charge, ".1f"),
                number(1e3 * peak, ".2f"),
            )
            for at, (reason, amplitude, charge, peak) in enumerate(
                zip(self.reason, self.amplitude, self.charge, self.peak, strict=True)
            )
        ]
        heads = ("electrode", "reason", "amplitude", "charge / nC", "peak / mA")
        return Overview(
            f"Command for {several(self.reason.size, 'electrode')}: {found}", rows, heads
        )


class Limits(NamedTuple):
    """Limits of the amplitude, and the fallback.

    Attributes:
        current_cap: Largest current of either sign [A].
        charge_cap: Largest charge per phase [C].
        quantile: k, in standard errors.
        short: Amplitude without a confirmed estimate; `RAISE` times as much carries `charge_cap`
            through a short circuit.
        guard: Amplitude at which a short circuit carries `current_cap`.
        ceiling: Amplitude at which the unloaded voltage reaches its cap.
        slew: Largest increase of the amplitude from pulse to pulse.
        fallback: Amplitude for an electrode whose verdict is not good.
        step: Step of the amplitudes that the stimulator can give; 0 for any amplitude.
    """

    current_cap: Float[Array, ""]
    charge_cap: Float[Array, ""]
    quantile: Float[Array, ""]
    short: Float[Array, ""]
    guard: Float[Array, ""]
    ceiling: Float[Array, ""]
    slew: Float[Array, ""]
    fallback: Float[Array, ""]
    step: Float[Array, ""]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)  # as `etid.display.tracker.Tracker`
class Controller(Overviewed, Kept):
    """Finds the amplitude of every pulse for a wanted charge or current.

    Make a controller with `Controller.of`.

    Attributes:
        tracker: The tracker whose states are used.
        model: Charge and current from an admittance.
        limits: Limits of the amplitude.
        most: Charge of a phase whose current is `current_cap` throughout [C].
        short: Charge through a short circuit per unit of amplitude, at most [C].
    """

    tracker: Tracker
    model: CurrentModel
    limits: Limits
    most: float
    short: float

    @classmethod
    @in_float64
    def of(
        cls,
        tracker: Tracker,
        *,
        current_cap: float = 5e-3,
        charge_cap: float = math.inf,
        voltage_cap: float = math.inf,
        slew: float = math.inf,
        fallback: float | None = None,
        amplitude_step: float = 0.0,
        probability: float = 1 - 1e-9,
    ) -> "Controller":
        """A controller for the electrodes of a tracker.

        Args:
            tracker: The tracker.
            current_cap: Largest current of either sign [A]; 5 mA is the paper's limit for the
                fingertip.
            charge_cap: Largest charge per phase [C].
            voltage_cap: Compliance: largest unloaded voltage at the terminal [V].
            slew: Largest increase of the relative amplitude from one pulse to the next. A decrease
                is never limited.
            fallback: Relative amplitude for an electrode whose verdict is not good. It must be
                large enough for the tracker to identify the skin, and so small that a short
                circuit carries no more than `charge_cap`. 0.1, or the largest amplitude that
                `charge_cap` allows if this is smaller, if it is not given.
            amplitude_step: Step of the relative amplitudes that the stimulator can give, such as
                1/1023 with 10 bits for 0 to 1. Only whole steps are commanded, so that the tracker
                is told what was given. 0 if the stimulator gives any amplitude.
            probability: Probability with which the caps on current and charge hold at a pulse while
                the skin varies as the tracker expects.

        Raises:
            RecordingError: A limit is no number.
            ValueError: A limit is not positive, `current_cap` exceeds 0.1 A, `charge_cap` exceeds
                what `current_cap` carries in a phase, `fallback` is infinite or exceeds what
                `charge_cap` allows, the probability is not between ½ and 1, `amplitude_step` is
                negative or too coarse, or the driver of the tracker is not good.
        """
        require("tracker", tracker, Tracker, "Make one with etid.display.Tracker.of")
        given = {
            "current_cap": current_cap,
            "charge_cap": charge_cap,
            "voltage_cap": voltage_cap,
            "slew": slew,
            "fallback": 0.1 if fallback is None else fallback,
        }
        for name, value in given.items():
            if not number_of(name, value) > 0:
                raise ValueError(f"{name} is {value}; it must be positive")
        if current_cap > LARGEST_CAP:
            raise ValueError(
                f"current_cap is {current_cap:g} A, more than {LARGEST_CAP:g} A; is it in ampere "
                "and not in mA?"
            )
        if math.isinf(given["fallback"]):
            raise ValueError("fallback is infinite; give an amplitude")
        if not 0.5 <= number_of("probability", probability) < 1:
            raise ValueError(f"probability is {probability}; give at least 0.5 and less than 1")
        if not usable(tracker.driver_result):
            raise ValueError(
                "the driver of the tracker cannot be used, so that no limit of the current would "
                "hold; repeat the calibration"
            )
        model = CurrentModel.of(tracker.model)
        most = float(current_cap) * model.phase
        if most < charge_cap < math.inf:
            raise ValueError(
                f"charge_cap is {charge_cap:g} C; current_cap carries {most:.3g} C in a phase, so "
                "that charge_cap would never act. Is it in coulomb and not in nC?"
            )
        quantile = float(scipy.special.ndtri(probability))
        short = float(model.short_charge(jnp.asarray(quantile)))
        allowed = float(charge_cap) / short / RAISE
        if fallback is not None and fallback > allowed:
            raise ValueError(
                f"fallback is {fallback:g}, which carries up to {fallback * short:.3g} C through a "
                f"short circuit; charge_cap allows {charge_cap / RAISE:.3g} C there. Give at most "
                f"{math.floor(1e4 * allowed) / 1e4:g}, or none"
            )
        of = tracker.model.bands
        unloaded = float(np.abs(of.waveform()).max())
        limits = Limits(
            current_cap=jnp.asarray(float(current_cap)),
            charge_cap=jnp.asarray(float(charge_cap)),
            quantile=jnp.asarray(quantile),
            short=jnp.asarray(allowed),
            guard=current_cap / jnp.abs(model.short_circuit()).max(),
            ceiling=jnp.asarray(float(voltage_cap) / unloaded),
            slew=jnp.asarray(float(slew)),
            fallback=jnp.asarray(min(float(given["fallback"]), allowed)),
            step=jnp.zeros(()),
        )
        return cls(tracker, model, limits, most, short).stepped(amplitude_step)

    @in_float64
    def stepped(self, amplitude_step: float) -> "Controller":
        """The same controller for a stimulator of which the step of the amplitudes is known.

        Args:
            amplitude_step: As in `Controller.of`.

        Raises:
            RecordingError: The step is no number.
            ValueError: It is negative, or so coarse that an electrode could not rise from it.
        """
        step, least = number_of("amplitude_step", amplitude_step), 1 / (RAISE - 1)
        if not 0 <= step < math.inf:
            raise ValueError(f"amplitude_step is {step}; give a step, or 0 for any amplitude")
        for name in ("fallback", "short"):
            largest = float(getattr(self.limits, name))
            # An amplitude rises by `RAISE`, which must be a step.
            if step * (1 if name == "fallback" else least) > largest:
                raise ValueError(
                    f"amplitude_step is {step:g}, too coarse: without an estimate an electrode "
                    f"gets at most {largest:.3g}, and rises from there by a quarter. Give a larger "
                    "charge_cap, or reduce the range of the stimulator"
                )
        limits = self.limits._replace(step=jnp.asarray(float(step)))
        return dataclasses.replace(self, limits=limits)

    def _overview(self) -> Overview:
        rows = [
            ("current_cap", f"{1e3 * float(self.limits.current_cap):g}", "mA"),
            ("charge_cap", f"{1e9 * float(self.limits.charge_cap):g}", "nC"),
            ("guard", f"{float(self.limits.guard):.3f}", "of the unloaded record"),
            ("fallback", rounded(float(self.limits.fallback), 3), "of the unloaded record"),
            ("worst pulse", f"{1e9 * self.short * float(self.limits.guard):.0f}", "nC"),
        ]
        return Overview(f"Controller of {several(self.tracker.electrodes, 'electrode')}", rows)

    @in_float64
    def command(
        self,
        state: TrackerState,
        *,
        charge: float | Float[np.ndarray, " wanted"] | None = None,
        current: float | Float[np.ndarray, " wanted"] | None = None,
    ) -> Command:
        """The amplitudes of the next pulse.

        Args:
            state: State of the tracker after the last pulse.
            charge: Wanted charge per phase, at all electrodes or at each [C].
            current: Wanted mean current during the phase, instead of a charge [A].

        Raises:
            RecordingError: `state` is no state of a tracker.
            ValueError: Not exactly one of `charge` and `current` is given, or a number is negative,
                not finite, or more than a current of `current_cap` gives in a phase, or there is
                not one for each electrode, or the state is that of another tracker.
        """
        self.tracker.check(state)
        if (charge is None) == (current is None):
            raise ValueError("give either charge or current")
        name, given = ("current", current) if charge is None else ("charge", charge)
        given = for_each(name, given, self.tracker.electrodes)
        wanted = given if current is None else given * self.model.phase
        if (wanted > self.most).any():
            raise ValueError(
                f"{given.max():g} {'C' if current is None else 'A'} is wanted; current_cap carries "
                f"{self.most:.3g} C in a phase. Are the numbers in coulomb or ampere, and not in "
                "nC or mA?"
            )
        amplitude, expected, stderr, peak, reason = np.array(
            _commanded(
                self.tracker.model.circuit,
                self.tracker.change,
                self.model,
                self.limits,
                state.electrodes,
                state.driver_changed,
                wanted,
            )
        )
        worst = self.short * amplitude
        return Command(amplitude, expected, stderr, peak, worst, REASONS[reason.astype(int)])


@jax.jit  # as `etid.display.tracker`
def _commanded(
    circuit: AbstractCircuit,
    change: Float[Array, ""],
    model: CurrentModel,
    limits: Limits,
    electrodes: ElectrodeState,
    driver_changed: Bool[Array, ""],
    wanted: Float[Array | np.ndarray, " lane"],
) -> Float[Array, "row lane"]:
    """The fields of `Command` as rows of one array: each array of a result costs time.

    The last row has the numbers of the reasons.
    """
    k = limits.quantile

    def electrode(lane: ElectrodeState, wanted: Float[Array, ""]) -> Float[Array, " row"]:
        # The inverse of `predicted`, in one step.
        cov = inverse_of_few(lane.information) + change**2 * jnp.eye(lane.information.shape[0])
        now = model.current(circuit, LoadUnknowns.of(lane.own).log_elements, cov)
        good = ~driver_changed & ~lane.repeated & usable(lane.result) & (lane.pulses > 0)
        good = good & (now.charge > 0) & (now.charge_stderr < now.charge)
        most = jnp.stack(
            [
                wanted / now.charge,
                limits.current_cap / (now.peak + k * now.peak_stderr),
                limits.charge_cap / model.rest / (now.charge + k * now.charge_stderr),
                jnp.maximum(limits.short, jnp.where(lane.amplitude > 0, RAISE * lane.confirmed, 0)),
                limits.guard,
                limits.ceiling,
                jnp.nan_to_num(lane.amplitude) + limits.slew,
            ]
        )
        good = good & ~jnp.isnan(most).any()  # the smallest of some numbers and a NaN is NaN
        # One bad pulse must not raise the amplitude of wet skin. A new electrode may need more.
        held = (lane.pulses > 0) & (lane.amplitude > 0)
        last = jnp.where(held, lane.amplitude, jnp.inf)
        first = jnp.where(wanted > 0, jnp.minimum(limits.fallback, last), 0.0)
        safe = jnp.concatenate([first[None], jnp.full(2, jnp.inf), limits.short[None], most[4:]])
        applied = jnp.where(good, most, safe)
        reason = jnp.argmin(applied)
        amplitude = jnp.where(lane.repeated, 0.0, _in_steps(applied, limits.step))
        expected = amplitude * jnp.stack([now.charge, now.charge_stderr, now.peak])
        reason = jnp.where(good, reason, jnp.where(lane.repeated, REPEATED, FALLBACK))
        reason = reason.astype(amplitude.dtype)
        return jnp.stack([amplitude, *jnp.where(good, expected, jnp.nan), reason])

    return jax.vmap(electrode, out_axes=1)(electrodes, jnp.asarray(wanted))


def _in_steps(most: Float[Array, " limit"], step: Float[Array, ""]) -> Float[Array, ""]:
    """The amplitude that all limits allow, in whole steps.

    The first limit is what is wanted, in the nearest step. This is at least one step, unless it is
    0: nothing would be seen of less.
    """
    size = jnp.where(step > 0, step, 1.0)
    wanted = jnp.maximum(jnp.round(most[0] / size), jnp.where(most[0] > 0, 1.0, 0.0))
    allowed = jnp.floor(jnp.min(most[1:]) / size + 1e-9)  # rounding of n · step / step
    return jnp.where(step > 0, jnp.minimum(wanted, allowed) * size, jnp.min(most))
