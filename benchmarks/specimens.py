"""A file of fits by hand, for tests and benchmarks that need no fit."""

import jax.numpy as jnp
import numpy as np

import etid
from etid.identify.options import Options
from etid.results.driver import Calibration, ContinuousDriver, SourceImpedance
from etid.results.study_fits import StudyFits
from etid.results.verdicts import message, verdict, verdicts_of

SKIN = {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}


def study_fits() -> StudyFits:
    """Fits by hand of six recordings, with a driver and one that failed."""
    names = ["successful"] * 4 + ["misfit", "flat"]
    values = np.array([1.0, 1.1, 0.9, 1.0, 1.3, np.nan])[:, None] * np.array(list(SKIN.values()))
    shared, own = (np.einsum("ni,ij->nij", (e * values) ** 2, np.eye(3)) for e in (0.02, 0.01))
    labels = {
        "path": np.array([f"loaded/{i}" for i in range(6)]),
        "subject": np.array(["s01", "s02"] * 3),
        "condition": np.array(["dry"] * 6),
        "electrode": np.array(["1"] * 6),
        "trial": np.array(list("012345")),
    }
    fit = etid.Fit(
        circuit=etid.SkinRC(*values.T),
        cov=own + shared,
        shared_cov=shared,
        rrse=np.full(6, 0.02),
        chi2=np.full(6, 1.0),
        result=verdicts_of(np.array(names)),
        steps=np.full(6, 5),
        method="maximum_likelihood",
        remarks=np.zeros(6, int),
    )
    fits = etid.Fits(fit, labels, np.array([message(name) for name in names]))
    numbers = (np.log(5e3), [np.log(4e5)], [np.log(0.3)], [5e3], [2e3], [np.log(6e2)], [-3e3])
    driver = ContinuousDriver(
        b=jnp.ones(3),
        a=jnp.ones(4),
        sample_rate=2e5,
        source=SourceImpedance(*map(jnp.asarray, numbers)),
        cov=1e-4 * jnp.eye(7),
        calibration=Calibration(jnp.array([98.8e3]), jnp.zeros(1), jnp.array(np.nan)),
        rrse=jnp.array(0.003),
        chi2=jnp.array(1.1),
        result=verdict("successful"),
        steps=jnp.array(9),
        method="maximum_likelihood",
    )
    settings = Options((etid.SkinRC(),)).settings(etid.Study.from_recordings([]), 6)
    return StudyFits(fits, {("calibration/0",): driver}, {("calibration/1",): "flat"}, settings)
