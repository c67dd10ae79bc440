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
# # A batch study
#
# This notebook makes a table of fits from a file with subjects, conditions and trials. Then it
# separates three parts of the spread: differences between people, differences between the trials of
# one person, and measurement noise. A fourth part, the error of the driver, is in no spread.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes ten seconds.

# %%
# %matplotlib inline
import pathlib
import tempfile

import matplotlib.pyplot as plt
import numpy as np
import scipy.stats

import etid
from etid.simulation.scenes import Scene, SkinLoad, Trial, paper_calibration

SEED = 0

# %% [markdown]
# ## A study whose truth is known
# The study has eight subjects, dry and damp skin, and six trials each: 96 recordings with 40 dB and
# one driver. The elements differ between subjects and between trials by log-normal factors. R_s
# belongs to deep tissue and is the same in every trial of a subject. R_p and C_p belong to the
# outer skin and change from trial to trial. For your own recordings, leave out the next cell.

# %%
SUBJECTS, TRIALS = 8, 6
ELEMENTS = ("r_s", "r_p", "c_p")
TYPICAL = {"dry": (33.4e3, 186e3, 0.12e-9), "damp": (6.1e3, 17.4e3, 0.66e-9)}
BETWEEN_SUBJECTS = np.array([0.25, 0.30, 0.20])  # standard deviations of logarithms
BETWEEN_TRIALS = np.array([0.0, 0.06, 0.03])

rng = np.random.default_rng(SEED)
trials = []
for number in range(1, SUBJECTS + 1):
    person = np.exp(BETWEEN_SUBJECTS * rng.standard_normal(3))
    for condition, typical in TYPICAL.items():
        for trial in range(1, TRIALS + 1):
            elements = typical * person * np.exp(BETWEEN_TRIALS * rng.standard_normal(3))
            labels = {"subject": f"s{number}", "condition": condition, "trial": str(trial)}
            trials.append(Trial("/".join(labels.values()), SkinLoad(*elements), **labels))
scene = Scene(tuple(trials), paper_calibration().calibration, snr_db=40.0)
study, truth = scene.simulate(SEED), scene.truth()

# %% [markdown]
# ## From a file to a file
# The command is `etid fit study.h5 -o fits.h5`. The file may have any size, because it is fitted in
# parts. `resume=True` continues a run that was interrupted.

# %%
with tempfile.TemporaryDirectory() as name:
    folder = pathlib.Path(name)
    study.write(folder / "study.h5")
    etid.fit_file(folder / "study.h5", folder / "fits.h5")
    fits = etid.Fits.read(folder / "fits.h5")
print(fits)

# %%
axes = etid.plot(fits)

# %% [markdown]
# ## The parts of a spread
# For the six trials of each subject, `summary` gives the standard deviation (`spread`), its part
# from noise alone (`own`), and the rest (`between`). It also gives the error that all fits share,
# because they have one driver (`shared`). In per cent of R_s:

# %%
PARTS = ("spread", "own", "between", "shared")
rows = fits.summary("subject", "condition")
print("subject  " + "".join(f"{part:>9}" for part in PARTS))
for row in rows:
    if row["condition"] == "dry":
        values = "".join(f"{100 * row[f'r_s_{part}'] / row['r_s']:9.2f}" for part in PARTS)
        print(f"{row['subject']:<9}" + values)

# %% [markdown]
# Here R_s is the same in every trial of a subject, but its estimates spread by some per cent. This
# is noise. Six trials are too few to show it: some subjects seem to vary and some do not. All
# subjects together show it clearly.
#
# ## Variance components
# Let y be the logarithm of an element in trial t of subject s, in one condition:
#
# $$y_{st} = \mu + \text{subject}_s + \text{trial}_{st} + \text{noise}_{st} + \text{driver}$$
#
# There are S subjects with T trials each. The expected mean squares within and between subjects are
# (Searle, Casella, McCulloch, *Variance Components*, 1992, chapter 3)
#
# $$M_\text{within} = \sigma_\text{trial}^2 + \sigma_\text{own}^2, \qquad
# M_\text{between} = M_\text{within} + T\,\sigma_\text{subject}^2,$$
#
# The standard errors of the fits give σ_own. Neither mean square contains the error of the driver.


# %%
def components(condition, element):
    """Variances of the logarithm of an element: subjects, trials, noise, driver."""
    part, i = fits.where(condition=condition), ELEMENTS.index(element)
    value = np.asarray(getattr(part.circuit, element))
    shared = np.mean(part.fit.shared_cov[:, i, i] / value**2)
    own = np.mean(part.cov[:, i, i] / value**2) - shared
    y = np.log(value).reshape(SUBJECTS, TRIALS)  # recordings of a file are sorted by path
    within = y.var(axis=1, ddof=1).mean()
    between = TRIALS * y.mean(axis=1).var(ddof=1)
    return np.array([(between - within) / TRIALS, within - own, own, shared])


