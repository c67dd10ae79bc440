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
# # Design the recording
#
# This notebook designs a recording that determines R_s to 1 % in dry and in damp skin. The
# Cramér-Rao bound predicts the error before anything is recorded. From it follow the number of
# pulses, their width, height and rate, the sample rate, and the calibration. At the end a
# simulation shows that the bound is right.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes twenty seconds.

# %%
# %matplotlib inline
import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import etid
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad, TransformerDriver

SEED = 0
GOAL = 0.01  # standard error of R_s, relative
NOISE = 0.1  # [V] rms of a sample, at the terminal
SKIN = {
    "dry": SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9),
    "damp": SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9),
}
STYLE = {"dry": "o-", "damp": "s--"}

# %% [markdown]
# ## A recording that does not exist yet
# The error depends on the pulse, the sample rate, the length, the noise and the calibrations. The
# noise is that of your own recorder, in volts, and does not depend on the pulse. 0.1 V is 40 dB
# below the pulses of the paper. All durations below are proportional to the square of the noise.
# The pulses are those of `TransformerDriver`; replace it by your own driver.


# %%
def recording(
    width=0.04 / 60, rate=60.0, duration=0.05, height=1.0, sample_rate=200e3, noise=NOISE,
    resistors=(98.8e3,), trials=1,
):  # fmt: skip
    """A scene with trials of both skins; the defaults are the paper's, three periods of 60 Hz."""
    driver = TransformerDriver(amplitude=4.2 * height, width=width, lead_in=min(120e-6, 0.2 / rate))
    scene = Scene(
        tuple(Trial(f"{name}/{i:03d}", load) for name, load in SKIN.items() for i in range(trials)),
        tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(resistors)),
        driver,
        sample_rate=sample_rate,
        pulse_rate=rate,
        samples=round(duration * sample_rate),
        trigger_jitter_rms=50e-9,
    )
    effective = np.sqrt(2 * np.sum(abs(scene.waveform().v_th) ** 2))
    return dataclasses.replace(scene, snr_db=float(20 * np.log10(effective / noise)))


today = etid.bound(recording())
print(*today.values(), sep="\n")

# %%
axes = etid.plot(today)

# %% [markdown]
# ## How many pulses?
# The information of pulses adds up: a record of twice the length has half the variance. So one
# bound gives the duration for any error.


# %%
def seconds(scene, **options):
    """Duration of a record that reaches the goal, by skin [s]."""
    bounds = etid.bound(scene, **options)
    length = scene.samples / scene.sample_rate
    return {name: length * (bounds[f"{name}/000"].relative["r_s"] / GOAL) ** 2 for name in SKIN}


for name, t in seconds(recording()).items():
    print(f"{name:<5}{t:5.2f} s, {60 * t:4.1f} pulses")

# %% [markdown]
# ## The effect of calibrations and a trigger
# Most of the variance comes from the driver: a trial cannot be better than its calibration. There
# are three remedies:
# - **A second resistor**, much smaller than the first. A single resistor leaves the delay of its
#   own record open. Every skin fit must then separate this delay from the elements of the skin.
# - **Long calibrations.** They are recorded once, without a person. For trials of a second, Z_th is
#   then as good as known.
# - **A known delay**, from a trigger that starts pulse and converter by one clock. Otherwise every
#   record has its own unknown delay.

# %%
one, two = recording(), recording(resistors=(98.8e3, 21.62e3))
ways = {
    "one resistor": seconds(one),
    "two resistors": seconds(two),
    "two, recorded long": seconds(two, known_driver=True),
    "one, delays known": seconds(one, delays=False),
    "two, delays known": seconds(two, delays=False),
    "two, long, delays known": seconds(two, known_driver=True, delays=False),
}
print(f"{'seconds to 1 % on R_s':<26}dry    damp")
for name, t in ways.items():
    print(f"{name:<24}{t['dry']:6.3f}  {t['damp']:6.3f}")

