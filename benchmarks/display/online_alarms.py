"""False alarms of the tracker on skin that does not change, and how soon wet skin is found.

The noise of every pulse and electrode is drawn anew; the delays are those of `DRAWS` triggers, and
the sampling phase is that of the pulse. The skin does not change, and the tracker expects that: its
statistics then have the distribution of the tests. The noise of the unloaded record, of twelve
periods, is common to all pulses and no part of the tests.
"""

import dataclasses
from collections.abc import Iterator

import jax
import numpy as np
import scipy.special
from jaxtyping import Float
from tqdm import tqdm

import etid
from benchmarks.laboratory import drawn_noise
from benchmarks.ladder import ELECTRONICS, TWO, WHITE
from etid.display import Tracker
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Scene, Trial

LOADS = tuple(TYPICAL.values())
JITTER = 50e-9  # [s]
UNLOADED = 40_000  # samples of the unloaded record: twelve periods
LOADED = 10_000  # samples of the simulated windows: three, one of each sampling phase
DRAWS = 24  # triggers of each load
SETTLING = 60  # pulses before the first that counts
WET, TIMES = 0.4, 25  # part of the electrodes that become wet at once, and how often
SOON = 2  # pulses within which the change must be found


class Fingertip:
    """Pulses of a display at one noise; `change` is the random walk that the tracker expects."""

    def __init__(
        self, electrodes: int, snr_db: float, change: float = 0.0, electronics: str = WHITE
    ) -> None:
        usual = {"trigger_jitter_rms": JITTER, "samples": UNLOADED}
        noisy = Scene((), TWO, snr_db=snr_db, **usual, **ELECTRONICS[electronics])
        calibrations = list(noisy.simulate(seed=0).calibrations.recordings())
        driver = etid.identify_driver(calibrations)
        self.tracker = Tracker.of(driver, calibrations[0], electrodes=electrodes, change=change)
        self.noisy, self.sigma = noisy, noisy.waveform().sigma
        trials = [
            Trial(f"{at}/{draw}", load) for at, load in enumerate(LOADS) for draw in range(DRAWS)
        ]
        exact = dataclasses.replace(
            noisy, trials=tuple(trials), calibration=(), samples=LOADED, snr_db=None, bits=None
        ).simulate(seed=1)
        records = np.stack([one.v_out for one in exact.recordings()])
        windows = self.tracker.pulses(records)
        self.windows = windows.reshape(len(windows), len(LOADS), DRAWS, -1)
        self.rng = np.random.default_rng([2, round(snr_db)])

    def pulse(self, number: int, loads: np.ndarray) -> Float[np.ndarray, "lane sample"]:
        """The next pulse, for the number of the load at each electrode [V]."""
        draws = self.rng.integers(DRAWS, size=loads.size)
        clean = self.windows[number % len(self.windows), loads, draws]
        return clean + drawn_noise(self.noisy, self.sigma, self.rng, clean.shape)

    def pulses(self, loads: np.ndarray, number: int) -> Iterator[Float[np.ndarray, "lane sample"]]:
        return (self.pulse(at, loads) for at in range(number))


def alarms(
    electrodes: int, snr_db: float, hours: float, electronics: str = WHITE
) -> dict[str, float]:
    """What the tests for changes show in so many electrode hours, and after a change."""
    display = Fingertip(electrodes, snr_db, electronics=electronics)
    tracker = display.tracker
    loads = np.arange(electrodes) % len(LOADS)
    hourly = 3600 * tracker.model.bands.sample_rate / tracker.period
    pulses = SETTLING + int(np.ceil(hours * hourly / electrodes))
    state, false, driver, settled = tracker.start(), 0, 0, None
    for number, v_out in enumerate(tqdm(display.pulses(loads, pulses), total=pulses, disable=None)):
        state = tracker.update(state, v_out)
        if number < SETTLING:
            settled = state
            continue
        for change in tracker.changes(state):
            false += change.kind != "driver"
            driver += change.kind == "driver"
    assert settled is not None
    dry = np.flatnonzero(loads == 0)
    wet = dry[: int(WET * electrodes)]
    after = loads.copy()
    after[wet] = 1
    found = 0
    for _ in range(TIMES):
        seen, state = set(), settled
        for later in range(SOON):
            state = tracker.update(state, display.pulse(SETTLING + later, after))
            seen |= {one.electrode for one in tracker.changes(state)}
        found += len(seen & {*wet.tolist()})
    jax.block_until_ready(state)
    counted = (pulses - SETTLING) * electrodes / hourly
    # The largest rate that 95 % confidence allows.
    most = float(scipy.special.gammaincinv(false + 1, 0.95)) / counted
    return {
        "electrode hours without a change": counted,
        "false alarms in them": false,
        "false alarms per electrode and hour, 95 % limit": most,
        "false alarms of the driver": driver,
        "electrodes that became wet": TIMES * wet.size,
        f"wet skin that is found within {SOON} pulses": found / (TIMES * wet.size),
    }
