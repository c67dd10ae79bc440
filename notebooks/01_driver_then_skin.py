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
# # Driver, then skin
#
# This notebook begins with the files of an oscilloscope. It imports them, identifies the source
# impedance of the driver, and then R_s, R_p and C_p of a fingertip with standard errors. It shows
# how to judge the results. It also shows why the Steiglitz-McBride method of the paper gives only a
# start for a better method.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes ten seconds.

# %%
# %matplotlib inline
import pathlib
import tempfile

import numpy as np

import etid

SEED = 0
SCALE = 0.0535  # volts at the oscilloscope for one volt at the electrode

# %% [markdown]
# ## The files of the lab
# An oscilloscope exports a table for each recording: lines with its settings, the names of the
# columns, and the samples. Channel 1 is the unloaded voltage V_th, channel 2 is the voltage V_out
# at the load. There is one calibration with a known resistor, and there are three trials of a dry
# fingertip and three of a damp one. Each recording has 60 dB and three pulse periods at 200 kHz.
# These files are simulated, so the truth is known. You have such files already.

# %%
SETTINGS = "Model,DPO2014\nSample Interval,5e-06\nRecord Length,10000\nVertical Units,V\n"
dry, damp = etid.scenes.paper_dry(), etid.scenes.paper_damp()
scene = etid.scenes.Scene(dry.trials[:3] + damp.trials[:3], dry.calibration, snr_db=60.0)
truth = scene.truth()
folder = pathlib.Path(tempfile.mkdtemp())
for path, measured in scene.simulate(SEED).items():
    time = np.arange(measured.v_out.size) / measured.sample_rate
    columns = np.stack([time, SCALE * measured.v_th, SCALE * measured.v_out], axis=1)
    name = folder / f"{path.replace('/', '_')}.csv"
    np.savetxt(
        name, columns, fmt="%.9g", delimiter=",", header=f"{SETTINGS}TIME,CH1,CH2", comments=""
    )
print(*sorted(one.name for one in folder.iterdir()), sep="\n")
print((folder / "typical_dry_01.csv").read_text()[:130])

# %% [markdown]
# ## Import
# A mapping says what the channels are; etid guesses nothing. It holds what is equal in all files,
# and for each file its name, its labels, and the known resistor if there is one. It can also be a
# TOML file for `etid import`. The result is one file of recordings.

# %%
mapping = {
    "header_line": 5,  # the line with the names of the columns
    "time": {"channel": "TIME", "unit": "s"},
    "v_th": {"channel": "CH1", "unit": "V"},
    "v_out": {"channel": "CH2", "unit": "V"},
    "scale": SCALE,
    "pulse_rate": 60.0,
    "recording": [
        {"file": "calibration_98k8.csv", "path": "calibration/98k8", "r_load": 98.8e3},
        *(
            {
                "file": f"typical_{condition}_{trial}.csv",
                "path": f"typical/{condition}/{trial}",
                "condition": condition,
                "trial": trial,
                "calibration": "calibration/98k8",
            }
            for condition in ("dry", "damp")
            for trial in ("01", "02", "03")
        ),
    ],
}
used = etid.import_file(sorted(folder.iterdir()), folder / "study.h5", mapping)
study = etid.read(folder / "study.h5")
study

# %%
axes = etid.plot(study["typical/dry/01"])

# %% [markdown]
# ## The driver
# A pulse transformer drives the display. The calibration has a known resistor in place of the skin.
# Its loaded and unloaded voltages determine the source impedance Z_th of the driver. χ² is 1 if the
# model explains the recording down to its noise.

# %%
calibration = study["calibration/98k8"]
driver = etid.identify_driver(calibration, order=5)
print(driver)

# %%
axes = etid.plot(driver, calibration)

# %% [markdown]
# ## The skin
# Now the load is unknown. Its circuit is a resistor R_s in series with a parallel resistor R_p and
# capacitor C_p. One call identifies all six trials.

# %%
fits = etid.identify_skins(study.loaded, driver)
print(fits)
print(fits[0])

# %%
skin = etid.identify_skin(study["typical/dry/01"], driver)
axes = skin.plot()

# %%
axes = etid.plot(
    {"Z_th": driver, "Z_bio, dry": skin, "Z_bio, damp": fits.where(condition="damp")[0]}
)

# %% [markdown]
# ## Spread and standard error are different numbers
# The spread contains everything that differs between trials; here this is only noise. The standard
# error also contains the error of the driver. All trials share this error, so the spread does not
# show it. Neither of them contains the tolerance of the calibration resistor, which passes 1:1 into
# every resistance.

# %%
for row in fits.summary("condition"):
    print(
        f"{row['condition']:<5}r_s {row['r_s'] / 1e3:7.3f} kΩ, "
        f"spread {row['r_s_spread'] / 1e3:.3f}, standard error {row['r_s_stderr'] / 1e3:.3f}"
    )

# %% [markdown]
# ## Steiglitz-McBride on the same recordings
# This method filters both records and solves a linear problem, repeatedly. The noise of V_out is on
# both sides of the linear problem, so the result is biased. Discretisation biases C_p even without
# noise. The verdict reports this.

# %%
method = "steiglitz_mcbride"
baseline = etid.identify_skins(
    study.loaded, etid.identify_driver(calibration, method=method, throw=False), method=method
)
print(baseline.counts())


# %%
def errors(fits):
    """Relative error of each element in each trial, by name."""
    return {
        name: np.array(
            [
                value / truth[path][name] - 1
                for path, value in zip(
                    fits.labels["path"], np.asarray(getattr(fits.circuit, name)), strict=True
                )
            ]
        )
        for name in fits.circuit.names()
    }


for some in (fits, baseline):
    worst = ", ".join(f"{name} {100 * abs(e).max():.2f} %" for name, e in errors(some).items())
    print(f"{some.fit.method:<18} largest errors: {worst}")

# %% [markdown]
# ## Conclusion
# A mapping of 20 lines turns the files of an oscilloscope into recordings, and two calls into
# elements. Maximum likelihood finds all elements of the six trials within two standard errors, and
# the verdict of each fit is `successful`. The errors of the Steiglitz-McBride method of the
# paper are five to ten times as large, and its verdicts say that its values are not to be used.
# Believe a fit by its verdict and its standard errors; a small residual is no proof.
