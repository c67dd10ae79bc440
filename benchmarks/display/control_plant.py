"""A display whose loads change at every pulse, and the loop that is closed around it.

Nothing here is shared with what `etid.display` predicts. The response of each load to one pulse
from rest comes from the circuit of the transformer (`by_circuit`) or from ngspice (`by_ngspice`).
The circuit is linear: a pulse of amplitude A after pulses of amplitude B and C is A u(t) + B u(t +
T) + C u(t + 2T). The charge is the integral of the current over the phase of the unloaded voltage,
on a grid of 0.4 µs. Where a load changes, the tails of the pulses before are those of the new load.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.integrate
import scipy.interpolate
from jaxtyping import Complex, Float, Int
from tqdm import tqdm

from benchmarks import ngspice
from benchmarks.laboratory import drawn_noise
from etid.display import Controller
from etid.display.controller import Command
from etid.display.state import TrackerState
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Electronics, Scene
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad

FINE = 12  # points per sample; a third of a sample must be whole points
PERIODS = 6  # after which a pulse has decayed, even through a short circuit
SOLVED = 2  # periods that ngspice solves: older pulses leave e^(-8) of the tail of the last one
OLDER = 3  # pulses whose tails are added, the newest one included
DELAYS = np.array([-1e-7, 0.0, 1e-7])  # [s] of the trigger, drawn for each window
STEP = 1 / 1023  # of the amplitudes of a stimulator of 10 bits
INSULATOR = ResistorLoad(1e12)  # no load, as ngspice has it

Load = Callable[[Float[np.ndarray, " f"]], Complex[np.ndarray, " f"]]
Waves = tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]
Source = Callable[[Scene, Load], Waves]
"""Terminal voltage [V] and current [A] of one pulse from rest, `FINE` times in a sample."""


def _points(scene: Scene, periods: int) -> int:
    return round(periods * scene.sample_rate / scene.pulse_rate) * FINE


def by_circuit(scene: Scene, load: Load) -> Waves:
    """The pulse over `PERIODS` by its spectrum."""
    points = _points(scene, PERIODS)
    rate = scene.sample_rate * FINE
    f = np.fft.rfftfreq(points, 1 / rate)
    v, z_th, z = scene.driver.v_th_spectrum(f) * rate, scene.driver.z_th(f), load(f)
    with np.errstate(invalid="ignore"):
        through = np.where(np.isinf(z), 0.0, v / (z + z_th))
        voltage = np.where(np.isinf(z), v, z * through)
    return np.fft.irfft(voltage, points), np.fft.irfft(through, points)


def by_ngspice(scene: Scene, load: Load) -> Waves:
    """The pulse over `SOLVED` periods from its steps in time."""
    known = INSULATOR if isinstance(load, OpenLoad) else load
    assert isinstance(known, SkinLoad | ResistorLoad)
    text = ngspice.single_pulse(scene.driver, known, SOLVED / scene.pulse_rate)
    time, *waves = ngspice.solve(text)
    grid = np.arange(_points(scene, SOLVED)) / (scene.sample_rate * FINE)
    v, i = (scipy.interpolate.CubicSpline(time, of)(grid) for of in waves)
    return v, i


class Display:
    """A display at 60 Hz and 200 kHz, and the loads that its electrodes may meet.

    Of a pulse of unit amplitude from rest it knows the `charge` in its own phase and in the next
    ones [C] (load, older), the `peak` of the current of either sign [A], and the `mean` terminal
    voltage in its phase [V].
    """

    def __init__(
        self, scene: Scene, loads: Sequence[Load], seed: int, source: Source = by_circuit
    ) -> None:
        self.rng, self.scene = np.random.default_rng(seed), scene
        rate, period = scene.sample_rate * FINE, scene.sample_rate / scene.pulse_rate
        self.size, self.step = round(period), scene.full_scale / 2**15 / scene.scale
        unloaded, _ = source(scene, OpenLoad())
        points = unloaded.size
        time, f = np.arange(points) / rate, np.fft.rfftfreq(points, 1 / rate)
        filtering, corner = scene.electronics or Electronics(), scene.antialias * scene.sample_rate
        filtered = filtering.response(f, corner)
        late = filtered * np.exp(2j * np.pi * f * DELAYS[:, None])

        top, below = int(np.argmax(unloaded)), np.flatnonzero(unloaded <= 0)
        phase = time[below[below < top].max()], time[below[below > top].min()]
        energy = np.sum(np.fft.irfft(np.fft.rfft(unloaded) * filtered, points) ** 2) / rate
        rms = np.sqrt(energy * scene.pulse_rate)
        self.sigma = 0.0 if scene.snr_db is None else rms * 10 ** (-scene.snr_db / 20)

        self.older = min(OLDER, round(points / FINE / period))
        k = np.arange(self.older)
        ends = np.array(phase)[:, None] + k / scene.pulse_rate
        inside, first = (time > phase[0]) & (time < phase[1]), time < 1 / scene.pulse_rate
        # Window k periods after a pulse, whose first sample is `third` thirds of a sample late.
        begin = np.rint(k * period * FINE + np.arange(-1, 2)[:, None] * FINE / 3).astype(int)
        at = (begin[..., None] + FINE * np.arange(self.size)) % points
        rows, self.voltage = [], list[np.ndarray]()
        for load in loads:
            v, i = source(scene, load)
            charge = scipy.integrate.cumulative_trapezoid(i, time, initial=0.0)
            charges = np.diff(np.interp(ends, time, charge), axis=0)[0]
            rows.append((charges, np.abs(i[first]).max(), v[inside].mean()))
            windows = np.fft.irfft(np.fft.rfft(v) * late, points)[:, at]
            self.voltage.append(windows.astype(np.float32))
        self.charge, self.peak, self.mean = (np.array(of) for of in zip(*rows, strict=True))

    def charges(
        self, load: Int[np.ndarray, " lane"], amplitude: Float[np.ndarray, "older lane"]
    ) -> Float[np.ndarray, " lane"]:
        """Charge of a pulse at every electrode [C]; `amplitude` has the newest pulse first."""
        return np.sum(self.charge[load].T * amplitude[: self.older], axis=0)

    def windows(
        self,
        number: int,
        load: Int[np.ndarray, " lane"],
        amplitude: Float[np.ndarray, "older lane"],
    ) -> Float[np.ndarray, "lane sample"]:
        """What the converter records of pulse `number` [V]; the other arguments as `charges`."""
        third = (1, 0, 2)[number % 3]  # a window begins at the sample nearest to its period
        delay = self.rng.integers(DELAYS.size, size=load.size)
        v = drawn_noise(self.scene, self.sigma, self.rng, (load.size, self.size))
        newest = amplitude[: self.older].astype(np.float32)
        for at in range(load.size):
            v[at] += newest[:, at] @ self.voltage[load[at]][delay[at], third]
        return (self.step * np.rint(v / self.step)).astype(float)


class Pulse(NamedTuple):
    """One pulse of a loop."""

    state: TrackerState  # of the tracker before the pulse
    command: Command  # what the controller has given
    amplitude: Float[np.ndarray, "older lane"]  # of this pulse and of those before


Told = Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Windows [V] and amplitudes of a pulse as the tracker gets them, from its number and the true."""


