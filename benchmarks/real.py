"""Recordings of real instruments: which are usable, and how far from SciPy's fits and the makers'.

They are a model cell of patch clamp (the held voltage steps, the current passes a filter of
Bessel), pairs of electrodes on tissue, pulses of batteries, and soldered circuits. What others
fitted or state stands in the `SOURCE.txt` of each folder.
"""

import argparse
import pathlib
from collections.abc import Mapping

import h5py
import numpy as np
import scipy.io

import etid
from benchmarks.runner import Target, option, report

FILTER = "bessel 4 2000"  # of the current of the model cell, by its recorder
WIDTH = 100.0  # [Hz] of the corner: 5 %
# SciPy's fit of the mean sweep with a free corner (1907 Hz), and the maker's values.
CELL = {"r_s": 11.03e6, "r_p": 497.6e6, "c_p": 32.63e-12}
MAKER = {"r_p": (500e6, 0.01), "c_p": (33e-12, 0.10)}
SOLDERED = {"Circuit1": (29.14, 46.65, 10.43e-6), "Circuit2": (150.3, 502.5, 31.13e-9)}
NEAR = 0.01  # of SciPy's values
SCATTER = 1.3  # of 20 replicates, relative to ±; below it in 98 of 100 sets

OPTIONS = (
    option("--data", default=pathlib.Path("../shared/data"), help="folder of the recordings"),
    option("--sweeps", default=20, help="of the model cell, each fitted alone"),
    option("--pairs", default=5, help="of electrodes on tissue"),
)


def held(command: np.ndarray) -> np.ndarray:
    """What a converter makes of these samples that it holds, below half the rate."""
    f = np.fft.rfftfreq(command.size)
    of_hold = np.sinc(f) * np.exp(-1j * np.pi * f)
    return np.fft.irfft(np.fft.rfft(command) * of_hold, command.size)


def cell_recordings(folder: pathlib.Path, filter: str | None) -> list[etid.Recording]:
    """The model cell: the mean of its sweeps, then each of them."""
    with h5py.File(folder / "patch_clamp_model_cell" / "model_vc_step.h5") as file:
        rate = float(np.asarray(file.attrs["sampling_rate_hz"]))
        sweeps = 1e-12 * np.asarray(file["current_pA"], float)
        command = 1e-3 * np.asarray(file["command_mV"], float)[0]
    v_out = held(command - command[0])
    of = {"sample_rate": rate, "pulse_rate": rate / command.size, "current_filter": filter}
    return [etid.Recording(v_out=v_out, current=i, **of) for i in (sweeps.mean(0), *sweeps)]


def tissue_recordings(folder: pathlib.Path) -> dict[str, etid.Recording]:
    """Pairs of electrodes; the edges of the current, which was commanded, are those of V_out."""
    file = folder / "ecog_stim" / "20f8a3_stimOutput.mat"
    pairs = scipy.io.loadmat(file, simplify_cells=True)["dataStruct"]
    found = {}
    for name, pair in pairs.items():
        mean, rest = pair["stim_data"].mean(1), 15  # samples before the pulse
        v_out = np.concatenate([np.tile(mean[:rest], 3), mean]) - mean[:rest].mean()
        first, second, end = np.sort(np.argsort(abs(np.diff(v_out)))[-3:]) + 1
        current = np.zeros(v_out.size)
        current[first:second], current[second:end] = (
            sign * 1e-6 * float(pair["stim_current"]) for sign in (1, -1)
        )
        rate = 24414.0625
        of = {"sample_rate": rate, "pulse_rate": rate / v_out.size, "path": name}
        found[name] = etid.Recording(v_out=v_out, current=held(current), **of)
    return found


