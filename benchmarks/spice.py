"""Every SPICE scene, imported and fitted by every method, against truth and the Cramer-Rao bound.

Truth and bound come from `truth.json` beside the recordings. Bias and spread are of all fits
whatever their verdict: a verdict must not flatter the numbers. `sd` is the median standard error
that the method itself reports.
"""

import argparse
import contextlib
import json
import pathlib
import tempfile
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

import etid
from benchmarks.machine import write_csv
from benchmarks.runner import option, show
from etid.circuits.circuit import AbstractCircuit
from etid.estimators.registry import named, names
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad, TransformerDriver

FOLDER = "spice_recordings"  # in the folder of all data
BOUND = "crb_rel_with_delays"  # the trigger delays being unknown, as they are to the fits
ELEMENTS = {"r_s": "Rs", "r_p": "Rp", "c_p": "Cp", "r": "R"}
# Names of the transformer's parts in `truth.json`.
PARTS = {
    "Vp": "amplitude", "tr": "edge", "td": "lead_in", "Rsrc": "r_source", "Cpri": "c_primary",
    "Rpw": "r_primary", "Llp": "l_primary", "Lm": "l_magnetising", "Rcore": "r_core", "n": "turns",
    "Rsw": "r_secondary", "Lls": "l_secondary", "Csec": "c_secondary", "Cww": "c_winding",
    "Rprot": "r_protection", "Ccab": "c_cable", "Rmeas": "r_divider", "Cmeas": "c_divider",
}  # fmt: skip


def scene_of(truth: dict) -> Scene:
    """The scene of which one SPICE recording is a draw; one unloaded record for all its trials."""
    trials = []
    for i, trial in enumerate(truth["trials"]):
        values = {name: trial["elements"].get(key) for name, key in ELEMENTS.items()}
        if values["r"] is not None:
            load: SkinLoad | ResistorLoad = ResistorLoad(values["r"])
        else:
            load = SkinLoad(values["r_s"], values["r_p"], values["c_p"])
        trials.append(Trial(f"loaded/{i}", load))
    return Scene(
        tuple(trials),
        tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(truth["R_ref"])),
        TransformerDriver(**{PARTS[name]: value for name, value in truth["circuit"].items()}),
        sample_rate=truth["fs"],
        samples=truth["samples"],
        snr_db=None if truth["snr_db"] is None else float(truth["snr_db"]),
        trigger_jitter_rms=truth["trigger_jitter_rms"],
        offset_rms=truth["offset_rms"],
        full_scale=truth["full_scale"],
        shared_v_th=True,
    )


JOINT = "joint"
ESTIMATORS: tuple[str, ...] = (*names(), JOINT)


DATA = option(
    "--data",
    default=pathlib.Path("../shared/data"),
    help=f"folder that has {FOLDER}/, recordings with known truth",
)
OPTIONS = (
    DATA,
    option("--scene", action="append", help="only this scene; may be repeated"),
    option("--method", action="append", choices=ESTIMATORS, help="only this; repeatable"),
    option("-o", "--output", type=pathlib.Path, help="CSV to write"),
)


def mapping_of(source: pathlib.Path) -> dict[str, Any]:
    """The mapping of a SPICE recording, whose archive has codes, resistors, rates and a scale.

    It has no unloaded records for the calibrations: they share the first.
    """
    with np.load(source) as archive:
        resistors = archive["R_ref"]
        rate, pulses, step, scale = (float(archive[name]) for name in ("fs", "f0", "lsb", "scale"))
        codes = np.iinfo(archive["adc_th"].dtype)

    def signal(name: str, **rows: int) -> dict[str, Any]:
        return {"channel": name, "unit": "V", **rows}

    paths = [f"calibration/{number}" for number in range(len(resistors))]
    calibrations = [
        {
            "path": path,
            "r_load": float(resistors[number]),
            "v_th": signal("adc_th", rows=0),
            "v_out": signal("adc_ref", rows=number),
        }
        for number, path in enumerate(paths)
    ]
    trials = {"v_th": signal("adc_th"), "v_out": signal("adc_out")}
    return {
        "sample_rate": rate,
        "pulse_rate": pulses,
        "scale": scale / step,  # codes per volt at the terminal
        "adc_range": (codes.min * step / scale, codes.max * step / scale),
        "condition": source.stem,
        "recording": [*calibrations, {"path": "loaded", "calibration": paths, **trials}],
    }