def closed_loop(
    display: Display,
    controller: Controller,
    load: Int[np.ndarray, "pulse lane"],
    wanted: float | Float[np.ndarray, " lane"],
    told: Told = lambda number, v, amplitude: (v, amplitude[0]),
) -> Iterator[Pulse]:
    """Pulses that a controller gives, which sees the records of a display.

    If a change of the driver is reported, it starts again, as after a new calibration.
    """
    tracker, amplitude = controller.tracker, np.zeros((OLDER, load.shape[1]))
    state = tracker.start(at_rest=True)
    for number, of in enumerate(tqdm(load, leave=False)):
        command = controller.command(state, charge=wanted)
        given = STEP * np.rint(command.amplitude / STEP)
        amplitude = np.concatenate([given[None], amplitude[:-1]])
        yield Pulse(state, command, amplitude)
        v, given = told(number, display.windows(number, of, amplitude), amplitude)
        state = tracker.update(state, v, given)
        if state.driver_changed:
            print(f"a change of the driver was reported at pulse {number}")
            state = tracker.start(after=state)


# What happens to the skin at an electrode.
KINDS = {
    "dry": "dry",
    "wetting": "wetting within 100 ms",
    "sweating": "sweating slowly",
    "lifted": "lifted off and put back",
}
SPOTS, SPREAD = 7, 0.3  # different places of the fingertip, and the spread of their elements
WETTING = 6  # pulses from dry to damp
LIFTED, BACK = 70, 90  # pulses between which the last electrode touches nothing
SETTLED = 2  # pulses after a change that do not count: the target begins with the third


class Fingertip:
    """The skin at each electrode and pulse: the number of one of its loads (pulse, lane).

    `counts` are the pulses that count: neither a change nor one of the two that follow it.
    """

    def __init__(self, electrodes: int, pulses: int) -> None:
        spots = np.exp(SPREAD * np.random.default_rng(0).standard_normal((SPOTS, 3)))
        dry, damp = (np.array(dataclasses.astuple(TYPICAL[name])) for name in ("dry", "damp"))
        pulse, at = np.arange(pulses)[:, None], np.arange(electrodes)
        kind = np.array(list(KINDS))[at % 3]
        kind[-1] = "lifted"
        self.kind = kind.tolist()
        begin, wetting, sweating = 30 + 3 * (at // 3 % 4), kind == "wetting", kind == "sweating"
        wet = np.where(wetting, np.clip((pulse - begin + 1) / WETTING, 0, 1), 0.0)
        wet = np.where(sweating, pulse / pulses / 3, wet)[..., None]  # a third of the way to damp
        # Fewer places sweat: each pulse of them is another run of ngspice.
        values = spots[at // 3 % np.where(sweating, 2, SPOTS)] * dry ** (1 - wet) * damp**wet
        up = (kind == "lifted") & (pulse >= LIFTED) & (pulse < BACK)
        skins: list[Load] = [
            OpenLoad() if off else SkinLoad(*map(float, of))
            for off, of in zip(up.ravel(), values.reshape(-1, 3), strict=True)
        ]
        self.loads = list(dict.fromkeys([TYPICAL["dry"], *skins]))
        number = {skin: at for at, skin in enumerate(self.loads)}
        self.load = np.reshape([number[skin] for skin in skins], up.shape)
        changed = (pulse == 0) | (wetting & (begin <= pulse) & (pulse < begin + WETTING))
        changed |= (kind == "lifted") & (pulse >= LIFTED) & (pulse <= BACK)
        self.counts = ~changed
        for later in range(1, SETTLED + 1):
            self.counts[later:] &= ~changed[:-later]