def true_components(condition, element):
    """Variances of the logarithm of a simulated element: subjects, trials."""
    paths = fits.where(condition=condition).labels["path"]
    y = np.log([truth[path][element] for path in paths]).reshape(SUBJECTS, TRIALS)
    within = y.var(axis=1, ddof=1).mean()
    return np.array([y.mean(axis=1).var(ddof=1) - within / TRIALS, within])


CASES = [(condition, element) for condition in TYPICAL for element in ELEMENTS]
found = {case: components(*case) for case in CASES}
true = {case: true_components(*case) for case in CASES}
print("standard deviations [%]   subjects (true)     trials (true)     noise   driver")
for case in CASES:
    s = 100 * np.sqrt(np.maximum(found[case], 0))
    t = 100 * np.sqrt(np.maximum(true[case], 0))
    print(
        f"{case[0]:>5} {case[1]:<18}{s[0]:10.1f} ({t[0]:.1f})"
        f"{s[1]:12.2f} ({t[1]:.2f}){s[2]:10.2f}{s[3]:9.2f}"
    )

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
HATCHES = ("", "///", "...", "xxx")
for axis, condition in zip(axes, TYPICAL, strict=True):
    for j, part in enumerate(("subjects", "trials", "noise", "driver")):
        height = [np.sqrt(max(found[condition, element][j], 0)) for element in ELEMENTS]
        place = np.arange(3) + 0.2 * j - 0.3
        axis.bar(
            place, 100 * np.array(height), 0.18, label=part, hatch=HATCHES[j], fc=f"C{j}", ec="0.2"
        )
        if j < 2:
            height = [np.sqrt(max(true[condition, element][j], 0)) for element in ELEMENTS]
            axis.plot(place, 100 * np.array(height), "k_", ms=12, label="true" if j else None)
    axis.set(title=condition, xticks=range(3), xticklabels=ELEMENTS, yscale="log", ylim=(0.3, 200))
axes[0].set_ylabel("standard deviation [%]")
axes[1].legend(fontsize=8, ncols=2)
# %% [markdown]
# The spread of R_s between trials is only noise, and the estimate shows this. `between` of
# `summary` is the same quantity for one subject.
#
# ## The error that no spread shows
# All 96 fits use one driver, and its error moves them in the same direction. We can see this error
# only because the truth is known here. Noise alone would give 48 fits a mean error of a seventh of
# the noise; the mean error is larger.

# %%
print("mean error of 48 fits [%]   found   noise of a mean   driver")
common = {}
for condition, element in CASES:
    part = fits.where(condition=condition)
    value = np.asarray(getattr(part.circuit, element))
    known = np.array([truth[path][element] for path in part.labels["path"]])
    noise = np.sqrt(found[condition, element][2] / len(part))
    driver = np.sqrt(found[condition, element][3])
    common[condition, element] = np.log(value / known).mean(), noise, driver
    print(
        f"{condition:>5} {element:<20}{{:+8.2f}}{{:14.2f}}{{:12.2f}}".format(
            *100 * np.array(common[condition, element])
        )
    )

# %% [markdown]
# ## The size of the next study
# The variance of the mean over all subjects has three parts: σ_subject² / S from people,
# (σ_trial² + σ_own²) / ST from trials and noise, and the full variance of the driver. More subjects
# or trials do not reduce the variance of the driver. A longer calibration, one more resistor or
# `etid.identify_jointly` reduce it. The tolerance of the resistor must be added.

# %%
print("standard errors of the means, dry [%]:   r_s     r_p     c_p")
for subjects, trials_each in ((8, 6), (8, 60), (80, 6)):
    person, trial, own, shared = np.maximum([found["dry", name] for name in ELEMENTS], 0).T
    sampled = person / subjects + (trial + own) / (subjects * trials_each)
    total = 100 * np.sqrt(sampled + shared)
    print(
        f"{subjects:>15} subjects, {trials_each:>2} trials:"
        + "{:8.1f}{:8.1f}{:8.1f}".format(*total)
    )

# %% [markdown]
# More trials of the same people do not help here. Eight people determine the spread between people
# only roughly: with S − 1 degrees of freedom, its 95 % interval is

# %%
QUANTILES = scipy.stats.chi2.ppf([0.025, 0.975], SUBJECTS - 1)
for element, population in zip(ELEMENTS, BETWEEN_SUBJECTS, strict=True):
    high, low = 100 * np.sqrt(found["dry", element][0] * (SUBJECTS - 1) / QUANTILES)
    print(f"{element}: {low:.0f} to {high:.0f} %, drawn from {100 * population:.0f} %")

# %% [markdown]
# ## Conclusion
# The variances between subjects and between trials agree with those that were drawn, after the
# noise is subtracted. The error that all trials of a driver share does not show in any spread: it
# must be taken from the standard errors.
