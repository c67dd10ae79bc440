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
# # Which circuit does my skin need?
#
# This notebook shows how etid chooses between one R_p ‖ C_p, a relaxation that is spread over time
# constants (Cole), and two layers: for one recording, for a study, and for real data whose circuit
# is known.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes a minute.

# %%
# %matplotlib inline
import os
import pathlib

import numpy as np

import etid
from etid.selection.evidence import best

Scene, Trial = etid.scenes.Scene, etid.scenes.Trial
SEED = 6
SNR_DB = 50.0

# %% [markdown]
# ## Three kinds of skin
# The recordings are simulated, so the true circuit is known.

# %%
SKINS = {
    "dry": etid.SkinRC(33.4e3, 186e3, 0.12e-9),
    "cole": etid.SkinCole(33.4e3, 186e3, 22e-6, 0.9),
    "layers": etid.SkinLayers(33.4e3, 150e3, 0.12e-9, 36e3, 3e-9),
}
of_cole = tuple(Trial(f"s01/{number}", SKINS["cole"], subject="s01") for number in range(3))
scene = Scene(
    tuple(Trial(name, skin, subject="s02") for name, skin in SKINS.items()) + of_cole,
    etid.scenes.paper_dry().calibration,
    snr_db=SNR_DB,
)
study = scene.simulate(SEED)
driver = etid.identify_driver([study[path] for path in study.calibrations], order=5)

# %% [markdown]
# ## One recording
# The table shows every circuit that was fitted. The search begins with one R_p ‖ C_p. It fits a
# richer circuit only if score tests of the residual ask for it.

# %%
found = {name: etid.select_circuit(study[name], driver) for name in SKINS}
for selection in found.values():
    print(selection, end="\n\n")

# %% [markdown]
# The picture shows why. Points are the impedance that the recording measures, lines are the
# candidates. Below, one R_p ‖ C_p misses the points by a trend over frequency; Cole's circuit
# leaves noise.

# %%
axes = etid.plot(found["cole"], study["cole"], driver)

# %% [markdown]
# Two layers are neither one R_p ‖ C_p nor a symmetric spread.

# %%
axes = etid.plot(found["layers"], study["layers"], driver)

# %% [markdown]
# ## A study
# Groups can be compared only if all their recordings have the same circuit. The evidence of all
# recordings chooses it. A recording that deserves another circuit has a note.

# %%
paths = [trial.path for trial in of_cole] + ["layers"]
fits = etid.identify_skins([study[path] for path in paths], driver, circuit="auto")
print(fits)
for path, note in zip(paths, fits.notes, strict=True):
    print(f"{path}: {note or 'no other circuit'}")

# %% [markdown]
# ## Real data
# The data are not part of etid. If the folder is absent, this part says so and is skipped.
#
# None of these instruments has etid's scene, a driver between two voltages. So `select_circuit`
# cannot be used. What can be done is the same comparison: every candidate is fitted to the
# measured impedance, and the same rules choose.

# %%
HERE = pathlib.Path.cwd()
NEAR = [folder / "shared" / "data" for folder in (HERE, *HERE.parents)]
GIVEN = pathlib.Path(os.environ.get("ETID_REFERENCE_DATA", NEAR[0]))
DATA = next((folder for folder in (GIVEN, *NEAR) if folder.is_dir()), None)
CANDIDATES = [
    etid.SkinRC(), etid.ParallelRC(), etid.Resistor(), etid.SkinCole(), etid.SkinLayers()
]  # fmt: skip
print("real data:", "found" if DATA else "absent, this part is skipped")


def chosen(fits):
    """The choice between fits of all candidates to one impedance."""
    numbered = dict(enumerate(fits))
    return etid.Selection.of(numbered, best(numbered), CANDIDATES)


def fitted(frequency, z, stderr, circuit):
    return etid.identify_impedance(frequency, z, stderr=stderr, circuit=circuit, throw=False)


