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
# # When methods fail
#
# This notebook shows seven ways to get a wrong answer, and the verdict of etid for each. Some of
# the wrong fits look perfect. A residual does not show a wrong circuit, and a small RRSE does not
# show a right one. Compare the residual with the noise of the record, and read the verdict.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes twenty seconds.

# %%
# %matplotlib inline
import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import etid
from etid.simulation.scenes import Scene, SkinLoad, Trial
from etid.simulation.transformer import ResistorLoad, TransformerDriver

SEED = 0
TRIALS = 16
DAMP = SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9)
TRUTH = np.array(dataclasses.astuple(DAMP))
PAPER = "steiglitz_mcbride"

# %% [markdown]
# ## Recordings without fault
# These are sixteen trials of one damp fingertip at 40 dB, without any fault. The default method
# finds the elements within their standard errors. All later cases are compared with this one.

# %%
good = Scene(
    tuple(Trial(f"damp/{i:02d}", DAMP) for i in range(TRIALS)),
    (Trial("calibration", ResistorLoad(98.8e3)),),
    snr_db=40.0,
)


def identified(scene, method=None, order=5, calibrated=None):
    """Fits of all trials of a scene, their driver, and the study.

    `calibrated` is another scene for the calibration; without it, the scene's own calibration is
    used.
    """
    study = scene.simulate(SEED)
    records = study if calibrated is None else calibrated.simulate(SEED + 1)
    driver = etid.identify_driver(records["calibration"], order=order, method=method, throw=False)
    return etid.identify_skins(study.loaded, driver, method=method), driver, study


def errors(fits):
    """Relative errors (trial, element)."""
    return np.asarray(fits.circuit.values()) / TRUTH - 1


CASES = {}


def counted(fits):
    """How often each verdict occurs."""
    return ", ".join(f"{count} {verdict}" for verdict, count in fits.counts().items())


def tell(name, fits):
    """Keep a case; print its verdicts, its errors and its standard errors."""
    CASES[name] = fits
    mean, stderr = 100 * errors(fits).mean(axis=0), 100 * np.asarray(fits.stderr.values()) / TRUTH
    said = np.nanmedian(stderr, axis=0) if np.isfinite(stderr).any() else np.full(3, np.nan)
    print(f"{name}: {counted(fits)}")
    print(f"  RRSE {100 * np.median(fits.fit.rrse):.2f} %, chi2 {np.median(fits.fit.chi2):.2f}")
    for element, m, s in zip(fits.circuit.names(), mean, said, strict=True):
        known = f"standard error {s:.1f} %" if np.isfinite(s) else "no standard error"
        print(f"  {element}: mean error {m:+6.1f} %, {known}")


fits, driver, study = identified(good)
tell("default", fits)

# %%
axes = etid.plot(fits[0], study["damp/00"], driver)

# %% [markdown]
# ## 1. Bias: the paper's method
# Steiglitz-McBride filters both records and solves a linear problem. The noise of V_out is on both
# sides of this problem, so the result is biased. The bias is the same in every trial, so the mean
# over trials does not reduce it.

# %%
paper, paper_driver, _ = identified(good, PAPER)
tell("Steiglitz-McBride", paper)

# %% [markdown]
# ## 2. Trigger delay
# A delay of a tenth of a sample, 500 ns, between the unloaded and the loaded record looks like a
# phase, and a phase looks like a capacitor. Steiglitz-McBride does not fit delays, so its C_p
# spreads. The default method fits the delay of each record and loses almost nothing.

# %%
late = dataclasses.replace(good, trigger_jitter_rms=500e-9)
late_fits, late_driver, _ = identified(late)
late_paper, *_ = identified(late, PAPER)
tell("default, late trigger", late_fits)
tell("Steiglitz-McBride, late trigger", late_paper)
for name, some in (("default", late_fits), ("Steiglitz-McBride", late_paper)):
    print(f"{name}: C_p spreads by {100 * errors(some)[:, 2].std(ddof=1):.1f} %")

# %% [markdown]
# ## 3. Clipping
# The range of the converter ends below the top of the pulse. Every sample is a number, so a fit
# would run. etid does not try it, because the codes at the end of the range show the clipping.

