"""Good files of every kind that etid reads, how to damage them, and everything that reads them."""

import contextlib
import dataclasses
import io
import json
import pathlib
import tempfile
from collections.abc import Callable
from typing import Any

import h5py
import jax.numpy as jnp
import numpy as np

import etid
from benchmarks import damage
from benchmarks.damage import Rng
from benchmarks.damage_hdf5 import restructure
from etid import cli
from etid.identify.options import Options
from etid.recordings.preflight import Inspected, preflight
from etid.results.driver import Calibration, ContinuousDriver, SourceImpedance
from etid.results.study_fits import StudyFits
from etid.results.verdicts import message, verdict, verdicts_of
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

SKIN = {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}
PAGES = 40  # of so many files of fits one is also drawn, which takes a second
MAPPING = b"""
sample_rate = 2.0e5
pulse_rate = 60.0
scale = 0.0535
subject = "s01"
condition = "dry"
v_th = {channel = "open", unit = "V"}
v_out = {channel = "skin", unit = "V", scale = 0.05}
[[recording]]
path = "s01/dry"
trial = "0"
"""


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file."""

    suffix: str  # of its name
    good: tuple[bytes, ...]  # the bytes of good files
    damage: Callable[[pathlib.Path, Rng], None]  # change the file at a path
    # read it in every way there is; what is raised is for the caller to judge
    use: Callable[[pathlib.Path, int], None]


def kinds() -> dict[str, Kind]:
    """All kinds by name; makes the good files."""
    with tempfile.TemporaryDirectory() as folder:
        place = pathlib.Path(folder)
        stored = _recordings(place)
        found = {
            "recordings": Kind(".h5", stored, _either, _use_recordings),
            "fits": Kind(".h5", _fits(place), _either, _use_fits),
            "mapping": Kind(".toml", (MAPPING,), _by(damage.damaged_toml), _use_mapping),
            "csv": Kind(".csv", (_table(),), _by(damage.damaged_text), _use_import),
            "npz": Kind(".npz", (_archive(),), _by(damage.damaged_npz), _use_import),
            "matlab": Kind(".mat", (_matlab73(place),), _either, _use_import),
        }
        extras = {"matlab5": (".mat", _matlab5), "tdms": (".tdms", _tdms), "abf": (".abf", _abf)}
        for name, (suffix, make) in extras.items():
            with contextlib.suppress(ImportError):
                found[name] = Kind(suffix, (make(place),), _bytes, _use_import)
    return found


def _by(change: Callable[[bytes, Rng], bytes]) -> Callable[[pathlib.Path, Rng], None]:
    def write(path: pathlib.Path, rng: Rng) -> None:
        path.write_bytes(change(path.read_bytes(), rng))

    return write


_bytes = _by(damage.damaged)


def _either(path: pathlib.Path, rng: Rng) -> None:
    if rng.random() < 0.5:
        restructure(path, rng)
        if rng.random() < 0.8:
            return
    _bytes(path, rng)


def _recordings(folder: pathlib.Path) -> tuple[bytes, ...]:
    """The same study as etid writes it, and as other programs write it."""
    trials = tuple(Trial(f"s01/dry/{i}", SkinLoad(**SKIN)) for i in range(3))
    trials += (Trial("s02/dry", SkinLoad(**SKIN)),)
    scene = Scene(trials, (Trial("calibration/0", ResistorLoad(98.8e3)),), samples=3400)
    path, others = folder / "etid.h5", folder / "other.h5"
    scene.simulate(seed=1).write(path)
    with h5py.File(path) as ours, h5py.File(others, "w", libver="earliest") as theirs:
        theirs.attrs.update(ours.attrs)
        ours.visititems(lambda name, item: _copied(theirs, name, item))
    return path.read_bytes(), others.read_bytes()


def _copied(target: h5py.File, name: str, item: Any) -> None:
    """An object as h5py writes it by itself: texts of variable length, samples compressed."""
    if isinstance(item, h5py.Group):
        new: Any = target.require_group(name)
    else:
        new = target.create_dataset(name, data=item[()], chunks=True, compression="gzip")
    for key, value in item.attrs.items():
        new.attrs[key] = value.astype(object) if np.asarray(value).dtype.kind == "S" else value


def _use_recordings(path: pathlib.Path, seed: int) -> None:
    problems = etid.check(path)
    with etid.read(path) as study:
        repr(study)
        study.where(subject="s01")
        for name in study:
            with contextlib.suppress(etid.RecordingError):
                preflight(Inspected.of(study[name]), periodic=True)
        for name in study.problems:
            str(study.problems[name])
        if problems == [] and seed % 4 == 0:
            study.write(path.with_suffix(".copy"))
    if seed % 3:
        return
    for arguments in (["check", str(path), "--json"], ["check", str(path)]):
        with contextlib.redirect_stdout(io.StringIO()) as out, \
                contextlib.redirect_stderr(io.StringIO()):  # fmt: skip
            cli.main(arguments)
        if "--json" in arguments:
            json.loads(out.getvalue())


def study_fits() -> StudyFits:
    """Fits by hand of six recordings, with a driver and one that failed."""
    names = ["successful"] * 4 + ["misfit", "flat"]
    values = np.array([1.0, 1.1, 0.9, 1.0, 1.3, np.nan])[:, None] * np.array(list(SKIN.values()))
    shared, own = (np.einsum("ni,ij->nij", (e * values) ** 2, np.eye(3)) for e in (0.02, 0.01))
    labels = {
        "path": np.array([f"loaded/{i}" for i in range(6)]),
        "subject": np.array(["s01", "s02"] * 3),
        "condition": np.array(["dry"] * 6),
        "electrode": np.array(["1"] * 6),
        "trial": np.array(list("012345")),
    }
    fit = etid.Fit(
        circuit=etid.SkinRC(*values.T),
        cov=own + shared,
        shared_cov=shared,
        rrse=np.full(6, 0.02),
        chi2=np.full(6, 1.0),
        result=verdicts_of(np.array(names)),
        steps=np.full(6, 5),
        method="maximum_likelihood",
        remarks=np.zeros(6, int),
    )
    fits = etid.Fits(fit, labels, np.array([message(name) for name in names]))
    numbers = (np.log(5e3), [np.log(4e5)], [np.log(0.3)], [5e3], [2e3], [np.log(6e2)], [-3e3])
    driver = ContinuousDriver(
        b=jnp.ones(3),
        a=jnp.ones(4),
        sample_rate=2e5,
        source=SourceImpedance(*map(jnp.asarray, numbers)),
        cov=1e-4 * jnp.eye(7),
        calibration=Calibration(jnp.array([98.8e3]), jnp.zeros(1), jnp.array(np.nan)),
        rrse=jnp.array(0.003),
        chi2=jnp.array(1.1),
        result=verdict("successful"),
        steps=jnp.array(9),
        method="maximum_likelihood",
    )
    settings = Options((etid.SkinRC(),)).settings(etid.Study.from_recordings([]), 6)
    return StudyFits(fits, {("calibration/0",): driver}, {("calibration/1",): "flat"}, settings)


def _fits(folder: pathlib.Path) -> tuple[bytes, ...]:
    study_fits().write(folder / "fits.h5")
    study_fits().fits.write(folder / "alone.h5")
    return (folder / "fits.h5").read_bytes(), (folder / "alone.h5").read_bytes()


def _use_fits(path: pathlib.Path, seed: int) -> None:
    def read() -> None:
        fits = etid.Fits.read(path)
        "".join(map(str, (fits, fits[0], fits.table(), fits.summary("subject"))))
        fits.where(condition="dry").usable()

    def written() -> None:
        StudyFits.read(path).write(path.with_suffix(".again"))

    circuit = path.with_suffix(".cir" if seed % 2 else ".json")
    uses: list[Callable[[], Any]] = [
        read,
        written,
        lambda: etid.export_fits(path, path.with_suffix(".csv" if seed % 2 else ".parquet")),
        lambda: etid.export_circuit(path, circuit, "loaded/0"),
    ]
    if seed % PAGES == 0:
        uses.append(lambda: etid.write_report(path, path.with_suffix(".html")))
    each(uses)


def each(uses: list[Callable[[], Any]]) -> None:
    """All of them, whichever ends in an error that is ours; then the first of those."""
    first = None
    for use in uses:
        try:
            use()
        except etid.RecordingError as error:
            first = first or error
    if first is not None:
        raise first


def _use_mapping(path: pathlib.Path, seed: int) -> None:
    del seed
    source = path.with_suffix(".csv")
    source.write_bytes(_table())
    etid.import_file(source, path.with_suffix(".out"), path)


def _use_import(path: pathlib.Path, seed: int) -> None:
    del seed
    names = {".tdms": ("rig/open", "rig/skin"), ".abf": ("channel 0", "channel 0")}
    v_th, v_out = names.get(path.suffix, ("open", "skin"))
    mapping: dict[str, Any] = {"sample_rate": 2e5, "pulse_rate": 60.0, "scale": 0.0535}
    mapping["v_th"] = {"channel": v_th, "unit": "V"}
    mapping["v_out"] = {"channel": v_out, "unit": "V"}
    told = path.suffix == ".npz"  # such a file says all of it
    etid.import_file(path, path.with_suffix(".out"), None if told else mapping)


def _numbers() -> np.ndarray:
    return np.random.default_rng(7).normal(size=(2, 400))


def _table() -> bytes:
    rows = "\n".join(f"{a:.6f},{b:.6f}" for a, b in _numbers().T)
    return f"open,skin\n{rows}\n".encode()


def _archive() -> bytes:
    codes = (1000 * _numbers()).astype("i2")[:, None, :].repeat(2, axis=1)
    buffer = io.BytesIO()
    numbers = {"R_ref": np.array([98.8e3, 2e5]), "fs": 2e5, "f0": 60.0, "lsb": 3e-4}
    np.savez_compressed(
        buffer, adc_th=codes[0], adc_out=codes[1], adc_ref=codes[1], **numbers, scale=0.0535
    )
    return buffer.getvalue()


def _matlab73(folder: pathlib.Path) -> bytes:
    path = folder / "rig.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in zip(("open", "skin"), _numbers(), strict=True):
            file[name] = np.atleast_2d(values).T
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file.create_group("about")["rate"] = np.array([[2e5]])
        file["#refs#/0"], file["#refs#/1"] = _numbers()
        file["cells"] = np.array([[file["#refs#/0"].ref], [file["#refs#/1"].ref]], h5py.ref_dtype)
        file["cells"].attrs["MATLAB_class"] = np.bytes_("cell")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path.read_bytes()


def _matlab5(_: pathlib.Path) -> bytes:
    import scipy.io

    buffer = io.BytesIO()
    open_, skin = _numbers()
    cells = np.array([open_, {"skin": skin}], object)
    content = {"open": open_, "skin": skin, "about": {"rate": 2e5}, "cells": cells}
    scipy.io.savemat(buffer, content)
    return buffer.getvalue()


def _tdms(folder: pathlib.Path) -> bytes:
    from nptdms import ChannelObject, TdmsWriter

    path = folder / "rig.tdms"
    with TdmsWriter(path) as writer:
        signals = zip(("open", "skin"), _numbers(), strict=True)
        own = {"unit_string": "V", "wf_increment": 5e-6}
        writer.write_segment([ChannelObject("rig", name, data, own) for name, data in signals])
    return path.read_bytes()


def _abf(folder: pathlib.Path) -> bytes:
    from pyabf.abfWriter import writeABF1

    path = folder / "rig.abf"
    writeABF1(_numbers(), str(path), 200e3, "V")
    return path.read_bytes()