# %% [markdown]
# **Soldered circuits**, R0 + R1 ‖ C1, measured twice each by a potentiostat from 1 Hz on. Two
# measurements agree to 0.02 to 0.1 %, but the instrument itself is less exact: the residual of the
# best circuit is 0.6 % of Z. This is the standard error here.

# %%
ACCURACY = 0.006  # of |Z|


def spectrum(path):
    """Frequency [Hz] and impedance [Ω] of a ZPlot file."""
    lines = path.read_text(errors="replace").splitlines()
    rows = lines[lines.index("End Comments") + 1 :]
    table = np.array([row.split("\t") for row in rows if row.strip()], float)
    return table[:, 0], table[:, 4] + 1j * table[:, 5]


soldered = {}
for path in sorted((DATA / "dummy_circuits_eis").glob("*.z")) if DATA else []:
    frequency, z = spectrum(path)
    soldered[path.stem] = chosen(
        fitted(frequency, z, ACCURACY * abs(z), circuit) for circuit in CANDIDATES
    )
for name, selection in soldered.items():
    one, second = selection.candidates[:2]
    print(f"{name}: {one.name}, weight {100 * one.weight:.0f} %, chi2 {float(one.fit.chi2):.2f}")
    print(f"  {', '.join(one.fit.elements)}; second: {second.name} {second.evidence:.1f}")

# %% [markdown]
# **A model cell of patch clamp**: a voltage step into R_s + R_p ‖ C_p, and the current after a
# filter of Bessel in the recorder. Its maker states R_p = 500 MΩ within 1 % and C_p = 33 pF within
# 10 %. The spectra of step and current give Z; the scatter of 20 sweeps gives its standard error.
# The corner of the filter and the trigger delay are not known exactly. So each candidate is fitted
# with its own: two more unknowns, the same for all.

# %%
model_cell = None
if DATA:
    import h5py
    import scipy.optimize
    import scipy.signal

    with h5py.File(DATA / "patch_clamp_model_cell" / "model_vc_step.h5") as file:
        rate = float(file.attrs["sampling_rate_hz"])
        current = 1e-12 * np.asarray(file["current_pA"], float)
        command = 1e-3 * np.asarray(file["command_mV"], float)[0]
    f = np.fft.rfftfreq(command.size, 1 / rate)[1:-1]
    step = np.fft.rfft(command)[1:-1] * np.sinc(f / rate) * np.exp(-1j * np.pi * f / rate)  # held
    sweeps = np.fft.rfft(current)[:, 1:-1]
    mean = sweeps.mean(axis=0)
    scatter = (abs(sweeps - mean) ** 2).sum(axis=0) / (2 * len(sweeps) * (len(sweeps) - 1))
    relative = np.sqrt(np.convolve(scatter, np.ones(25) / 25, "same")) / abs(mean)
    # A step of 0.2 s has no power at multiples of 5 Hz.
    used = (f < 4e3) & (relative < 0.1) & (abs(np.sin(np.pi * 0.2 * f)) > 0.3)
    f, step, mean, relative = f[used], step[used], mean[used], relative[used]
    NUM, DEN = scipy.signal.bessel(4, 1.0, analog=True, norm="mag")

    def of_cell(unknown, circuit):
        """The fit for a corner [2 kHz] and a delay [samples]."""
        x = 1j * f / (2e3 * unknown[0])
        recorder = np.polyval(NUM, x) / np.polyval(DEN, x)
        z = step * recorder * np.exp(-2j * np.pi * f * unknown[1] / rate) / mean
        return fitted(f, z, relative * abs(z), circuit)

    def fit_cell(circuit):
        def squares(unknown):
            return float(of_cell(unknown, circuit).support.deviance)

        within = {"bounds": [(0.5, 1.5), (-1.0, 2.0)], "options": {"maxfev": 60}}
        return of_cell(
            scipy.optimize.minimize(squares, [1.0, 0.3], method="Nelder-Mead", **within).x, circuit
        )

    model_cell = chosen(map(fit_cell, CANDIDATES))
print(model_cell)