def battery(folder: pathlib.Path) -> etid.Recording:
    """One pulse of a battery, interpolated to even times, in volts and kiloamperes."""
    file = folder / "battery_pulses" / "LGM50_5Ah_Pulse.mat"
    of = scipy.io.loadmat(file, simplify_cells=True)["LGM50_5Ah_Pulse"]["T25"]["SoC5"]["Cell1"]
    t, i, v = (np.asarray(of["data"][name]) for name in ("ProgTime", "Current", "Voltage"))
    # The first sample of each step pairs the new voltage with the old current.
    kept = np.append(True, (np.asarray(of["data"]["StepTime"])[1:] > 0) & (np.diff(t) > 0))
    at = np.arange(t[kept][0], t[kept][-1], 0.1)
    v_out, current = (np.interp(at, t[kept], one[kept]) for one in (v, 1e-3 * i))
    return etid.Recording(
        v_out=v_out, current=current, sample_rate=10.0, pulse_rate=10 / at.size, hold="zero"
    )


def off(fit: etid.Fit, of: Mapping[str, float]) -> float:
    """Largest relative distance of an element from these values."""
    return max(abs(float(getattr(fit.circuit, name)) / one - 1) for name, one in of.items())


def main(arguments: argparse.Namespace) -> bool:
    folder, targets = arguments.data, []
    if not folder.exists():
        print(f"skipped: no recordings at {folder}; pass their folder with --data")
        return True

    def shown(name: str, fit: etid.Fit) -> etid.Fit:
        head = f"{name}: {type(fit.circuit).__name__}, {fit.verdict}, leaves {float(fit.rrse):.2%}"
        print(f"{head}; {', '.join(fit.elements)}", flush=True)
        return fit

    corner = f"{FILTER} {WIDTH:g}"
    for filter in (corner, FILTER, None):
        mean = cell_recordings(folder, filter)[0]
        found = shown(f"model cell, filter {filter}", etid.identify_skin(mean, throw=False))
        if filter == corner:
            targets.append(Target("model cell: usable", float(found.usable), 1.0))
            targets.append(Target("model cell: off SciPy's fit", off(found, CELL), most=NEAR))
            for name, (value, tolerance) in MAKER.items():
                far = off(found, {name: value}) / tolerance
                targets.append(Target(f"model cell: {name} in the maker's tolerances", far, most=1))
    sweeps = cell_recordings(folder, FILTER)[1 : arguments.sweeps + 1]
    fits = etid.identify_skins([one.replace(path=str(n)) for n, one in enumerate(sweeps)])
    usable = np.asarray(fits.fit.usable)
    targets.append(Target("sweeps of the model cell: usable", float(usable.mean()), 1.0))
    for name in CELL:
        both = fits.circuit, fits.stderr
        values, errors = (np.asarray(getattr(of, name))[usable] for of in both)
        scatter, error = float(values.std(ddof=1)), float(np.median(errors))
        print(f"sweeps, {name}: mean {values.mean():.4g}, scatter {scatter:.2g}, ± {error:.2g}")
        named = f"sweeps of the model cell: scatter of {name} over ±"
        targets.append(Target(named, scatter / error, most=SCATTER))
    for name, one in list(tissue_recordings(folder).items())[: arguments.pairs]:
        shown(name, etid.identify_skin(one, throw=False))
        fit = shown(f"{name}, chosen", etid.identify_skin(one, circuit="auto", throw=False))
        targets.append(Target(f"{name}: usable", float(fit.usable), 1.0))
    for circuit in ("R0-p(R1,C1)", "R0-p(R1,CPE1)"):
        fit = etid.identify_skin(battery(folder), circuit=circuit, throw=False)
        shown("battery (kA)", fit)
    for path in sorted((folder / "dummy_circuits_eis").glob("*.z")):
        fit = shown(path.stem, etid.identify_impedance(*etid.read_impedance(path), throw=False))
        of = dict(zip(fit.circuit.names(), SOLDERED[path.stem.split("_")[0]], strict=True))
        targets.append(Target(f"{path.stem}: off SciPy's fit", off(fit, of), most=NEAR))
    return report(targets)
