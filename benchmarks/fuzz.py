"""Damaged files: how often one crashes or stops its reader, or ends in a wrong error.

A child process damages good files of seven kinds, and reads them. What may come out is an answer or
one `etid.RecordingError`. `--kind KIND --first SEED --files 1` repeats a file.
"""

import argparse
import collections
import multiprocessing
import pathlib
import resource
import signal
import tempfile
from multiprocessing.connection import Connection

import h5py
import numpy as np
import scipy.io

import etid
from benchmarks.rates import Rate, clopper_pearson
from benchmarks.runner import option, show
from benchmarks.specimens import SKIN, study_fits
from etid.recordings import untrusted
from etid.simulation.scenes import ResistorLoad, Scene, SkinLoad, Trial

KINDS = ("etid", "h5py", "fits", "csv", "npz", "mat", "mat5")  # by turns
SECONDS, MEMORY = 5, 4 << 30  # of the processor for one file; bytes of a process
TARGET = 1 / 500  # of the files may crash or stop their reader; none may end in a wrong error
SPECIAL = (0, 1, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1)
MAPPING = {"sample_rate": 2e5, "pulse_rate": 60.0, "scale": 0.0535}
MAPPING |= {to: {"channel": of, "unit": "V"} for to, of in (("v_th", "open"), ("v_out", "skin"))}

OPTIONS = (
    option("--files", default=2000),
    option("--first", default=0, help="first seed"),
    option("--kind", choices=KINDS, help="default: all, by turns"),
    option("--no-guard", default=False, help="without the check of heaps"),
)


def main(arguments: argparse.Namespace) -> bool:
    seeds = range(arguments.first, arguments.first + arguments.files)
    cases = [(arguments.kind or KINDS[seed % len(KINDS)], seed) for seed in seeds]
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    while cases:
        pipe, theirs = multiprocessing.Pipe()
        spawn, given = multiprocessing.get_context("spawn"), (theirs, cases, arguments.no_guard)
        process = spawn.Process(target=child, args=given)
        process.start()
        theirs.close()
        while cases:
            kind, seed = cases.pop(0)
            try:
                outcome = pipe.recv()
            except EOFError:
                process.join()
                outcome = "hang" if process.exitcode == -signal.SIGXCPU else "crash"
            counts[kind][outcome] += 1
            if outcome not in ("read", "refused"):
                print(f"{kind} {seed}: {outcome}")
            if process.exitcode is not None:
                break
    total = sum(counts.values(), collections.Counter[str]())
    for kind, own in {**counts, "all": total}.items():
        show({"kind": kind, "files": own.total(), **own})
    lost, n = total["hang"] + total["crash"], total.total()
    wrong = n - lost - total["read"] - total["refused"]
    for name, count, most in (("crash or hang", lost, TARGET), ("wrong error", wrong, 0.0)):
        print(f"{name}: {Rate(count / n, *clopper_pearson(count, n), n)}, at most {most:.1%}")
    return lost <= TARGET * n and wrong == 0


def child(pipe: Connection, cases: list[tuple[str, int]], no_guard: bool) -> None:
    """Damage and read files; what comes of each goes into the pipe."""
    if no_guard:
        untrusted.Guarded._follow = lambda self, heap: None
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    with tempfile.TemporaryDirectory() as folder:
        good = good_files(pathlib.Path(folder))
        for kind, seed in cases:
            most = int(sum(resource.getrusage(resource.RUSAGE_SELF)[:2])) + SECONDS + 1
            resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
            pipe.send(judge(pathlib.Path(folder), kind, good[kind], seed))


def judge(folder: pathlib.Path, kind: str, good: bytes, seed: int) -> str:
    """What comes of a damaged file: `read`, `refused`, or the name of a wrong error."""
    suffix = ".h5" if kind in KINDS[:3] else f".{kind.rstrip('5')}"
    path = folder / f"{seed}{suffix}"
    path.write_bytes(damaged(good, np.random.default_rng(seed)))
    try:
        if kind == "fits":
            str(etid.Fits.read(path))
        elif suffix == ".h5":
            etid.check(path)
            with etid.read(path) as study:
                list(study.recordings())
        else:
            etid.import_file(path, folder / "out.h5", MAPPING)
    except etid.RecordingError as error:
        return "refused" if path.stem in str(error) else "unnamed"
    except Exception as error:
        return type(error).__name__
    return "read"


def damaged(good: bytes, rng: np.random.Generator) -> bytes:
    """Flip, overwrite, clear, move, delete or cut bytes, one to four times; often early ones."""
    data = bytearray(good)
    for _ in range(int(rng.integers(1, 5))):
        near = min(len(data), 4096) if rng.random() < 0.5 else len(data)
        size, long = 2 ** int(rng.integers(4)), int(rng.integers(1, 512))
        at, other = (int(rng.integers(most + 1)) // size * size for most in (near, len(data)))
        value = SPECIAL[int(rng.integers(len(SPECIAL)))] if rng.random() < 0.5 else other
        number = (value % 256**size).to_bytes(size, "little")
        changes = (
            *((1, rng.bytes(1)), (size, number), (long, bytes(long))),
            *((long, data[other : other + long]), (long % 64, b""), (len(data), b"")),
        )
        count, new = changes[int(rng.choice(6, p=[0.3, 0.3, 0.1, 0.15, 0.1, 0.05]))]
        data[at : at + count] = new
    return bytes(data)


def good_files(folder: pathlib.Path) -> dict[str, bytes]:
    """The bytes of a good file of each kind."""
    names = ("ours.h5", "theirs.h5", "fits.h5", "a.csv", "a.npz", "mat.h5", "a.mat")
    ours, theirs, fits, table, npz, mat, mat5 = files = [folder / name for name in names]
    trials = tuple(Trial(f"s01/dry/{i}", SkinLoad(**SKIN), subject="s01") for i in range(3))
    known = (Trial("calibration/0", ResistorLoad(98.8e3)),)
    Scene(trials, known, samples=3400).simulate(seed=1).write(ours)
    with h5py.File(ours) as source, h5py.File(theirs, "w") as target:
        for name in source:
            source.copy(name, target)
        places = ["/"]
        source.visit(places.append)
        for place in places:  # texts of variable length, as h5py writes them by itself
            for name, value in source[place].attrs.items():
                text = np.asarray(value).dtype.kind == "S"
                target[place].attrs[name] = value.astype(object) if text else value
    study_fits().write(fits)
    th, out = np.random.default_rng(7).normal(size=(2, 400))
    np.savetxt(table, np.stack([th, out], 1), "%.6f", ",", header="open,skin", comments="")
    np.savez_compressed(npz, open=th, skin=out)
    cells = np.array([th, {"s": out}], object)
    scipy.io.savemat(mat5, {"open": th, "skin": out, "cells": cells})
    with h5py.File(mat, "w", userblock_size=512) as file:
        file["open"], file["skin"] = th[:, None], out[:, None]
    return {kind: path.read_bytes() for kind, path in zip(KINDS, files, strict=True)}
