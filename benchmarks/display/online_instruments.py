"""On-line with instruments as laboratories have them: hum of the mains, and a quartz at each end.

The display is that of `online_alarms`, without a trigger that jitters. Hum is the same
sine at all electrodes but for its phase and for its size, of half to all of `HUM`. The pulses of a
stimulator with its own quartz are cut from one long record by `Tracker.pulses`.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from benchmarks.display.online_alarms import LOADS, Fingertip
from benchmarks.runner import Target, at_least
from etid.results.verdicts import verdict_names
from etid.simulation.transformer import loading

HUM = 0.1  # [V], ten times the noise at 60 dB
PPM = 50.0  # of the stimulator's quartz against that of the converter
PULSES, LANES = 300, 10
LIKELY = 0.99
TARGETS = {
    f"pulses successful with {1e3 * HUM:g} mV of hum": at_least(LIKELY),
    f"pulses successful with clocks {PPM:g} ppm apart": at_least(LIKELY),
}


def instruments(snr_db: float) -> Iterator[Target]:
    """Parts of the pulses that are successful."""
    (by_hum, by_clock), electrodes, pulses = TARGETS, LANES, PULSES
    at = f"{snr_db:g} dB: "
    for frequency in (50.0, 60.0):
        display = Fingertip(electrodes, snr_db, 1e-3)
        found = successful(display, humming(display, electrodes, frequency, pulses))
        yield Target.of(TARGETS, by_hum, found, f"{at}{frequency:g} Hz, ")
    display = Fingertip(electrodes, snr_db, 1e-3)
    found = successful(display, display.tracker.pulses(drifting(display, electrodes, pulses)))
    yield Target.of(TARGETS, by_clock, found, at)


def successful(display: Fingertip, windows: Iterator[np.ndarray] | np.ndarray) -> float:
    """Part of the pulses whose verdict is good."""
    state, found = display.tracker.start(), []
    for v_out in windows:
        state = display.tracker.update(state, v_out)
        good = verdict_names(state.electrodes.result) == "successful"
        found.append(good & ~bool(state.driver_changed))
    return float(np.mean(found))


def humming(
    display: Fingertip, electrodes: int, frequency: float, pulses: int
) -> Iterator[Float[np.ndarray, "lane sample"]]:
    """Pulses with hum [V]."""
    size = HUM * display.rng.uniform(0.5, 1.0, (electrodes, 1))
    phase = display.rng.uniform(0, 2 * np.pi, (electrodes, 1))
    bands, period = display.tracker.model.bands, display.tracker.period
    loads = np.arange(electrodes) % len(LOADS)
    for number, v in enumerate(display.pulses(loads, pulses)):
        time = (round(number * period) + np.arange(bands.samples)) / bands.sample_rate
        yield v + size * np.sin(2 * np.pi * frequency * time + phase)


def drifting(display: Fingertip, electrodes: int, pulses: int) -> Float[np.ndarray, "lane time"]:
    """A record whose pulses come later and later [V]."""
    scene = display.noisy
    period = scene.sample_rate / scene.pulse_rate * (1 + 1e-6 * PPM)
    sampler, v_th, z_th, _ = scene._exact()
    ends = [round(n * period) for n in range(pulses + 1)]
    starts = [(at - n * period) / scene.sample_rate for n, at in enumerate(ends[:-1])]
    rows = [
        np.concatenate(
            [
                sampler.sample(v_th * loading(load(sampler.f), z_th), size, start)
                for size, start in zip(np.diff(ends).tolist(), starts, strict=True)
            ]
        )
        for load in LOADS
    ]
    clean = np.stack(rows)[np.arange(electrodes) % len(LOADS)]
    noise = display.rng.standard_normal(clean.shape, np.float32)
    return clean + display.sigma * noise
