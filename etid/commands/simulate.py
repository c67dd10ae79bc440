"""Make synthetic recordings."""

import argparse
import json
import pathlib

from etid.commands import Outcome
from etid.simulation import scenes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Experiment, noise, seed and files."""
    parser.add_argument("preset", choices=list(scenes.PRESETS), help="experiment")
    parser.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="FILE")
    parser.add_argument("--snr-db", type=float, default=60.0, help="default 60; inf for no noise")
    parser.add_argument(
        "--jitter", type=float, default=0.0, metavar="SECONDS", help="rms trigger delay, default 0"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--truth", type=pathlib.Path, metavar="FILE", help="write the true elements as JSON, SI"
    )


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the study, and the truth where it is wanted."""
    scene = scenes.PRESETS[arguments.preset](
        snr_db=arguments.snr_db, trigger_jitter_rms=arguments.jitter
    )
    study = scene.simulate(arguments.seed)
    study.write(arguments.target)
    if arguments.truth is not None:
        arguments.truth.write_text(json.dumps(scene.truth(), indent=1) + "\n", encoding="utf-8")
    text = f"{arguments.target}: {len(study)} recordings"
    return Outcome(text, {"target": arguments.target, "recordings": len(study)})