# %%
narrow = dataclasses.replace(good, full_scale=2.4)
clipped = etid.identify_skins(narrow.simulate(SEED).loaded, driver)
print(f"clipped: {counted(clipped)}")
print(clipped.notes[0])

# %%
axes = etid.plot(narrow.simulate(SEED)["damp/00"])

# %% [markdown]
# ## 4. Skin that is not one R_p ‖ C_p
# This skin has a relaxation that is distributed over time constants (Cole, α = 0.9). The best fit
# of R_s + R_p ‖ C_p leaves a residual that has the size of the noise over the whole record. χ² is
# 1.1, but the error of R_s is 40 %. Two things show the wrong circuit. The fit changes Z_th against
# the calibration (`inconsistent`), or a test for this kind of relaxation detects it
# (`etid.estimators.score_tests.other_circuit`, `misfit`).


# %%
def cole(f):
    """Impedance of a damp fingertip with a constant phase [Ω]."""
    return DAMP.r_s + DAMP.r_p / (1 + (2j * np.pi * f * DAMP.r_p * DAMP.c_p) ** 0.9)


spread = dataclasses.replace(good, trials=tuple(Trial(t.path, cole) for t in good.trials))
spread_fits, spread_driver, spread_study = identified(spread)
tell("not one RC", spread_fits)

# %%
axes = etid.plot(spread_fits[0], spread_study["damp/00"], spread_driver)

# %% [markdown]
# ## 5. A driver that has changed
# Between the calibration and the recordings, the protection resistor of the driver has increased by
# a third. No skin can compensate for this: the recordings need another Z_th than the calibration.

# %%
warm = TransformerDriver(r_protection=TransformerDriver().r_protection * 4 / 3)
changed = dataclasses.replace(good, driver=warm)
changed_fits, *_ = identified(changed, calibrated=good)
tell("another driver", changed_fits)

# %% [markdown]
# Not every change is detected. A change of a few per cent can pass as a success, with an error of
# one per cent. The only remedy is to calibrate again at the end of a session.
#
# ## 6. A driver of too low an order
# A driver with three poles instead of six explains the calibration down to its noise. χ² is 1, but
# all skins that are identified with this driver are wrong. The example has 60 dB, where this error
# is larger than the noise.

# %%
quiet = dataclasses.replace(good, snr_db=60.0)
low_fits, low_driver, _ = identified(quiet, order=3)
print(low_driver)
tell("order 3", low_fits)

# %% [markdown]
# ## 7. Too little in the record
# At 10 dB the record does not determine R_s: its standard error is as large as its value. The bound
# predicts this before the recording. Most fits are `insensitive`. In some records the noise hides
# even where the edges are (`misaligned`), or the minimum (`max_steps_reached`). None is a success.

# %%
poor = dataclasses.replace(good, snr_db=10.0)
poor_fits, *_ = identified(poor)
print(f"10 dB: {counted(poor_fits)}")
print(etid.bound(poor)["damp/00"])

# %% [markdown]
# ## RRSE is blind
# The picture shows the errors of all cases over the RRSE, the usual measure of a fit. At 40 dB,
# fits of records without fault have an RRSE of 1 %. The fits of another skin and of another driver
# have the same RRSE, but are wrong by tens of per cent. The RRSE of Steiglitz-McBride is twice as
# large, but its R_s is nearer to the truth. The driver of order 3 at 60 dB has the smallest RRSE of
# all, but its error is seven standard errors.

# %%
figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
for i, (name, some) in enumerate(CASES.items()):
    trusted = some.verdicts[0] == "successful"
    size = 100 * abs(errors(some)).max(axis=1)
    look = {
        "ls": "",
        "color": f"C{i}",
        "marker": "os^vDP*"[i],
        "mfc": f"C{i}" if trusted else "none",
    }
    axis.loglog(100 * some.fit.rrse, size, label=name, **look)
axis.set(xlabel="RRSE [%]", ylabel="largest error of an element [%]", title="filled: successful")
axis.grid(color="0.9")
axis.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
plt.show()

# %% [markdown]
# ## Conclusion
# Every fit with the verdict `successful` is right within five of its standard errors. Every wrong
# fit has another verdict. The RRSE tells them apart in no case.
