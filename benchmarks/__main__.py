"""Entry point: `python -m benchmarks NAME`."""

import argparse
import pathlib
import sys
import tempfile

import jax

from benchmarks.spice import ESTIMATORS
from etid.methods import METHODS

FILES = pathlib.Path(tempfile.gettempdir()) / "etid-scale"


def main() -> None:
    """Run one benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    names = parser.add_subparsers(dest="name", required=True)

    spice = names.add_parser(
        "spice", help="bias and spread against truth and bound, per SPICE scene"
    )
    spice.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/data"))
    spice.add_argument("--scene", action="append", help="only this scene; may be repeated")
    spice.add_argument(
        "--method", action="append", choices=ESTIMATORS, help="only this; repeatable"
    )
    spice.add_argument("-o", "--output", type=pathlib.Path, default=None, help="CSV to write")

    timing = names.add_parser("timing", help="import time, first call, warm fit, batch, all apart")
    timing.add_argument("--lanes", type=int, default=98)

    coverage = names.add_parser("coverage", help="Monte Carlo of errors, bias and intervals")
    coverage.add_argument("--snr-db", type=float, default=60.0)
    coverage.add_argument("--samples", type=int, default=10_000)
    coverage.add_argument("--repetitions", type=int, default=200)
    coverage.add_argument("--jitter", type=float, default=50e-9, help="rms trigger delay [s]")
    coverage.add_argument("--resistors", type=float, nargs="+", default=[98.8e3], help="[ohm]")
    coverage.add_argument("--shared", action="store_true", help="one unloaded record for all")
    coverage.add_argument("--method", choices=ESTIMATORS, help="default: that of the records")
    coverage.add_argument("--more", type=int, default=0, help="further trials, for a joint fit")
    coverage.add_argument("--spice", metavar="SCENE", help="draw this SPICE recording afresh")
    coverage.add_argument("--data", type=pathlib.Path, default=pathlib.Path("../shared/data"))

    speed = names.add_parser("speed", help="ratios against what one would use instead")
    speed.add_argument("--quick", action="store_true", help="few lanes, few repetitions")
    speed.add_argument(
        "--lanes", type=int, nargs="+", default=[], help="of the table of peers; no cell left out"
    )
    speed.add_argument("-o", "--output", type=pathlib.Path, default=None, help="CSV of that table")

    scale = names.add_parser("scale", help="one large file: wall time, memory, kill and resume")
    scale.add_argument("--quick", action="store_true", help="400 recordings, the fastest method")
    scale.add_argument("--recordings", type=int, default=100_000)
    scale.add_argument("--folder", type=pathlib.Path, default=FILES, help="of the files it makes")
    scale.add_argument(
        "--method",
        nargs="+",
        choices=("default", *METHODS),
        default=["default", "equation_error"],
        help="the last is run in all layouts, and killed",
    )
    scale.add_argument("-o", "--output", type=pathlib.Path, default=None, help="CSV to write")

    curves = names.add_parser("curves", help="cost against samples, lanes and workers")
    curves.add_argument("--quick", action="store_true", help="small numbers only")
    curves.add_argument(
        "--folder", type=pathlib.Path, default=pathlib.Path(), help="of curves.csv and curves.svg"
    )

    names.add_parser("design", help="the pulse width and rate that determine R_s best")

    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.name == "spice":
        from benchmarks.spice import run as run_spice

        run_spice(
            arguments.data / "spice_recordings", arguments.scene, arguments.method, arguments.output
        )
    elif arguments.name == "coverage":
        from benchmarks import coverage as benchmark

        if arguments.spice is not None:
            folder = arguments.data / "spice_recordings"
            drawn = benchmark.spice_scene(folder, arguments.spice)
        else:
            drawn = benchmark.scene(
                arguments.snr_db,
                arguments.samples,
                arguments.resistors,
                arguments.jitter,
                arguments.shared,
                arguments.more,
            )
        benchmark.run(drawn, arguments.repetitions, arguments.method)
    elif arguments.name == "speed":
        from benchmarks import speed as ratios

        ratios.pin()
        sys.exit(0 if ratios.run(arguments.quick, arguments.lanes, arguments.output) else 1)
    elif arguments.name == "scale":
        from benchmarks import scale as benchmark_of_scale

        chosen = benchmark_of_scale.plan(
            arguments.folder, arguments.recordings, arguments.method, arguments.quick
        )
        sys.exit(0 if benchmark_of_scale.run(chosen, arguments.output) else 1)
    elif arguments.name == "curves":
        from benchmarks import curves as benchmark_of_curves

        benchmark_of_curves.run(arguments.quick, arguments.folder)
    elif arguments.name == "design":
        from benchmarks.design import run as run_design

        run_design()
    else:
        from benchmarks.timing import run as run_timing

        run_timing(arguments.lanes)


if __name__ == "__main__":
    main()
