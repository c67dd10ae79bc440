"""Elements that are held while an impedance is fitted, and what a spectrum's verdicts advise."""

import numpy as np
import pytest

import etid
from etid.results.verdicts import message

F = np.geomspace(1.0, 1e6, 60)
STRING = "R0-p(CPE1,R1-p(R2,CPE2))"
RELATIVE = 0.005  # noise


def measured(seed=0):
    """An electrode behind a coating, and its names and values."""
    truth = {"r_0": 1e3, "q_1": 1.3e-9, "alpha_1": 0.96, "r_1": 1e5, "r_2": 1e6, "q_2": 6.6e-8}
    truth["alpha_2"] = 0.9
    z = type(etid.circuit(STRING))(**truth).response(F)
    noise = np.random.default_rng(seed).standard_normal((2, F.size))
    return truth, z * (1 + RELATIVE * (noise[0] + 1j * noise[1])), RELATIVE * np.abs(z)


@pytest.mark.parametrize("known", [True, False])
def test_a_held_element_keeps_its_value_and_makes_the_others_more_certain(known):
    truth, z, stderr = measured()
    errors = stderr if known else None
    free = etid.identify_impedance(F, z, circuit=STRING, stderr=errors)
    held = {"alpha_1": 0.96, "r_2": truth["r_2"]}
    fit = etid.identify_impedance(F, z, circuit=STRING, fixed=held, stderr=errors)
    for name, value in truth.items():
        found, error = getattr(fit.circuit, name), getattr(fit.stderr, name)
        if name in held:
            assert (found, error) == (value, 0.0)  # to the last digit
        else:
            assert abs(found - value) < 4 * error  # 1 of 3 000 by chance, for each of 5
            assert error <= getattr(free.stderr, name) * 1.001
    assert fit.stderr.q_1 < 0.3 * free.stderr.q_1  # alpha_1 is what it is correlated with
    assert " ".join(str(fit).split()).count("±") == 5  # the others have no error


def test_the_degrees_of_freedom_are_those_of_the_free_elements():
    """The mean chi2 of 30 noises is 1 with a standard error of 0.017: 2 · 60 − 6 terms."""
    chi2 = []
    for seed in range(30):
        _, z, stderr = measured(seed)
        fit = etid.identify_impedance(F, z, stderr=stderr, circuit=STRING, fixed={"alpha_1": 0.96})
        chi2.append(fit.chi2)
    assert abs(np.mean(chi2) - 1) < 4 * np.sqrt(2 / 114 / 30)


@pytest.mark.parametrize(
    ("fixed", "words"),
    [
        ({"alpha_3": 0.9}, "'alpha_3' is no element of"),
        ({"alpha_1": -0.9}, "must be positive"),
        (dict.fromkeys(measured()[0], 1.0), "leave at least one free"),
    ],
)
def test_what_cannot_be_held_is_refused(fixed, words):
    with pytest.raises(ValueError, match=words):
        etid.identify_impedance(F, measured()[1], circuit=STRING, fixed=fixed)


@pytest.mark.parametrize(("shape", "given"), [("(3,)", np.ones(3)), ("(60, 1)", np.ones((60, 1)))])
def test_errors_of_another_length_are_refused_in_words_of_our_own(shape, given):
    """They ended in NumPy's words on broadcasting."""
    for test in (etid.identify_impedance, etid.kramers_kronig):
        with pytest.raises(ValueError, match="stderr has shape") as caught:
            test(F, measured()[1], stderr=given)
        assert shape in str(caught.value)
        assert "one for each of 60 frequencies" in str(caught.value)
        with pytest.raises(ValueError, match="impedance has dtype <U1, must be complex numbers"):
            test(F, ["a"] * 60)


@pytest.mark.parametrize("known", [True, False])
def test_the_advice_of_a_misfit_can_be_followed(known):
    """It was order='auto', and circuit='auto', which chooses from circuits of skin."""
    _, z, stderr = measured()
    errors = stderr if known else None
    fit = etid.identify_impedance(F, z, circuit="R0-p(R1,C1)", throw=False, stderr=errors)
    assert fit.verdict == "misfit"
    with pytest.raises(etid.IdentificationError) as caught:
        etid.identify_impedance(F, z, circuit="R0-p(R1,C1)", stderr=errors)
    for text in (fit.note, str(fit), str(caught.value)):
        assert "auto" not in text
        assert "another circuit" in text
        assert "nan" not in text
    assert ("chi2" in fit.note) == known


@pytest.mark.parametrize("name", ["misfit", "max_steps_reached", "nonphysical", "insensitive"])
def test_no_advice_for_a_spectrum_names_what_it_does_not_have(name):
    text = message(name, spectrum=True)
    assert text != message(name)
    for word in ("auto", "method", "period", "v_th", "r_load", "recording"):
        assert word not in text
