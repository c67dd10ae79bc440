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
# At the end you will know how to get from recordings to the source impedance of a driver and to
# R_s, R_p and C_p of a fingertip with standard errors, how to see whether to believe them, and why
# the Steiglitz-McBride method of the paper is a start and not an answer.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)  # before the first array: etid needs float64

import numpy as np

import etid

SEED = 0

# %% [markdown]
# ## The recordings
# One calibration with a known resistor, three trials of a dry and three of a damp fingertip, all
# with 60 dB: three pulse periods at 200 kHz. They are simulated, so the truth is known. With a file
# of your own, `study = etid.read("study.h5")` is all that changes.

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
# Behind the display stands a pulse transformer. With a known resistor in place of the skin, the
# loaded and the unloaded voltage give its source impedance Z_th. χ² is 1 if the model explains the
# recording down to its noise.

# %%
calibration = study["calibration/98k8"]
driver = etid.identify_driver(calibration, order=5)
print(driver)

# %%
axes = etid.plot(driver, calibration)

# %% [markdown]
# ## The skin
# Now the load is unknown: a resistor in series with a resistor and a capacitor in parallel. All six
# trials are identified in one call.

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
# The spread between trials holds what differs between them, here only noise. The standard error
# also holds the error of the driver, which all trials share and no spread shows. The tolerance of
# the calibration resistor is in neither of them: it passes 1:1 into every resistance.

# %%
for row in fits.summary("condition"):
    print(
        f"{row['condition']:<5}r_s {row['r_s'] / 1e3:7.3f} kΩ, "
        f"spread {row['r_s_spread'] / 1e3:.3f}, standard error {row['r_s_stderr'] / 1e3:.3f}"
    )

# %% [markdown]
# ## Steiglitz-McBride on the same recordings
# It filters both records and solves a linear problem, again and again. The noise of V_out stands on
# both sides of that problem, so its answer is biased, and discretisation biases C_p even without
# noise. The verdict says so.

# %%
method = "steiglitz_mcbride"
baseline = etid.identify_skins(
    study.loaded, etid.identify_driver(calibration, method=method, throw=False), method=method
)
print(baseline.counts())


# %%
def errors(fits):
    """Relative error of each element in each trial."""
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


for label, some in (("output error", fits), ("Steiglitz-McBride", baseline)):
    worst = ", ".join(f"{name} {100 * abs(e).max():.2f} %" for name, e in errors(some).items())
    print(f"{label:<18} largest errors: {worst}")

# %% [markdown]
# ## What must hold
# These lines make the notebook a test.

# %%
assert driver.verdict == "successful"
assert fits.counts() == {"successful": 6}
for name, error in errors(fits).items():
    relative = np.asarray(getattr(fits.stderr, name)) / np.asarray(getattr(fits.circuit, name))
    assert np.all(abs(error) < 5 * relative), name  # five standard errors: 1 in 10⁶ by chance
    assert np.all(relative < 0.05), name  # and they are small enough to be of use
assert "successful" not in baseline.counts()  # it is off, and it says so
assert abs(errors(baseline)["c_p"]).min() > abs(errors(fits)["c_p"]).max()
