"""A prior of one's own: correlated normals of the logarithms, as of a former study."""

import numpy as np

import etid

study = etid.scenes.paper_damp(snr_db=24.0).simulate(seed=1)
driver = etid.identify_driver(study["calibration/98k8"], order=5)
one = study["typical/damp/01"]

mean = np.log([6.2e3, 17e3, 0.64e-9])
cov = np.array([[0.02, 0.01, 0.0], [0.01, 0.03, -0.01], [0.0, -0.01, 0.02]])
root = np.linalg.inv(np.linalg.cholesky(cov))


def former_study(skin):
    return root @ (np.log([skin.r_s, skin.r_p, skin.c_p]) - mean)


rates = {"sample_rate": 200e3, "pulse_rate": 60.0}
for prior in (None, former_study):
    likelihood = etid.Likelihood.of(one.v_th, one.v_out, driver, **rates, prior=prior)
    print(likelihood.fit())
