"""Simulate recordings of an experiment."""

import argparse
import json
import pathlib

from etid.commands import Outcome
from etid.printing import several
from etid.recordings.replacing import HDF5, replace_text
from etid.simulation import scenes
from etid.simulation.displays import ELECTRODES, write_stream

# No recording of any preset is refused by chance, as one in 10 000 is by each test.
SEED = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: experiment, noise, jitter, seed, and files."""
    parser.add_argument("preset", choices=list(scenes.PRESETS), help="experiment to simulate")
    parser.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="FILE")
    parser.add_argument(
        "--snr-db",
        type=float,
        default=60.0,
        help="signal-to-noise ratio [dB], default 60; inf: no noise",
    )
    parser.add_argument(
        "--jitter",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="rms of the trigger delay, default 0",
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, help=f"of noise and delays, default {SEED}"
    )
    parser.add_argument(
        "--truth",
        type=pathlib.Path,
        metavar="FILE",
        help="also write the true elements, as JSON in SI units",
    )
    parser.add_argument(
        "--stream",
        type=pathlib.Path,
        metavar="FILE",
        help="also write pulses of a display with this skin, for etid-live --file",
    )


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The files of recordings, of the true elements and of the stream."""
    truth = {} if arguments.truth is None else {arguments.truth: (".json",)}
    stream = {} if arguments.stream is None else {arguments.stream: HDF5}
    return {arguments.target: HDF5, **truth, **stream}


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the recordings; true elements with --truth; pulses of a display with --stream."""
    scene = scenes.PRESETS[arguments.preset](
        snr_db=arguments.snr_db, trigger_jitter_rms=arguments.jitter
    )
    study = scene.simulate(arguments.seed)
    streamed = {}
    if arguments.stream is not None:
        streamed["pulses"] = write_stream(scene, arguments.stream, arguments.seed)
    study.write(arguments.target)
    if arguments.truth is not None:
        replace_text(arguments.truth, json.dumps(scene.truth(), indent=1) + "\n")
    text = f"{arguments.target}: {several(len(study), 'recording')}"
    if streamed:
        text += f"\n{arguments.stream}: {streamed['pulses']} pulses at {ELECTRODES} electrodes"
    return Outcome(text, {"target": arguments.target, "recordings": len(study), **streamed})
