"""`fit.posterior` beside NUTS of numpyro: means and standard deviations of the elements.

Both draw from the same likelihood (`benchmarks.rivals.posterior_by_numpyro`), by methods that share
nothing else. numpyro is installed in an environment of its own. At 20 dB some recordings do not
exclude that R_s is 0. Then the posterior has no end towards 0, and NUTS leaves the surroundings of
the fit; such fits are counted and not compared.
"""

import argparse

import numpy as np

from benchmarks.rivals import exchange, make
from benchmarks.runner import option

ENVIRONMENT = "numpyro"
WORKER = "benchmarks.rivals.posterior_by_numpyro"
ENDED = 400.0  # effective draws of a chain that stayed at the fit; others have a few dozens
# Of the median fit. 400 draws know a mean to 0.05 standard deviations, a deviation to 3.5 %.
MEAN = 0.1  # [standard deviations] largest difference of the means
DEVIATION = 0.05  # largest relative difference of the standard deviations

OPTIONS = (
    option("--snr", default=(60.0, 40.0, 20.0), metavar="DB"),
    option("--fits", default=8, help="at each ratio"),
)


def main(arguments: argparse.Namespace) -> bool:
    """Install numpyro, run both, print; whether they agree."""
    missing = make(ENVIRONMENT)
    if missing:
        print(missing)
        return False
    agree = True
    print("SNR dB  fits  no end  element  mean [sd]     sd ratio      ms  effective  NUTS s")
    for snr_db in arguments.snr:
        found = compared(snr_db, arguments.fits)
        ended = found["worth"].min(1) > ENDED
        shift, ratio = (np.abs(found["shift"][ended]), found["ratio"][ended])
        ours, nuts, worth = np.median(found["seconds"][ended], axis=0)
        for number, name in enumerate(("r_s", "r_p", "c_p")):
            middle = np.median(shift[:, number]), np.median(ratio[:, number])
            agree &= bool(middle[0] < MEAN and abs(middle[1] - 1) < DEVIATION)
            worst = shift[:, number].max(), ratio[np.abs(ratio[:, number] - 1).argmax(), number]
            print(
                f"{snr_db:<8g}{ended.sum():<6}{(~ended).sum():<8}{name:<9}"
                f"{middle[0]:.3f} ({worst[0]:.2f})  {middle[1]:.3f} ({worst[1]:.2f})  "
                f"{1e3 * ours:<6.0f}{worth:<11.0f}{nuts:.1f}"
            )
    return agree


def compared(snr_db: float, fits: int) -> dict[str, np.ndarray]:
    """What the worker found at one signal-to-noise ratio."""
    return exchange(ENVIRONMENT, WORKER, snr_db=snr_db, fits=fits)