# %%
duration = np.geomspace(0.01, 2.0, 50)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
looks = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (1, 3)))
for axis, name in zip(axes, SKIN, strict=True):
    for look, (way, t) in zip(looks, ways.items(), strict=True):
        axis.loglog(duration, 100 * GOAL * np.sqrt(t[name] / duration), ls=look, label=way)
    axis.axhline(100 * GOAL, color="0.6", lw=0.8)
    axis.set(xlabel="duration of a trial [s]", title=f"{name} skin, pulses of 667 µs at 60 Hz")
    axis.grid(color="0.9")
axes[0].set_ylabel("standard error of R_s [%]")
axes[0].legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# How long must calibrations be? With two resistors, four times the length of a trial gives an error
# within a tenth of that of endless calibrations. With one resistor, sixteen times are necessary.

# %%
known = etid.bound(two, known_driver=True)["damp/000"].relative["r_s"]
excess = {}
for resistors in ((98.8e3,), (98.8e3, 21.62e3)):
    for repeats in (1, 4, 16):
        error = etid.bound(recording(resistors=resistors * repeats))["damp/000"].relative["r_s"]
        excess[len(resistors), repeats] = error / known
        print(f"{len(resistors)} resistors x {repeats:2d}: {error / known:.2f} of the known driver")

# %% [markdown]
# ## Which pulse?
# The person limits the pulse. For short pulses, the charge of a pulse decides whether a person
# feels it (Weiss, 1901). Current and charge per second matter for safety. Here the pulses of the
# paper are the limit; replace them by your own limits. A transformer passes no direct current, so
# the charge that enters during a pulse leaves after it. We count the charge that enters.


# %%
def current(scene, load):
    """Current through a load over one period [A]."""
    f = scene.pulse_rate * np.arange(1, round(4e6 / scene.pulse_rate))
    v_th = scene.pulse_rate * scene.driver.v_th_spectrum(f)
    harmonics = np.append(0, v_th / (scene.driver.z_th(f) + load(f)))
    return np.fft.irfft(harmonics, norm="forward")


def burden(scene, load):
    """Largest current [A], charge per pulse [C] and per second [C/s]."""
    i = current(scene, load)
    charge = np.maximum(i, 0).mean() / scene.pulse_rate
    return np.array([abs(i).max(), charge, charge * scene.pulse_rate])


limits = {name: burden(recording(), load) for name, load in SKIN.items()}
for name, (peak, pulse, second) in limits.items():
    print(
        f"{name:<5}{1e3 * peak:5.2f} mA, {1e9 * pulse:4.0f} nC per pulse, {1e6 * second:5.1f} µC/s"
    )

# %% [markdown]
# R_s is the impedance at the highest frequencies, and the edges contain these frequencies. The part
# between two edges carries charge, but no information about R_s. This holds for widths down to
# 40 µs, the duration of the ringing after an edge.

# %%
RATE = 240.0  # [Hz] a period is not a whole number of samples, which separates the aliases
widths = np.array([10, 20, 40, 80, 160, 320, 0.04 / 60 * 1e6]) * 1e-6
pulses = [recording(width, rate=RATE) for width in widths]  # the same edges, whatever the rate
each = [seconds(scene, known_driver=True) for scene in pulses]
single = {name: np.array([100 * GOAL * np.sqrt(RATE * t[name]) for t in each]) for name in SKIN}
charge = {name: np.array([burden(p, load)[1] for p in pulses]) for name, load in SKIN.items()}

figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for name in SKIN:
    axes[0].semilogx(1e6 * widths, single[name], STYLE[name], label=name)
    axes[1].loglog(1e6 * widths, 1e9 * charge[name], STYLE[name], label=name)
axes[0].set(xlabel="width [µs]", ylabel="standard error of R_s, one pulse [%]", ylim=(0, None))
axes[1].set(xlabel="width [µs]", ylabel="charge per pulse [nC]")
for axis in axes:
    axis.grid(color="0.9")
    axis.legend(frameon=False)
