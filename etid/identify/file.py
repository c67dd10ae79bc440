"""Identification of a file of any size in parts: memory is bounded, and finished parts are kept.

The recordings of a file are divided, in their order, into parts of `PART` recordings. Each part is
fitted as `identify_study` does. It is written completely or not at all, into a folder beside the
result. In the end all parts become one file. A killed run loses only the part that it was fitting.
`resume` continues with the missing parts and gives the same numbers, because the parts are divided
and fitted in the same way each time.

The parts are independent. Any `concurrent.futures.Executor` can therefore distribute them: over
processes of this machine (`processes`), or over a cluster
(`dask.distributed.Client.get_executor()`).
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import json
import logging
import logging.handlers
import multiprocessing
import os
import pathlib
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from tqdm import tqdm

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.lookup import class_path
from etid.estimators.registry import Method
from etid.identify.options import Circuit, FitOptions, Interval, Options, candidates_of
from etid.identify.study import Drivers, common_first, identify_part
from etid.precision import in_float64
from etid.recordings.causes import LOG
from etid.recordings.hdf5 import read, read_with_driver
from etid.recordings.recording import RecordingError
from etid.recordings.replacing import claimed, replace_text
from etid.recordings.study import Study
from etid.results.driver import Order
from etid.results.instrument import Instrument
from etid.results.study_fits import PLAUSIBLE, StudyFits

PART = 256  # recordings, some seconds of work; a killed run loses at most one part
RUN, SIZE = "run.json", "size of a part"  # what describes a run, and a key of it
CONTINUE = "go on with --resume (in Python: resume=True)"


class ResumeError(ValueError):
    """A run was interrupted, or the parts of an earlier run do not belong to this run."""


@functools.cache
def _drivers(sources: tuple[str, ...], stamps: tuple[int, ...], options: Options) -> Any:
    """Drivers and failures of a run in this process: a worker gets its parts one by one."""
    del sources, stamps, options
    return {}, {}


def _opened(sources: tuple[str, ...]) -> Study:
    """A file of recordings, or one with the file of its driver."""
    return read_with_driver(*sources) if len(sources) > 1 else read(*sources)


def _fit(drivers: Drivers, options: Options, total: int, part: Sequence[str]) -> StudyFits:
    """The fits of one part, with the drivers of this part only.

    This process may have identified the drivers of other parts before.
    """
    fits = identify_part(drivers, part, options, total)
    used = {}  # in their order
    for path in part:
        with contextlib.suppress(RecordingError):
            used[drivers.study.metadata(path).calibration or drivers.calibrations] = True
    found = {names: drivers.found[names] for names in used if names in drivers.found}
    failures = {names: drivers.failures[names] for names in used if names in drivers.failures}
    return StudyFits(fits, found, failures)


@in_float64
def _fit_elsewhere(
    run: tuple[tuple[str, ...], tuple[int, ...], Options],
    study: Study,
    total: int,
    part: Sequence[str],
) -> StudyFits:
    """The fits of one part, in any process that can read the files."""
    *_, options = run
    drivers = Drivers(study, options)
    drivers.found, drivers.failures = _drivers(*run)
    return _fit(drivers, options, total, part)  # the file of a pickle is closed with it


def _pin(cores: Any, told: Any, level: int) -> None:
    """Bind this process to one core: shared cores cost XLA more than they gain.

    Ctrl-C reaches this process and its parent. The parent says what was kept, so this process ends
    silently. What it logs is told by the parent, too.
    """
    tqdm.set_lock(threading.RLock())  # its own holds a semaphore, which Ctrl-C leaks
    LOG.setLevel(level)
    LOG.addHandler(logging.handlers.QueueHandler(told))
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {cores.get()})


class _Relayed(logging.Handler):
    """Passes on what other processes log."""

    def emit(self, record: logging.LogRecord) -> None:
        """Log it here."""
        LOG.handle(record)


class _Processes(concurrent.futures.ProcessPoolExecutor):
    """Processes that wait with Ctrl-C until `_pin`: within their imports it would be a traceback.

    A process inherits the blocked signals of the thread that starts it, which is that of `submit`.
    """

    def submit(self, *call: Any, **named: Any) -> concurrent.futures.Future:
        if not hasattr(signal, "pthread_sigmask"):
            return super().submit(*call, **named)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(*call, **named)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@contextlib.contextmanager
def processes(workers: int) -> Iterator[concurrent.futures.Executor]:
    """An executor of `workers` processes of this machine, each bound to one core."""
    context = multiprocessing.get_context("spawn")
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    cores, told = context.Queue(), context.Queue()
    for worker in range(workers):
        cores.put(available[worker % len(available)])
    listener = logging.handlers.QueueListener(told, _Relayed())
    listener.start()
    try:
        arguments = cores, told, LOG.getEffectiveLevel()
        with _Processes(workers, context, initializer=_pin, initargs=arguments) as executor:
            yield executor
    finally:
        listener.stop()


class _Parts:
    """The folder of parts beside a result."""

    def __init__(self, target: pathlib.Path, run: Mapping[str, Any], resume: bool) -> None:
        self.folder = _folder(target)
        before = _described(self.folder)
        if before and not resume:
            shutil.rmtree(self.folder)
        elif before and (changed := sorted(name for name in run if before.get(name) != run[name])):
            raise ResumeError(
                f"{self.folder}: the earlier run had another {' and '.join(changed)}; start again "
                "with --force in place of --resume (in Python: without resume)"
            )
        self.folder.mkdir(exist_ok=True)
        replace_text(self.folder / RUN, json.dumps(run))

    def path(self, number: int) -> pathlib.Path:
        """File of one part."""
        return self.folder / f"{number:06d}.h5"

    def read(self, number: int, circuit: type[AbstractCircuit]) -> StudyFits:
        """The fits of one part."""
        try:
            return StudyFits.read(self.path(number), circuit)
        except RecordingError as error:
            raise RecordingError(
                error.message,
                file=str(self.path(number)),
                remedy=f"Delete this part, and {CONTINUE}",
            ) from error


def kept(target: str | os.PathLike[str]) -> str:
    """A sentence on what an unfinished run has kept beside its result; empty if nothing."""
    folder = _folder(pathlib.Path(target))
    try:
        run = _described(folder)
        total, size = int(run["recordings"]), int(run[SIZE])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    done = min(total, size * len(list(folder.glob("[0-9]*.h5"))))
    return f"{done} of {total} recordings are fitted and kept in {folder}" if done else ""


def _described(folder: pathlib.Path) -> dict[str, Any]:
    """The run whose parts are in a folder; empty if there is no folder, or nothing in it.

    Raises:
        ResumeError: The folder holds something else.
    """
    if not folder.exists() or not any(folder.iterdir()):
        return {}
    try:
        run = json.loads((folder / RUN).read_text("utf-8"))
    except (OSError, ValueError):
        run = None
    if isinstance(run, dict) and SIZE in run:
        return run
    raise ResumeError(
        f"{folder / RUN}: is missing or damaged, so that the folder may hold other things than "
        "parts of fits; move or delete the folder, or name another file of fits"
    )


def _folder(target: pathlib.Path) -> pathlib.Path:
    return target.with_name(target.name + ".parts")


def _told(circuit: AbstractCircuit) -> str:
    """A circuit as a text: its class, and some numbers that another impedance would not give."""
    some = type(circuit)(*np.exp(np.linspace(-1, 1, len(circuit.names()))))
    numbers = " ".join(f"{one:.6g}" for one in np.asarray(some.response(np.geomspace(0.01, 1, 5))))
    return f"{class_path(type(circuit))} {eqx.tree_pformat(circuit)} {numbers}"


@in_float64
def fit_file(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    driver: str | os.PathLike[str] | None = None,
    order: Order = 5,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    accept: float | None = None,
    instrument: Instrument | None = None,
    plausible: tuple[float, float] = PLAUSIBLE,
    resume: bool = False,
    executor: concurrent.futures.Executor | None = None,
    progress: bool = False,
) -> StudyFits:
    """Identify all drivers and recordings of a file of any size.

    Args:
        source: File of recordings. Every process of `executor` must find it under this name.
        target: File of fits to write. Until it is complete, its parts are in `target.parts`.
        driver: File of the driver of all recordings, as `Driver.write` writes it, in
            place of the calibrations of the source.
        order: As in `identify_driver`.
        circuit: As in `identify_skins`. With `"auto"` a sample of the recordings chooses it.
        method: As in `identify_skin`.
        fixed: As in `identify_skin`, for all recordings.
        prior: As in `identify_skin`, for all recordings.
        bounds: As in `identify_skin`, for all recordings.
        accept: As in `identify_skin`.
        instrument: As in `identify_driver`.
        plausible: As in `identify_driver`.
        resume: Keep the parts of an earlier run that did not finish.
        executor: Executor that fits the parts. If not given, this process fits them.
        progress: Show a progress bar.

    Returns:
        As `identify_study`. The drivers of parts that an earlier run has fitted hold no harmonics
        of their calibrations.

    Raises:
        ResumeError: The earlier run had other settings, the source has changed since,
            `target.parts` holds other things than parts, or a worker was lost.
        RecordingError: The source as a whole is missing, damaged or of another schema, `driver`
            has calibrations of no driver or of several, or another process is writing the target.
        ValueError: The source has no loaded recording.
    """
    of_fit = FitOptions(method=method, fixed=fixed, prior=prior, bounds=bounds, accept=accept)
    options = Options.of(
        candidates_of(circuit), order=order, instrument=instrument, plausible=plausible, **of_fit
    )
    target = pathlib.Path(target)
    sources = tuple(os.fspath(one) for one in (source, driver) if one is not None)
    study = _opened(sources)
    drivers = Drivers(study, options)
    with study, claimed(target):
        count = len(drivers.paths)
        numbers = range((count + PART - 1) // PART)
        stamps = tuple(os.stat(one).st_mtime_ns for one in sources)
        options = common_first(drivers, options)
        settings = options.settings(study, count)
        settings = dataclasses.replace(settings, driver=" ".join(map(os.path.abspath, sources[1:])))
        described = json.loads(json.dumps(dataclasses.asdict(settings)))  # tuples become lists
        run = {
            **{name.replace("_", " "): value for name, value in described.items()},
            "source date": list(stamps),
            "circuit": hashlib.sha256(" ".join(map(_told, options.circuits)).encode()).hexdigest(),
            SIZE: PART,
        }
        parts = _Parts(target, run, resume)
        left = [number for number in numbers if not parts.path(number).exists()]
        run_of = (tuple(map(os.path.abspath, sources)), stamps, options)

        def task(number: int) -> Callable[[], StudyFits]:
            part = drivers.paths[number * PART : (number + 1) * PART]
            if executor is None:
                return functools.partial(_fit, drivers, options, count, part)
            return functools.partial(_fit_elsewhere, run_of, study.only(part), count, part)

        now: dict[int, StudyFits] = {}  # a file holds less of a fit
        done = min(count, (len(numbers) - len(left)) * PART)
        with tqdm(total=count, initial=done, unit="fit", disable=not progress) as bar:
            for number, found in _results(task, left, executor):
                now[number] = dataclasses.replace(found, settings=settings)
                now[number].write(parts.path(number))
                bar.update(len(found.fits))
        whole = StudyFits.concatenate(
            now.get(number) or parts.read(number, type(options.circuit)) for number in numbers
        )
        whole.write(target)
        shutil.rmtree(parts.folder)
        identified = {paths: of for found in now.values() for paths, of in found.drivers.items()}
        return dataclasses.replace(whole, drivers={**whole.drivers, **identified})


def _results(
    task: Callable[[int], Callable[[], StudyFits]],
    numbers: Sequence[int],
    executor: concurrent.futures.Executor | None,
) -> Iterator[tuple[int, StudyFits]]:
    """Numbers and fits of the parts, in the order in which they finish."""
    if executor is None:
        for number in numbers:
            yield number, task(number)()
        return
    futures = {executor.submit(task(number)): number for number in numbers}
    try:
        for future in concurrent.futures.as_completed(futures):
            yield futures.pop(future), future.result()
    except concurrent.futures.BrokenExecutor as error:
        raise ResumeError(f"a worker was lost; what is done is kept, {CONTINUE}") from error
    finally:
        for future in futures:  # after an interruption the executor would finish the others first
            future.cancel()
