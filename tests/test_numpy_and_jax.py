"""NumPy and JAX answer alike, whatever disturbs a recording."""

import numpy as np
import pytest

import etid
from benchmarks import perturbation_list, perturbed_study
from etid.identify import fitting

SAME = 1e-5  # standard errors: rounding on the way to a minimum that the data hardly determine
DISTURBED = (
    *("base", "gain_out_+1%_skin", "crosstalk_1%_unloaded", "capacitance_5pF_skin"),
    *("lowpass_80kHz_skin", "Rp_nonlinear_0.2", "cole_alpha0.8", "two_rc_mid"),
    *("inductance_5mH_skin", "driver_Rprot_x1.05", "tail_5mV_5ms_skin", "driver_Vp_+2%_out_vs_th"),
    *("hum60_0.02V_out_skin_only", "delay_0.9_samples_skin"),
)


def test_every_disturbance_of_the_list_has_its_name():
    assert set(DISTURBED) <= set(perturbation_list.PERTURBATIONS)


@pytest.mark.parametrize(
    ("number", "snr_db"),
    [(0, 60.0), pytest.param(2, 30.0, marks=pytest.mark.slow)],
)
def test_numpy_and_jax_have_the_same_verdicts_and_elements(number, snr_db, monkeypatch):
    """A drawn driver, dry and damp skin. Both take the same steps, but for rounding."""
    base = perturbed_study.undisturbed(number, snr_db)
    driver = etid.identify_driver(base.recordings()["calibration/98k8"], throw=False)
    records = []
    for name in DISTURBED:
        disturbed = perturbation_list.change_of(name)(base).recordings()
        records += [disturbed["dry"], disturbed["damp"]]
    # Only NumPy takes what a circuit leaves into the fit.
    found = etid.identify_skins(records, driver, accept=0.0)
    monkeypatch.setattr(fitting, "ROWS", False)
    expected = etid.identify_skins(records, driver, accept=0.0)
    np.testing.assert_array_equal(found.verdicts, expected.verdicts)
    np.testing.assert_array_equal(found.fit.remarks, expected.fit.remarks)
    values, others = (np.asarray(of.circuit.values()) for of in (found, expected))
    errors = np.sqrt(np.diagonal(np.asarray(expected.cov), axis1=1, axis2=2))
    assert np.max(np.abs(values - others) / errors) < SAME
    size = errors[:, :, None] * errors[:, None, :]
    np.testing.assert_allclose(found.cov / size, expected.cov / size, atol=SAME)
    assert len(set(found.verdicts.tolist())) > 2
