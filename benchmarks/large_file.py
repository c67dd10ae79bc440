"""A file of any number of recordings, made quickly: a hundred waveforms, each time with new noise.

Stacks of a thousand trials in the layouts that h5py users get, or a group for each recording; int16
as converters give them, and one calibration with an unloaded record of its own.
"""

import dataclasses
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from etid.recordings.replacing import replacing
from etid.simulation.scenes import Scene, paper_subjects

SAMPLES = 5_000
SAMPLE_RATE = 100e3  # [Hz], at which they are three periods of 60 Hz
STACK = 1_000  # trials in a group
SEED = 4
JITTER = 50e-9  # [s]
LAYOUTS: Mapping[str, Mapping[str, Any]] = {
    "contiguous": {},
    "chunked": {"chunks": True},
    "gzip": {"chunks": True, "compression": "gzip"},
    "groups": {},
}
SIGNALS = ("v_th", "v_out")


def large_file(folder: pathlib.Path, recordings: int, layout: str) -> pathlib.Path:
    """The file, made unless it is there."""
    path = folder / f"{layout}-{recordings}.h5"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    size, free = 4 * SAMPLES * recordings, shutil.disk_usage(folder).free
    if free < 1.2 * size:
        raise SystemExit(f"{path} needs {size / 1e9:.1f} GB, {folder} has {free / 1e9:.1f} GB left")
    scene = paper_subjects(
        sample_rate=SAMPLE_RATE, samples=SAMPLES, snr_db=60.0, trigger_jitter_rms=JITTER
    )
    with replacing(path) as partial:
        dataclasses.replace(scene, trials=()).simulate(SEED).write(partial)  # the calibration
        with h5py.File(partial, "a", libver="v108") as file:
            stack = 1 if layout == "groups" else STACK
            _append(file, scene, recordings, stack, LAYOUTS[layout])
    return path


def _append(
    file: h5py.File, scene: Scene, recordings: int, size: int, layout: Mapping[str, Any]
) -> None:
    """Write the loaded recordings, so many at a time."""
    assert scene.bits is not None
    step = scene.full_scale / 2 ** (scene.bits - 1)  # volts at the converter
    clean = dataclasses.replace(scene, snr_db=None, bits=None)
    records = list(clean.simulate(SEED).loaded.recordings())
    codes = {
        name: np.stack([record.samples[name].stored / step for record in records]).astype("f4")
        for name in SIGNALS
    }
    unrounded = dataclasses.replace(scene, bits=None)
    sigma = np.float32(unrounded.waveform().sigma * scene.scale / step)
    draws = np.random.default_rng(SEED)
    for first in range(0, recordings, size):
        rows = np.arange(first, min(first + size, recordings))
        subject = f"s{first // STACK:04d}"
        group = file.create_group(f"{subject}/skin/{first}" if size == 1 else f"{subject}/skin")
        group.attrs.update(kind="loaded", sample_rate=SAMPLE_RATE, pulse_rate=scene.pulse_rate)
        group.attrs.update(subject=subject, condition="skin")
        for name in SIGNALS:
            noisy = sigma * draws.standard_normal((rows.size, SAMPLES), dtype=np.float32)
            noisy += codes[name][rows % len(records)]
            data = np.rint(noisy[0] if size == 1 else noisy).astype("i2")
            stack = group.create_dataset(name, data=data, **layout)
            stack.attrs.update(unit="volt", conversion=step / scene.scale)
