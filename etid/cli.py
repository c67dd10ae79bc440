"""The command line: `etid simulate | import | check | fit`.

Exit status: 0 done, 1 something is wrong with the data or no recording could be identified, 2 the
command itself is wrong. What is wrong is one line on stderr, never a traceback.
"""

import argparse
import concurrent.futures
import contextlib
import json
import math
import pathlib
import sys
from collections.abc import Iterator, Sequence

import jax
import numpy as np

import etid
from etid.batch import StudyFits
from etid.circuits import DISPLAY
from etid.methods import METHODS
from etid.report import Table
from etid.streaming import processes

DONE, WRONG_DATA = 0, 1  # argparse exits with 2 by itself
_SHOWN = 20  # recordings without success that are listed one by one


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments; those of the process if not given.

    Returns:
        The exit status.
    """
    parser = _parser()
    arguments = parser.parse_args(argv)
    source = getattr(arguments, "source", None)
    if source is not None and _same_file(source, arguments.target):
        parser.error(f"{arguments.target} would replace the file that is read; name another")
    jax.config.update("jax_enable_x64", True)
    try:
        return arguments.run(arguments)
    except (etid.RecordingError, etid.IdentificationError, ValueError, OSError) as error:
        print(f"etid: error: {' '.join(str(error).split())}", file=sys.stderr)
        return WRONG_DATA


def _same_file(source: pathlib.Path, target: pathlib.Path) -> bool:
    return source.exists() and target.exists() and source.samefile(target)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="etid",
        description="Identify circuits from electro-tactile stimulation recordings.",
        epilog="Exit status: 0 done, 1 something is wrong with the data, 2 wrong usage.",
    )
    parser.add_argument("--version", action="version", version=f"etid {etid.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("simulate", help="make synthetic recordings")
    command.add_argument("preset", choices=list(etid.scenes.PRESETS), help="experiment")
    command.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="FILE")
    command.add_argument("--snr-db", type=float, default=60.0, help="default 60; inf for no noise")
    command.add_argument(
        "--jitter", type=float, default=0.0, metavar="SECONDS", help="rms trigger delay, default 0"
    )
    command.add_argument("--seed", type=int, default=0)
    command.add_argument(
        "--truth", type=pathlib.Path, metavar="FILE", help="write the true elements as JSON, SI"
    )
    command.set_defaults(run=_simulate)

    command = commands.add_parser("import", help="turn .npz, .csv or .mat into an etid file")
    command.add_argument("source", type=pathlib.Path)
    command.add_argument("target", type=pathlib.Path)
    for name, text in {
        "v-th": "column or variable of the unloaded output",
        "v-out": "column or variable of the output with the load",
        "current": "column or variable of the current [A]",
        "time": "column or variable of the time [s], instead of --sample-rate",
    }.items():
        command.add_argument(f"--{name}", metavar="NAME", help=text)
    for name, text in {
        "sample-rate": "samples per second [Hz]",
        "pulse-rate": "pulses per second [Hz]",
        "scale": "volts at the terminal are the value divided by this",
        "r-load": "known resistor [ohm], for calibrations",
    }.items():
        command.add_argument(f"--{name}", type=float, metavar="NUMBER", help=text)
    command.add_argument("--subject", default="")
    command.add_argument("--condition", default="")
    command.set_defaults(run=_import)

    command = commands.add_parser("check", help="say what is wrong with a file, field by field")
    command.add_argument("file", type=pathlib.Path)
    command.set_defaults(run=_check)

    command = commands.add_parser("fit", help="identify drivers and loads of a whole file")
    command.add_argument("source", type=pathlib.Path, metavar="FILE")
    command.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="FITS")
    command.add_argument(
        "--method",
        choices=METHODS,
        help="default maximum_likelihood where the record allows it, else output_error",
    )
    command.add_argument("--order", type=int, default=5, help="poles of the driver, default 5")
    command.add_argument(
        "--joint",
        action="store_true",
        help="one fit for all recordings of a driver, by maximum likelihood",
    )
    command.add_argument(
        "--resume", action="store_true", help="go on where a run that was killed has stopped"
    )
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=int, metavar="N", help="processes of this machine, a core each"
    )
    where.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a cluster that sees the file (etid[dask])"
    )
    command.set_defaults(run=_fit)
    return parser


def _simulate(arguments: argparse.Namespace) -> int:
    scene = etid.scenes.PRESETS[arguments.preset](
        snr_db=arguments.snr_db, trigger_jitter_rms=arguments.jitter
    )
    scene.simulate(arguments.seed).write(arguments.target)
    if arguments.truth is not None:
        arguments.truth.write_text(json.dumps(scene.truth(), indent=1) + "\n", encoding="utf-8")
    return DONE


def _import(arguments: argparse.Namespace) -> int:
    names = ("v_th", "v_out", "current", "time", "sample_rate", "pulse_rate", "scale", "r_load")
    given = {name: getattr(arguments, name) for name in (*names, "subject", "condition")}
    etid.import_file(arguments.source, arguments.target, **given)
    return DONE


def _check(arguments: argparse.Namespace) -> int:
    problems = etid.check(arguments.file)
    if not problems:
        with etid.read(arguments.file) as study:
            print(f"{arguments.file}: {len(study)} recordings, nothing wrong")
        return DONE
    for problem in problems:
        print(problem)
    return WRONG_DATA


def _fit(arguments: argparse.Namespace) -> int:
    if not arguments.target.absolute().parent.is_dir():  # known before hours of fitting
        raise ValueError(f"{arguments.target}: there is no folder to write it to")
    if arguments.joint and arguments.method not in (None, "maximum_likelihood"):
        raise ValueError(f"--joint is by maximum likelihood, not by {arguments.method}")
    progress = sys.stderr.isatty()
    if arguments.joint:
        if arguments.resume or arguments.workers or arguments.dask:
            raise ValueError("--joint is one fit: it has no --resume, --workers or --dask")
        with etid.read(arguments.source) as study:
            outcome = etid.identify_jointly(study, order=arguments.order, progress=progress)
        outcome.fits.write(arguments.target)
    else:
        with _executor(arguments) as executor:
            outcome = etid.fit_file(
                arguments.source,
                arguments.target,
                order=arguments.order,
                method=arguments.method,
                resume=arguments.resume,
                executor=executor,
                progress=progress,
            )
    print(_summary(outcome))
    return DONE if "successful" in outcome.fits.counts() else WRONG_DATA


@contextlib.contextmanager
def _executor(arguments: argparse.Namespace) -> Iterator[concurrent.futures.Executor | None]:
    if arguments.dask:
        try:
            import distributed
        except ImportError as error:
            raise ValueError("--dask needs distributed: pip install 'etid[dask]'") from error
        with distributed.Client(arguments.dask) as client:
            yield client.get_executor()
    elif arguments.workers:
        with processes(arguments.workers) as executor:
            yield executor
    else:
        yield None


def _summary(outcome: StudyFits) -> str:
    """What a batch came to: verdicts, drivers, medians, and what went wrong where."""
    fits = outcome.fits
    verdicts = ", ".join(f"{count} {name}" for name, count in fits.counts().items())
    lines = [f"{len(fits)} recordings by {fits.fit.method}: {verdicts}"]
    for paths, driver in outcome.drivers.items():
        text = (
            f"order {driver.order}, {driver.verdict}, "
            f"RRSE {100 * float(driver.rrse):.3g} %, chi2 {float(driver.chi2):.3g}"
        )
        lines.append(f"driver {', '.join(paths)}: {text}")
    lines += [f"driver {', '.join(paths)}: {text}" for paths, text in outcome.failures.items()]
    if "successful" in fits.counts():
        lines += [
            "",
            "medians of the successful fits (spread between recordings; median standard error)",
            str(_medians(outcome)),
        ]
    failed = np.flatnonzero(fits.verdicts != "successful")
    wrong = [f"{fits.labels['path'][i]}: {fits.verdicts[i]}. {fits.notes[i]}" for i in failed]
    if wrong:
        lines += ["", f"without success: {len(wrong)} recordings"]
        lines += [" ".join(line.split()) for line in wrong[:_SHOWN]]
    if len(wrong) > _SHOWN:
        lines.append(f"and {len(wrong) - _SHOWN} more; the file of fits has a note for each fit")
    return "\n".join(lines)


def _medians(outcome: StudyFits) -> Table:
    units = outcome.fits.circuit.units()
    rows = []
    for group in outcome.fits.summary("subject", "condition"):
        if not (group["subject"] or group["condition"] or group["successful"]):
            continue  # what could not be read has no labels
        row = [group["subject"], group["condition"], f"{group['successful']}/{group['fits']}"]
        for name, unit in units.items():
            numbers = (
                group[key] / DISPLAY[unit][0] for key in (name, f"{name}_spread", f"{name}_stderr")
            )
            row.append(_cell(*numbers) if group["successful"] else "")
        rows.append(tuple(row))
    heads = tuple(f"{name} [{DISPLAY[unit][1]}]" for name, unit in units.items())
    return Table(("subject", "condition", "fits", *heads), tuple(rows))


def _cell(value: float, spread: float, error: float) -> str:
    """Three numbers in one unit, to two digits of the standard error."""
    digits = max(0, 1 - math.floor(math.log10(error))) if 0 < error < math.inf else 3
    return f"{value:.{digits}f} ({spread:.{digits}f}; {error:.{digits}f})"


if __name__ == "__main__":
    sys.exit(main())
