# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Driver, then skin
#
# This notebook identifies the source impedance of a driver from a recording, and then R_s, R_p and
# C_p of a fingertip with standard errors. It shows how to judge the results. It also shows why the
# Steiglitz-McBride method of the paper gives only a start for a better method.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)  # before the first array: etid needs float64

import numpy as np

import etid

SEED = 0

# %% [markdown]
# ## The recordings
# The study has one calibration with a known resistor, three trials of a dry fingertip and three of
# a damp one. Each recording has 60 dB and three pulse periods at 200 kHz. The recordings are
# simulated, so the truth is known. For your own file, use `study = etid.read("study.h5")` instead.

# %%
dry, damp = etid.scenes.paper_dry(), etid.scenes.paper_damp()
scene = etid.scenes.Scene(dry.trials[:3] + damp.trials[:3], dry.calibration, snr_db=60.0)
truth = scene.truth()
study = scene.simulate(SEED)
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
recording, skin = study["typical/dry/01"], fits.where(path="typical/dry/01")[0]
axes = etid.plot(skin, recording, driver)

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


for label, some in (("maximum likelihood", fits), ("Steiglitz-McBride", baseline)):
    worst = ", ".join(f"{name} {100 * abs(e).max():.2f} %" for name, e in errors(some).items())
    print(f"{label:<18} largest errors: {worst}")

# %% [markdown]
# ## Conclusion
# Maximum likelihood finds all elements of the six trials within their standard errors, and the
# verdict of each fit is `successful`. The Steiglitz-McBride method of the paper finds values that
# are wrong by per cents to tens of per cents, and its verdicts say so. Believe a fit by its verdict
# and its standard errors; a small residual is no proof.
