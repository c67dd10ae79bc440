"""What does noise that is not white, or not equal in both records, cost, and are intervals honest?

All records of `benchmarks.perturbed_study.undisturbed` get noise in addition to the white one: 1/f
noise with a corner frequency, where both are equal, in both records or in that of V_out alone;
white noise of three times the size in V_out; mains hum. Or their noise comes before the filter. For
each, the verdicts, the median χ², the coverage (with the targets of `benchmarks.coverage`), and the
median standard errors of R_s, R_p and C_p relative to those with white noise.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping

import numpy as np

import etid
from benchmarks.coverage import identified, targets
from benchmarks.laboratory import Added, Flicker, Record, hum
from benchmarks.ladder import TRUTH
from benchmarks.perturbed_study import all_records, both, out, undisturbed
from benchmarks.runner import Target, option, report
from etid.simulation.scenes import Electronics

FIRST = 2000  # number of the first driver
HUM = 0.01  # [V at the converter]


def white(sigma: float) -> Added:
    """More white noise, of this standard deviation [V at the converter]."""
    return lambda time, rng: sigma * rng.standard_normal(time.size)


KINDS: Mapping[str, Callable[[Record], Record]] = {
    "white": lambda of: of,
    "1/f, 1 kHz": lambda of: both(added=(Flicker(of.sigma, 1e3),))(of),
    "1/f, 10 kHz": lambda of: both(added=(Flicker(of.sigma, 1e4),))(of),
    "1/f, 10 kHz, V_out only": lambda of: out(added=(Flicker(of.sigma, 1e4),))(of),
    "V_out three times as loud": lambda of: out(added=(white(8**0.5 * of.sigma),))(of),
    "hum of 50 Hz": lambda of: both(added=(hum(50.0, HUM),))(of),
    "hum of 60 Hz": lambda of: both(added=(hum(60.0, HUM),))(of),
    "before the filter": lambda of: both(electronics=Electronics())(of),
}


OPTIONS = (
    option("--snr-db", default=(40.0, 60.0)),
    option("--drivers", default=30),
    option("--only", nargs="+", choices=KINDS, help="kinds of noise"),
)


def studies(
    change: Callable[[Record], Record], snr_db: float, drivers: int
) -> Iterator[etid.Study]:
    """A dry and a damp recording behind each driver, and its calibration."""
    for number in range(FIRST, FIRST + drivers):
        yield all_records(change)(undisturbed(number, snr_db)).recordings()


def main(arguments: argparse.Namespace) -> bool:
    asked: list[Target] = []
    for snr_db in arguments.snr_db:
        usual = None
        for name in arguments.only or KINDS:
            every = identified(studies(KINDS[name], snr_db, arguments.drivers), TRUTH)
            chi2 = np.nanmedian([of.chi2 for of in every.values()])
            errors = [np.nanmedian(of.stderr, axis=0) for of in every.values()]
            usual = errors if usual is None else usual
            wider = "; ".join(
                f"{path} {', '.join(f'{ratio:.2f}' for ratio in mine / white)}"
                for path, mine, white in zip(every, errors, usual, strict=True)
            )
            print(f"{snr_db:g} dB, {name}: chi2 {chi2:.3f}, standard errors {wider}", flush=True)
            for path, of in every.items():
                asked += targets(f"{snr_db:g} dB, {name}, {path}", of)
    return report(asked)
