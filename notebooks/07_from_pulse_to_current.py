# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From pulse to current
#
# This notebook closes the loop: pulses are recorded, the skin is identified after each of them, and
# the amplitude of the next pulse is chosen for a wanted charge. A finger becomes wet meanwhile.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes ten seconds.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import etid
import etid.display
from etid.simulation.transformer import (
    ResistorLoad,
    Sampler,
    SkinLoad,
    TransformerDriver,
    loading,
)

Scene, Trial = etid.scenes.Scene, etid.scenes.Trial
SEED, WANTED = 7, 80e-9  # [C] per phase
RNG = np.random.default_rng(SEED)

# %% [markdown]
# ## Driver and tracker
# The driver is identified once, from known resistors. The unloaded voltage of its calibration is
# the pulse to which all others are compared.

# %%
SKINS = {
    "dry": SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9),
    "damp": SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9),
}
resistors = [Trial(f"calibration/{r:g}", ResistorLoad(r)) for r in (98.8e3, 21.62e3)]
trials = [Trial(name, skin) for name, skin in SKINS.items()]
study = Scene(tuple(trials), tuple(resistors), samples=40_000).simulate(SEED)
calibrations = list(study.calibrations.recordings())
driver = etid.identify_driver(calibrations)
tracker = etid.display.Tracker.of(driver, calibrations[0], electrodes=2, change=3e-3)

# %% [markdown]
# ## Limits
# The guard is the amplitude at which a short circuit would carry the cap on the current. It holds
# whatever the skin does between two pulses. Amplitudes are relative to that of the calibration.

# %%
controller = etid.display.Controller.of(tracker, current_cap=5e-3, fallback=0.3, probability=0.999)
print(controller)

# %% [markdown]
# ## The loop
# Two electrodes are dry. The second becomes damp at pulse 12. The transformer is not at rest when
# the next pulse begins, so a window contains the end of the pulse before. Here the waveforms are
# exact; `python -m benchmarks control` closes the loop against ngspice.

# %%
RATE, PULSES, NOISE = 200e3, 60.0, 0.01  # [Hz], [Hz], [V]
transformer = TransformerDriver()
sampler = Sampler(RATE, PULSES / 2, 0.4 * RATE)  # one pulse in two periods
v_th = transformer.v_th_spectrum(sampler.f) * PULSES / 2
samples = tracker.model.bands.samples
ALONE = {
    name: v_th * loading(skin(sampler.f), transformer.z_th(sampler.f))
    for name, skin in SKINS.items()
}


def recorded(pulse: int, amplitude: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Windows of both electrodes [V]."""
    start = round(pulse * RATE / PULSES) / RATE - pulse / PULSES
    rows = []
    for at, name in enumerate(["dry", "dry" if pulse < 12 else "damp"]):
        now, later = (sampler.sample(ALONE[name], samples, start + n / PULSES) for n in (0, 1))
        rows.append(amplitude[at] * now + before[at] * later)
    return np.stack(rows) + NOISE * RNG.standard_normal((2, samples))


state = tracker.start(at_rest=True)
amplitudes, reasons, found = [np.zeros(2)], [], []
for pulse in range(24):
    command = controller.command(state, charge=WANTED)
    v_out = recorded(pulse, command.amplitude, amplitudes[-1])
    state = tracker.update(state, v_out, command.amplitude)
    for change in tracker.changes(state):
        print(change)
        found.append(change)
    amplitudes.append(command.amplitude)
    reasons.append(command.reason)
print(command)

# %% [markdown]
# ## What was delivered
# The true charge follows from the circuit of the simulated transformer. The first pulse after the
# change is too large: nobody could know that the skin had changed. Its current stays below the cap.


# %%
def current(load: SkinLoad) -> np.ndarray:
    """True current in one period for the amplitude of the calibration [A]."""
    f, points = 60.0 * np.arange(1, 30_001), 1 << 16
    i = transformer.v_th_spectrum(f) * 60 / (load(f) + transformer.z_th(f))
    return np.fft.irfft(np.concatenate([[0], i, np.zeros(points // 2 - f.size)]), points) * points


def charge(load: SkinLoad) -> float:
    """True charge of the positive phase [C]."""
    i = current(load)
    return float(np.maximum(i, 0)[: i.size // 10].sum() / i.size / 60)


skin = [[SKINS["dry"], SKINS["dry" if pulse < 12 else "damp"]] for pulse in range(24)]
delivered = np.array(amplitudes[1:]) * [[charge(one) for one in row] for row in skin]
peak = np.array(amplitudes[1:]) * [[np.abs(current(one)).max() for one in row] for row in skin]

figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
axis.plot(1e9 * delivered, "o-", label=["stays dry", "becomes damp"])
axis.axhline(1e9 * WANTED, color="0.6", zorder=0)
axis.set(xlabel="pulse", ylabel="charge per phase / nC", yscale="log")
axis.legend()

# %% [markdown]
# From the second pulse after the change on, the charge is the wanted one again, within 2 %.