plt.show()

# %% [markdown]
# So use short pulses, and use the saved charge for more pulses. Increase the rate until the charge
# per second reaches its limit, or until the sensation is as strong as intended.

# %%
print("width     rate, charge per second as before     time to 1 %, damp")
fastest = {}
for width, t, *q in zip(widths, each, charge["dry"], charge["damp"], strict=True):
    rate = min(limits[name][2] / q[i] for i, name in enumerate(SKIN))
    fastest[round(1e6 * width)] = 1e3 * RATE * t["damp"] / rate
    print(f"{1e6 * width:4.0f} µs  {rate:6.0f} Hz {fastest[round(1e6 * width)]:36.1f} ms")

# %% [markdown]
# Height matters more than number: the error is inversely proportional to the height, but only to
# the square root of the number of pulses. One pulse of twice the height replaces four pulses, with
# half of their charge. The limit of the peak current limits the height.

# %%
higher = seconds(recording(40e-6, RATE, height=2.0), known_driver=True)
fewer = each[2]["damp"] / higher["damp"]
print(f"twice the height: {fewer:.2f} times fewer pulses, each with twice the charge")

# %% [markdown]
# ## Which sample rate?
# A faster converter records more of the edges, but also more noise. The noise of an amplifier grows
# with the square root of the bandwidth (left). The noise of the converter itself is the same for
# every sample at any rate (right).

# %%
print("seconds to 1 % on R_s     amplifier's noise     converter's noise")
by_rate = {}
for sample_rate in (50e3, 100e3, 200e3, 500e3, 1e6):
    amplifier = seconds(
        recording(sample_rate=sample_rate, noise=NOISE * np.sqrt(sample_rate / 200e3))
    )
    converter = seconds(recording(sample_rate=sample_rate))
    by_rate[sample_rate] = amplifier, converter
    cells = "".join(f"{t['dry']:10.3f}{t['damp']:9.3f}" for t in (amplifier, converter))
    print(f"{1e-3 * sample_rate:8.0f} kHz, dry and damp " + cells)

# %% [markdown]
# ## The recording, and a test of the bound
# The design has twelve pulses of 40 µs at 240 Hz, 50 ms in total; the paper's pulses would need
# 640 ms. The calibration has two resistors with two records each. Three such sessions are simulated
# and identified, each with twenty trials of both skins. If the bound is right and the estimator
# attains it, the errors divided by the bound have a mean square of 1.

# %%
SESSIONS, TRIALS = 3, 20
design = recording(40e-6, RATE, resistors=(98.8e3, 21.62e3) * 2, trials=TRIALS)
promised, elements = etid.bound(design), design.truth()
print(promised["dry/000"], promised["damp/000"], sep="\n")

units, errors, verdicts = [], [], []
for session in range(SESSIONS):
    study = design.simulate(SEED + session)
    driver = etid.identify_driver(list(study.calibrations.recordings()))
    fits = etid.identify_skins(study.loaded, driver)
    verdicts += fits.verdicts.tolist()
    truth = np.array([list(elements[path].values()) for path in fits.labels["path"]])
    relative = np.asarray(fits.circuit.values()) / truth - 1
    sizes = np.array([list(promised[path].relative.values()) for path in fits.labels["path"]])
    errors.append(relative.reshape(len(SKIN), TRIALS, 3))
    units.append((relative / sizes).reshape(len(SKIN), TRIALS, 3))
square = np.mean(np.square(units), axis=(0, 2))  # skin, element
order = list(dict.fromkeys(path.split("/")[0] for path in fits.labels["path"]))
for name, row in zip(order, square, strict=True):
    print(f"{name:<5}mean square of errors in units of the bound:", *(f"{x:.2f}" for x in row))

# %% [markdown]
# ## Conclusion
# The bound predicts the errors of the simulated sessions. Two resistors in the calibration and
# several periods cost little and give R_s to 1 %. Most of the charge of a long pulse buys no
# precision.
