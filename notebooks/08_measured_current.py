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
# # What do voltage and current at the electrode tell?
#
# A stimulator that measures its current needs no driver and no calibration. At the end you will
# know how precise such recordings are, and what real ones need before they can be believed: the
# right edges, the same filter in both channels, and a circuit that the data support.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes a minute.

# %%
# %matplotlib inline
import os
import pathlib

import matplotlib.pyplot as plt
import numpy as np
import scipy.io

import etid

Scene, Trial = etid.scenes.Scene, etid.scenes.Trial
SEED = 8

# %% [markdown]
# ## What the current is worth
# One trial of dry skin, once with a calibrated driver, and once with a current that is measured
# with the same relative noise. All records have trigger delays of 50 ns.

# %%
SKIN = etid.SkinRC(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
KNOWN = etid.scenes.paper_calibration().calibration
trials = (Trial("dry", SKIN),)
noise = {"snr_db": 60.0, "trigger_jitter_rms": 50e-9}
with_driver = etid.bound(Scene(trials, KNOWN, **noise))["dry"]
scene = Scene(trials, current_snr_db=60.0, **noise)
with_current = etid.bound(scene)["dry"]
for name in SKIN.names():
    print(
        f"{name}: {100 * with_driver.relative[name]:.3f} % with a driver, "
        f"{100 * with_current.relative[name]:.3f} % with a current"
    )

# %%
recording = scene.simulate(SEED)["dry"]
fit = etid.identify_skin(recording)
print(fit)
etid.plot(fit, show="impedance")
plt.show()

# %% [markdown]
# An element that is known helps the others: here R_s is, from the geometry, say.

# %%
fixed = etid.identify_skin(recording, fixed={"r_s": 33.4e3})
print(f"c_p: {100 * fit.stderr.c_p / fit.circuit.c_p:.4f} % becomes", end=" ")
print(f"{100 * fixed.stderr.c_p / fixed.circuit.c_p:.4f} %")

# %% [markdown]
# ## Real data
# They do not come with etid. The notebook looks for them in the folder that the variable
# ETID_REFERENCE_DATA names, and in `shared/data` beside the project; without them these parts are
# skipped.

# %%
HERE = pathlib.Path.cwd()
NEAR = [folder / "shared" / "data" for folder in (HERE, *HERE.parents)]
GIVEN = pathlib.Path(os.environ.get("ETID_REFERENCE_DATA", NEAR[0]))
DATA = next((folder for folder in (GIVEN, *NEAR) if folder.is_dir()), None)
print("real data:", "found" if DATA else "absent, these parts are skipped")

# %% [markdown]
# **A model cell of patch clamp**, R_s + R_p ‖ C_p. Its maker states R_p = 500 MΩ within 1 % and
# C_p = 33 pF within 10 %. The amplifier holds the voltage, steps it by 10 mV, and filters the
# current with four poles of Bessel at 2 kHz. A converter holds the command between its samples,
# which multiplies its spectrum by sinc. First as if there were no filter.

# %%
if DATA:
    import h5py

    with h5py.File(DATA / "patch_clamp_model_cell" / "model_vc_step.h5") as file:
        rate = float(file.attrs["sampling_rate_hz"])
        current = 1e-12 * np.asarray(file["current_pA"], float).mean(axis=0)
        command = 1e-3 * np.asarray(file["command_mV"], float)[0]
    f = np.fft.rfftfreq(command.size)  # [1/sample]
    hold = np.sinc(f) * np.exp(-1j * np.pi * f)
    voltage = np.fft.irfft(np.fft.rfft(command - command[0]) * hold, command.size)
    measured = etid.Recording(
        v_out=voltage, current=current, sample_rate=rate, pulse_rate=rate / command.size
    )
    print(etid.identify_skin(measured, throw=False))

# %% [markdown]
# A `misfit`, and the current was late by several samples: that is what a low-pass does. Only the
# current passes the filter. It is known, so state it; the parts that set its corner are good to
# 5 %.

# %%
cell = None
if DATA:
    measured = measured.replace(current_filter="bessel 4 2000 100")
    cell = etid.identify_skin(measured)
    print(cell)
    assert abs(cell.circuit.r_p / 500e6 - 1) < 0.01
    assert abs(cell.circuit.c_p / 33e-12 - 1) < 0.1

# %% [markdown]
# Now noise explains the residual, R_p and C_p are those of the maker, and ± of R_s contain the
# corner: without its tolerance they would be half as large. SciPy's fit of the step response with a
# free corner finds 1907 Hz, 11.03 MΩ, 497.6 MΩ and 32.63 pF. Without the filter in the model R_s
# was 3 % too large.
#
# **Platinum electrodes on tissue**: 500 µA for 1.2 ms in each direction, five pairs. The current
# was commanded, not measured. At 24.4 kHz a phase of 1.2 ms has 29.3 samples, but the voltage
# jumps after 29. A current with the commanded edges leaves 7 to 9 % of the voltage, whatever the
# circuit; that is easily taken for a wrong circuit. So the edges are taken from the voltage.

# %%
tissue = {}
if DATA:
    rate, rest = 24414.0625, 15  # samples before the pulse, which three times are the pause
    pairs = scipy.io.loadmat(
        DATA / "ecog_stim" / "20f8a3_stimOutput.mat", squeeze_me=True, struct_as_record=False
    )["dataStruct"]
    for name in pairs._fieldnames:
        pair = getattr(pairs, name)
        mean = pair.stim_data.mean(axis=1)
        v_out = np.concatenate([np.tile(mean[:rest], 3), mean])
        first, second, end = np.sort(np.argsort(abs(np.diff(v_out)))[-3:]) + 1
        current = np.zeros(v_out.size)
        current[first:second], current[second:end] = (
            1e-6 * sign * pair.stim_current for sign in (1, -1)
        )
        place = np.fft.rfftfreq(v_out.size)  # a converter holds the current between its samples
        lines = np.fft.rfft(current) * np.sinc(place) * np.exp(-1j * np.pi * place)
        current = np.fft.irfft(lines, v_out.size)
        measured = etid.Recording(
            v_out=v_out, current=current, sample_rate=rate, pulse_rate=rate / v_out.size, path=name
        )
        tissue[name] = etid.select_circuit(
            measured,
            candidates=[etid.SkinRC(), etid.SkinCole()],
            throw=False,
        )
        for one in tissue[name].candidates:
            print(f"{name}: {one.name} leaves {100 * float(one.fit.rrse):.2f} %, {one.fit.verdict}")

# %% [markdown]
# ## Conclusion
#
# - A measured current replaces driver and calibration. At equal noise it is several times as
#   precise, because Z_th no longer has to be known.
# - Both channels must have passed the same filter, or the filter of one must be stated, and the
#   current must be the one that flowed. Neither error looks like noise; both are easily taken for
#   another circuit.
# - Metal electrodes on tissue have a constant phase in five of five pairs. It leaves about 1 % of
#   the voltage, far more than the noise. The verdict is `approximate`: a good circuit, not the true
#   one, and ± contain what it leaves.
