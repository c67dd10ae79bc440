"""Are intervals honest when an instrument has the errors that its tolerances allow?

Each study of `benchmarks.perturbed_study.undisturbed` gets errors that are drawn from the stated
tolerances, one kind at a time or all of them, in its calibration and in dry and damp skin; a drift
changes all parts of the driver, independently. Printed is the coverage (with the targets of
`benchmarks.coverage`) of fits behind a driver and of joint fits.

With `--fault N` one kind at a time is exactly N tolerances wrong, up or down; only the record of
the skin is late then. Printed is the part of the fits that report anything, beside that of the best
test behind the usual driver (`benchmarks.visibility`), and the part that is silent: usable
and wrong by more than `SILENT` of its standard errors. Left out are a wrong resistor, which is
invisible, a capacitance across it, of which little is visible, and a drift, which is not one error.
"""

import argparse
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

import etid
from benchmarks import perturbed_study as lab
from benchmarks import visibility
from benchmarks.coverage import JOINT, Draws, draw, targets
from benchmarks.laboratory import Record
from benchmarks.ladder import LOADS, TRUTH
from benchmarks.rates import rate
from benchmarks.runner import WORKERS, Target, each, option, report
from etid.circuits.directions import DIRECTIONS
from etid.results.instrument import ERRORS
from etid.results.verdicts import USABLE

SILENT = 4.0  # standard errors
FIRST = 5000  # number of the first driver
SIZES = {  # [relative, F, s]
    "gain": 2e-3,
    "r_load": 2e-3,
    "crosstalk": 2e-3,
    "capacitance": 2e-12,
    "drift": 5e-3,
    "delay": 5e-9,
    "c_load": 1e-12,
}
KINDS = {**{name: (name,) for name in SIZES}, "all": tuple(SIZES)}
MODES = ("behind a driver", JOINT)
# What one tolerance changes; with a wrong resistor all impedances change in proportion, unseen.
SEEN_BY_BEST = {
    **{name: visibility.fault(name, SIZES[name], True) for name in ("gain", "crosstalk")},
    "capacitance": visibility.fault("capacitance", SIZES["capacitance"]),
    "delay": None,
}
RECORDS = {"all": lab.all_records, "loads": lab.trials, "calibrations": lab.calibrations}

OPTIONS = (
    WORKERS,
    option("--snr-db", default=(40.0, 60.0)),
    option("--draws", default=200),
    option("--only", nargs="+", choices=KINDS, help="kinds of errors"),
    option("--mode", nargs="+", choices=MODES, default=MODES),
    option("--fault", type=float, help="one error of so many tolerances"),
    option("-o", "--output", type=pathlib.Path, help="CSV to write"),
)


def study(
    number: int, snr_db: float, names: Sequence[str], fault: float | None = None
) -> etid.Study:
    """A calibration and two skins, by an instrument whose errors of these kinds are drawn.

    A `fault` is a size that they have, in tolerances, up or down.
    """
    rng = np.random.default_rng([number, *b"errors"])

    def normal() -> float:
        drawn = float(rng.standard_normal())
        return drawn if fault is None else fault * float(np.sign(drawn))

    drawn = {name: size * normal() for name, size in SIZES.items()}
    error = {name: of if name in names else 0.0 for name, of in drawn.items()}
    of = lab.undisturbed(number, snr_db)
    error["c_load"] = abs(error["c_load"])  # no carrier has a negative one
    for name in ERRORS:
        of = RECORDS[DIRECTIONS[name].records](lab.fault(name, error[name]))(of)
    if "drift" in names:  # of all parts, independently
        later = lab.drawn_driver(FIRST + number, SIZES["drift"], of.trials[0].out.driver)
        of = lab.trials(lab.both(driver=later))(of)
    if "delay" in names:

        def late(one: Record) -> Record:
            right = fault is not None and one.r_load is not None
            after = 0.0 if right else SIZES["delay"] * normal()  # V_out after V_th
            return lab.out(delay=one.th.delay + after)(one)

        of = lab.all_records(late)(of)
    return of.recordings()


def fits_of(of: etid.Study, mode: str, instrument: etid.Instrument) -> Mapping[str, etid.Fit]:
    """Fits of both skins by path; none if the driver failed."""
    if mode == JOINT:
        fits = etid.identify_jointly(of, instrument=instrument).fits
        return {path: fits[i] for i, path in enumerate(fits.labels["path"])}
    known = list(of.calibrations.recordings())
    driver = etid.identify_driver(known, instrument=instrument, throw=False)
    if driver.verdict != "successful":
        return {}
    return {path: etid.identify_skin(of[path], driver, throw=False) for path in TRUTH}


def answers(
    number: int, snr_db: float, kind: str, mode: str, fault: float | None = None
) -> list[tuple]:
    """A row of `Draws` for each skin."""
    # A joint fit has no drift.
    names = [name for name in KINDS[kind] if not (mode == JOINT and name == "drift")]
    instrument = etid.Instrument(**{name: SIZES[name] for name in names})
    fits = fits_of(study(number, snr_db, names, fault), mode, instrument)
    return [draw(fits.get(path), true) for path, true in TRUTH.items()]


def found(name: str, of: Draws, best: float) -> Target:
    """The part of the fits that report anything, which is to be as large as that of the best."""
    told = rate(~np.isin(of.verdicts, USABLE), range(of.verdicts.size))
    wrong = (np.abs(of.error / of.stderr) > SILENT).any(axis=1)
    silent = rate(wrong & np.isin(of.verdicts, USABLE), range(of.verdicts.size))
    text = f"{told}, best test {best:.0%}; silent {silent}"
    return Target(f"{name}: found", told.rate, best, text=text, interval=(told.low, told.high))


def main(arguments: argparse.Namespace) -> bool:
    asked: list[Target] = []
    fault = arguments.fault
    possible = KINDS if fault is None else SEEN_BY_BEST
    for snr_db in arguments.snr_db:
        for kind in filter(possible.__contains__, arguments.only or possible):
            for mode in arguments.mode if kind != "drift" else MODES[:1]:
                numbers = range(FIRST, FIRST + arguments.draws)
                tasks = [(number, snr_db, kind, mode, fault) for number in numbers]
                done = dict(each(answers, tasks, arguments.workers, "draw", "tolerances"))
                for path, rows in zip(TRUTH, zip(*done.values(), strict=True), strict=True):
                    name, of = f"{snr_db:g} dB, {kind}, {mode}, {path}", Draws.of(rows)
                    if fault is None:
                        asked += targets(name, of)
                        continue
                    change, delay = SEEN_BY_BEST[kind], SIZES["delay"]
                    best = visibility.found(LOADS[path], snr_db, change, fault, delay)
                    asked.append(found(name, of, best))
    return report(asked, arguments.output)