@contextlib.contextmanager
def imported(source: pathlib.Path) -> Iterator[etid.Study]:
    """A SPICE recording as a study."""
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder, "study.h5")
        etid.import_file(source, file, mapping_of(source))
        with etid.read(file) as study:
            yield study


def fit_scene(source: pathlib.Path, truth: dict, method: str) -> list[dict]:
    """One row per element: bias, spread, bound, reported standard error, all relative, in %."""
    trials = truth["trials"]
    is_resistor = "R" in trials[0]["elements"]
    circuit: AbstractCircuit = etid.Resistor() if is_resistor else etid.SkinRC()
    if is_resistor and method != JOINT and not named(method).any_circuit:
        return []  # Steiglitz-McBride is written for the skin
    with imported(source) as study:
        if method == JOINT:
            result = etid.identify_jointly(study, circuit=circuit)
        else:
            result = etid.identify_study(study, circuit=circuit, method=method)
    fits = result.fits
    fits = fits.take(np.argsort([int(path.rsplit("/", 1)[1]) for path in fits.labels["path"]]))
    driver = next(iter(result.drivers.values()), None)
    verdicts, rows = Counter(fits.verdicts.tolist()), []
    for i, name in enumerate(circuit.names()):
        true = np.array([trial["elements"][ELEMENTS[name]] for trial in trials])
        error = 100 * (np.asarray(getattr(fits.circuit, name)) / true - 1)
        stderr = 100 * np.asarray(getattr(fits.stderr, name)) / true
        bounds = [100 * trial[BOUND][i] for trial in trials if BOUND in trial]
        bound = float(np.median(bounds)) if bounds else np.nan
        finite = error[np.isfinite(error)]
        own = np.fmax(np.nan_to_num(stderr), np.nan_to_num(bound))
        rows.append(
            {
                "scene": source.stem,
                "method": method,
                "driver": driver.verdict if driver else "refused",
                "fits": len(fits),
                "finite": finite.size,
                "successful": verdicts["successful"],
                "verdicts": " ".join(f"{k}:{v}" for k, v in sorted(verdicts.items())),
                "chi2": float(np.nanmedian(fits.chi2)) if finite.size else np.nan,
                "element": name,
                "bias": float(finite.mean()) if finite.size else np.nan,
                "spread": float(finite.std(ddof=1)) if finite.size > 1 else np.nan,
                "rms": float(np.sqrt(np.mean(finite**2))) if finite.size else np.nan,
                "bound": bound,
                "sd": float(np.nanmedian(stderr)) if np.isfinite(stderr).any() else np.nan,
                # Called usable, and wrong by more than 5 bounds and 5 of its own errors.
                "silent": int(np.sum(fits.fit.usable & (np.abs(error) > 5 * own))),
            }
        )
    return rows


def main(arguments: argparse.Namespace) -> bool:
    folder = arguments.data / FOLDER
    if not folder.exists():
        raise SystemExit(f"no SPICE recordings at {folder}; pass their parent folder with --data")
    truth = json.loads((folder / "truth.json").read_text())["scenes"]
    table: list[dict] = []
    for name in arguments.scene or truth:
        for method in arguments.method or ESTIMATORS:
            for row in fit_scene(folder / f"{name}.npz", truth[name], method):
                table.append(row)
                show(row)
    if arguments.output is not None and table:
        write_csv(arguments.output, table)
    return True
