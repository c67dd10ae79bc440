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
# # A week of a laboratory
#
# Two subjects, two fingers, three days, and a display on the fingertip whose electrodes fire in
# turn. At the end you will know how a folder of oscilloscope files becomes maps of the skin, and
# how much of what differs from day to day is skin and how much is error.
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes a minute.

# %%
# %matplotlib inline
import pathlib
import tempfile

import numpy as np

import etid
from etid.simulation.scenes import Scene, SkinLoad, Trial
from etid.simulation.transformer import ResistorLoad

SEED = 9
SUBJECTS, SITES, DAYS = ("s01", "s02"), ("index", "thumb"), ("d1", "d2", "d3")
RATE, SCALE = 50e3, 0.0535  # samples per second, volts at the oscilloscope per volt

# %% [markdown]
# ## The files
# The next cell invents the week: for your own recordings, leave it out. It writes what an
# oscilloscope writes: a file for each subject, finger and day, and each morning one with a known
# resistor. `CH1` is the unloaded output, `CH2` the output on the skin, and `CH3` a trigger that
# rises when the next electrode begins to fire, for three pulses each. R_p grows towards the root of
# the finger; subjects, days, fingers and electrodes have factors of their own. Electrode 15 has no
# contact. The display is that of the paper, with 98 electrodes.

# %%
BETWEEN = {"subject": 0.25, "session": 0.10, "site": 0.05, "electrode": 0.03}  # of ln R_p
PLACES = etid.Layout.grid(14, 7, 2e-3)
rng = np.random.default_rng(SEED)


def recorded(loads, periods, rng):
    """The recordings of some loads, one behind the other, as the oscilloscope has them."""
    trials = tuple(Trial(f"{number}", load) for number, load in loads.items())
    size = round(periods * RATE / 60)
    scene = Scene(trials, sample_rate=RATE, samples=size, snr_db=50.0, start=0.75 / 60)
    study = scene.simulate(int(rng.integers(2**31)))
    both = [(study[f"{number}"].v_th, study[f"{number}"].v_out) for number in loads]
    v_th, v_out = SCALE * np.concatenate(both, axis=1)
    trigger = np.tile(np.arange(size) == 10, len(loads))
    return np.column_stack([np.arange(v_th.size), v_th, v_out, trigger])


def write(path, table):
    """Write a table as some oscilloscopes do: the interval stands beside the names."""
    with path.open("w") as file:
        file.write("X,CH1,CH2,CH3,Start,Increment,\n")
        file.write(f"Sequence,VOLT,VOLT,VOLT,0,{1 / RATE:.6e}\n")
        np.savetxt(file, table, fmt="%d,%.5f,%.5f,%d")


home = tempfile.TemporaryDirectory()
folder = pathlib.Path(home.name, "week")
folder.mkdir()
factors = {name: np.exp(BETWEEN["subject"] * rng.standard_normal()) for name in SUBJECTS}
true = {}
for day in DAYS:
    write(folder / f"{day}_98k8.csv", recorded({0: ResistorLoad(98.8e3)}, 30, rng))
    for subject in SUBJECTS:
        of_day = factors[subject] * np.exp(BETWEEN["session"] * rng.standard_normal())
        for site in SITES:
            of_site = of_day * np.exp(BETWEEN["site"] * rng.standard_normal())
            loads = {}
            for row in range(98):
                own = np.exp(BETWEEN["electrode"] * rng.standard_normal() - 15 * PLACES.y[row])
                r_p = 220e3 * of_site * own
                true[subject, site, day, PLACES.electrodes[row]] = r_p
                loads[row + 1] = SkinLoad(r_s=33.4e3, r_p=r_p, c_p=22.3e-6 / r_p)
            table = recorded(loads, 3.1, rng)
            off = np.array_split(np.arange(len(table)), 98)[14]  # of electrode 15
            table[off, 2] = table[off, 1]  # no contact: the output is the unloaded one
            write(folder / f"{subject}_{site}_{day}.csv", table)
print(len(list(folder.iterdir())), "files, such as", min(folder.iterdir()).name)

# %% [markdown]
# ## The calibration, while the resistor is still connected
# `etid import d1_98k8.csv -o d1.h5 --r-load 98k8 …` and `etid calibrate d1.h5 -o driver.h5` say at
# once what the driver is worth: the standard errors to expect of skin, and what would make them
# smaller. On the next day, `--former driver.h5` says whether the driver has moved.

# %%
channels = {"v_th": "CH1", "v_out": "CH2", "scale": SCALE, "pulse_rate": 60.0}
drivers = {}
for day in ("d1", "d2"):
    file = folder.parent / f"{day}.h5"
    etid.import_file(folder / f"{day}_98k8.csv", file, r_load=98.8e3, **channels)
    drivers[day] = etid.calibrate(
        [*etid.read(file).recordings()], order=5, former=drivers["d1"].driver if drivers else None
    )
print(drivers["d2"])

# %% [markdown]
# While a display runs, `etid-live driver_d1.h5 --socket localhost:5555` shows these maps in the
# browser, and a button stops it.
#
# ## From the folder to one file
# The names of the files hold the labels, and the electrodes fire in their order. The calibration of
# a day belongs to the recordings of that day. On the command line:
#
#     etid import week -o week.h5 --labels '{session}_{r_load}.csv' \
#         --labels '{subject}_{site}_{session}.csv' --v-th CH1 --v-out CH2 \
#         --split CH3 --electrode E{1..98} --scale 0.0535 --pulse-rate 60

# %%
study_file, fits_file = folder.parent / "week.h5", folder.parent / "fits.h5"
found = etid.import_folder(
    folder,
    study_file,
    ["{session}_{r_load}.csv", "{subject}_{site}_{session}.csv"],
    split="CH3",
    electrode=[*PLACES.electrodes],
    **channels,
)
print("\n".join(str(found).splitlines()[:4]))

# %% [markdown]
# ## The fits
# `etid fit week.h5 -o fits.h5` fits all of them, each with the driver of its day. `etid report
# fits.h5` writes a page with these maps, and `etid export fits.h5 -o fits.csv --long` a table for
# pandas or R with one row for each element.

# %%
fits = etid.fit_file(study_file, fits_file).fits
print(fits.counts())

# %%
axes = etid.plot(fits, map="r_p")

# %% [markdown]
# All maps have one scale. Electrode 15 has the mark of its verdict, `unconnected`, in each of them;
# of the other 1 164 recordings, one is refused by chance.
#
# ## Over days
# The bars of the fits are their own errors; the thick bars are medians, with the variation between
# the electrodes beyond these errors.

# %%
index = fits.where(site="index")
axes = etid.plot(index, by=("session", "subject"))

# %% [markdown]
# `etid.variation` divides what differs: between subjects, between the days of a subject, between
# the fingers of a day, and between the electrodes of a finger. The errors of the fits are in none
# of them, nor are those of the drivers: each session has a driver of its own. Two subjects say
# little about subjects, and the interval shows it.

# %%
variation = etid.variation(fits, "r_p", driver="session")
print(variation)

# %% [markdown]
# ## Conclusion
# The variation between electrodes is that of the gradient and of the factor that was drawn. The
# errors of single fits are much smaller, so three pulses of each electrode are enough here. To say
# more about people, record more people: more electrodes or pulses do not help.

# %%
home.cleanup()
