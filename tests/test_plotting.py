import jax.numpy as jnp
import numpy as np
import pytest

from etid import SkinRC, plotting, scenes
from etid.results import Fit, Fits
from etid.verdicts import verdicts_of


@pytest.fixture(scope="module")
def recording():
    study = scenes.paper_dry().simulate(seed=3)
    return next(iter(study.loaded.recordings()))


def test_fit_shows_measured_predicted_and_residual_in_display_units(recording):
    predicted = recording.v_out + 0.02
    predicted[:20] = np.nan  # as `etid.predict` leaves the edges
    figure = plotting.plot_fit(recording, predicted)
    upper, lower = figure.axes
    assert upper.get_ylabel() == "voltage [V]"
    assert lower.get_ylabel() == "residual [mV]"
    drawn = np.asarray(lower.lines[-1].get_ydata())
    np.testing.assert_allclose(drawn[np.isfinite(drawn)], 20.0, atol=1e-9)
    # One pulse is shown, not the record: its edge must lie inside.
    shown = np.asarray(upper.lines[1].get_ydata())
    assert shown.size < 0.1 * recording.v_out.size
    assert np.ptp(shown) > 0.8 * np.ptp(recording.v_out)


def test_prediction_of_another_length_is_refused(recording):
    with pytest.raises(ValueError, match="shape"):
        plotting.plot_fit(recording, recording.v_out[:-1])


def test_impedance_is_drawn_in_kilohms_and_degrees():
    circuit = SkinRC(10e3, 90e3, 1e-9)
    frequency = plotting.bode_frequencies(60.0, 1e5)
    stderr = {"skin": np.full(frequency.size, 1e3)}
    figure = plotting.plot_impedance({"skin": circuit}, stderr=stderr)
    magnitude, phase = figure.axes
    z = np.asarray(circuit.response(jnp.asarray(frequency)))
    np.testing.assert_allclose(np.asarray(magnitude.lines[0].get_xdata()), frequency / 1e3)
    np.testing.assert_allclose(np.asarray(magnitude.lines[0].get_ydata()), np.abs(z) / 1e3)
    np.testing.assert_allclose(np.asarray(phase.lines[0].get_ydata()), np.degrees(np.angle(z)))
    assert len(magnitude.collections) == 1


def test_elements_show_every_fit_and_failures_hollow():
    values = jnp.array([[10e3, 20e3, 30e3], [90e3, 80e3, 70e3], [1e-9, 2e-9, 3e-9]])
    cov = np.tile(np.diag([1e6, 1e6, 1e-20]), (3, 1, 1))
    verdicts = verdicts_of(np.array(["successful", "successful", "misfit"]))
    one = np.ones(3)
    fit = Fit(SkinRC(*values), cov, 0 * cov, one, one, verdicts, np.ones(3, int), "output_error")
    labels = {name: np.array(["a", "a", "b"]) for name in ("path", "subject", "electrode", "trial")}
    labels["condition"] = np.array(["dry", "damp", "dry"])
    figure = plotting.plot_elements(Fits(fit, labels, np.array([""] * 3)))
    assert [axis.get_ylabel() for axis in figure.axes] == ["r_s [kΩ]", "r_p [kΩ]", "c_p [nF]"]
    points = [line for line in figure.axes[0].lines if line.get_marker() in tuple("osD^")]
    drawn = np.sort(np.concatenate([line.get_ydata() for line in points]))
    np.testing.assert_allclose(drawn, [10.0, 20.0, 30.0])
    assert sum(line.get_markerfacecolor() == "none" for line in points) == 1


def test_recording_shows_the_whole_record(recording):
    figure = plotting.plot_recording(recording)
    np.testing.assert_allclose(np.asarray(figure.axes[0].lines[0].get_ydata()), recording.v_th)
    assert figure.axes[0].get_xlabel() == "time [ms]"


def test_equal_figures_are_equal_files(recording, tmp_path):
    figures = [plotting.plot_recording(recording) for _ in range(2)]
    for suffix in (".png", ".svg"):
        files = [tmp_path / f"{i}{suffix}" for i in range(2)]
        for figure, file in zip(figures, files, strict=True):
            plotting.save(figure, file)
        if suffix == ".png":
            assert files[0].read_bytes() == files[1].read_bytes()
        assert b"<dc:date>" not in files[0].read_bytes()
    with pytest.raises(ValueError, match=r"\.png or \.svg"):
        plotting.save(figures[0], tmp_path / "figure.pdf")


def test_nothing_is_left_in_pyplot(recording):
    import matplotlib.pyplot as plt

    plotting.plot_recording(recording)
    assert plt.get_fignums() == []