# %% [markdown]
# **Pulses of lithium cells**: current in, voltage out, 54 pulses at 25 °C. There is no unloaded
# record, the samples are irregular, and the charge shifts the voltage. So neither a recording nor
# an impedance of etid can hold them. For given τ the voltage is linear in all other unknowns.
# BIC = n ln(mean residual²) + p ln n compares zero to three relaxations. A candidate with a
# negative resistance is not adequate.

# %%
RELAXATIONS = ([], [2.0], [1.0, 10.0], [0.3, 2.0, 15.0])  # [s] starts of τ


def pulse(data):
    """Intervals [s], current [A], voltage [V], and which samples count."""
    number, time, volt, amps = (
        np.asarray(getattr(data, name), float)
        for name in ("Step", "ProgTime", "Voltage", "Current")
    )
    new = np.append(True, np.diff(time) > 0)  # some samples are stored twice
    number, time, volt, amps = number[new], time[new], volt[new], amps[new]
    first = np.append(True, np.diff(number) != 0)
    amps[first] = np.append(amps[1:], 0.0)[first]  # which pairs old and new values
    return np.append(np.diff(time), 1.0), amps, volt, ~first


def linear(taus, intervals, amps, volt, counts):
    """Columns of the linear problem, the unknowns, and the residual [V]."""
    columns = [np.ones_like(volt), amps, np.append(0, np.cumsum(intervals * amps))[:-1]]
    for tau in taus:
        state, decay = np.zeros_like(volt), np.exp(-intervals / tau)
        for k in range(volt.size - 1):
            state[k + 1] = decay[k] * state[k] + (1 - decay[k]) * amps[k]
        columns.append(state)
    matrix = np.stack(columns, axis=1)[counts]
    unknown = np.linalg.lstsq(matrix, volt[counts])[0]
    return unknown, matrix @ unknown - volt[counts]


def criterion(starts, data):
    """BIC of so many relaxations; infinite if an element is negative."""
    logs = np.log(starts)
    if starts:
        logs = scipy.optimize.least_squares(
            lambda logs: linear(np.exp(logs), *data)[1], logs, max_nfev=60
        ).x
    unknown, rest = linear(np.exp(logs), *data)
    count = unknown.size + len(starts)
    bic = rest.size * np.log(np.mean(rest**2)) + count * np.log(rest.size)
    return bic if (unknown[1:] > 0).all() else np.inf


relaxations = None
if DATA:
    import scipy.io

    path = DATA / "battery_pulses" / "LGM50_5Ah_Pulse.mat"
    whole = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["LGM50_5Ah_Pulse"].T25
    cells = [getattr(whole, name) for name in whole._fieldnames]
    pulses = [pulse(getattr(cell, name).data) for cell in cells for name in cell._fieldnames]
    bic = np.array([[criterion(starts, data) for starts in RELAXATIONS] for data in pulses])
    relaxations = np.bincount(bic.argmin(axis=1), minlength=len(RELAXATIONS))
    # As for a study: no pulse counts more than 20.
    joint = np.minimum(bic - bic.min(axis=1, keepdims=True), 20.0).sum(axis=0)
    print("pulses with 0, 1, 2, 3 relaxations:", *relaxations)
    print("joint loss of 2 log evidence:", *np.round(joint).astype(int))

# %% [markdown]
# ## What was chosen
# | data | known | chosen | next candidate |
# |---|---|---|---|
# | soldered circuits | R0 + R1 ‖ C1 | `SkinRC` in 4 of 4 | `SkinCole`, α = 1.00, −4 |
# | model cell | R_s + R_p ‖ C_p | `SkinRC` | `SkinCole`, α = 1.00, −7 |
# | 54 battery pulses | no | 2 relaxations in 33, 3 in 11, 1 in 10; jointly 2 | |
#
# The known circuits were chosen. A battery has no known number of relaxations: diffusion spreads
# its time constants, so that better data would ask for more.

# %% [markdown]
# ## Conclusion
# Each recording got the circuit that it was made with, or, from a soldered circuit, the circuit
# that was soldered. A study gets one circuit, and notes name the recordings that deserve another.
