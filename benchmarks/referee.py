"""`fit.posterior` beside NUTS of numpyro: means and standard deviations of the elements.

Both draw from the same likelihood (`benchmarks.rivals.posterior_by_numpyro`), by methods that share
nothing else. numpyro is installed in an environment of its own. At 20 dB some recordings do not
exclude that R_s is 0. Draws that the stretch would move below it have no weight here, and NUTS does
not know it; such fits are counted and not compared.
"""

import argparse

import numpy as np

from benchmarks.estimators import ELEMENTS
from benchmarks.rivals import exchange
from benchmarks.runner import Target, at_most, option, report

ENVIRONMENT = "numpyro"
ENDED = 400.0  # effective draws of a chain that stayed at the fit; others have a few dozens
# Of the median fit. 400 draws know a mean to 0.05 standard deviations, a deviation to 3.5 %.
TARGETS = {
    "difference of the means [sd]": at_most(0.1),
    "ratio of the standard deviations": (0.95, 1.05),
}

OPTIONS = (
    option("--snr", default=(60.0, 40.0, 20.0), metavar="DB"),
    option("--fits", default=8, help="at each ratio"),
)


def main(arguments: argparse.Namespace) -> bool:
    asked: list[Target] = []
    print("SNR dB  fits  no end      ms  effective  NUTS s")
    for snr_db in arguments.snr:
        found = compared(snr_db, arguments.fits)
        ended = found["worth"].min(1) > ENDED
        shift, ratio = np.abs(found["shift"][ended]), found["ratio"][ended]
        ours, nuts, worth = np.median(found["seconds"][ended], axis=0)
        print(
            f"{snr_db:<8g}{ended.sum():<6}{(~ended).sum():<8}{1e3 * ours:>6.0f}{worth:>11.0f}"
            f"{nuts:>8.1f}"
        )
        farthest = np.take_along_axis(ratio, np.abs(ratio - 1).argmax(0)[None], 0)[0]
        for name, of, worst in zip(TARGETS, (shift, ratio), (shift.max(0), farthest), strict=True):
            for element, middle, far in zip(ELEMENTS, np.median(of, axis=0), worst, strict=True):
                text = f"{middle:.3f} (worst {far:.2f})"
                place = f"{snr_db:g} dB, {element}: "
                asked.append(Target.of(TARGETS, name, middle, place, text=text))
    return report(asked)


def compared(snr_db: float, fits: int) -> dict[str, np.ndarray]:
    """What the worker found at one signal-to-noise ratio."""
    return exchange(ENVIRONMENT, "posterior_by_numpyro", snr_db=snr_db, fits=fits)
