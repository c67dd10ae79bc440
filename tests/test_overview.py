"""What `print`, `repr` and a notebook show: values, errors, units and verdicts, no arrays."""

import copy
import dataclasses
import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.display.state import Change
from etid.printing import ROWS, Overview, between, quantity
from etid.recordings.remarks import Remark
from etid.results.columns import described
from etid.results.data import MeasuredImpedance
from etid.results.driver import Calibration, ContinuousDriver, SourceImpedance
from etid.results.fit import Support
from etid.results.verdicts import verdict
from etid.selection.selection import Selection
from etid.simulation.bound import Bound
from tests import kept_numbers

DRY = etid.SkinRC(33.4e3, 186e3, 0.12e-9)
COV = np.diag([1e4, 1e6, 1e-24])
ARRAYS = re.compile(r"[fic](32|64)\[|array\(|Array\(")


@functools.cache
def fit(name="successful"):
    one = np.asarray(1.0)
    return etid.Fit(
        circuit=DRY,
        cov=COV,
        shared_cov=0 * COV,
        rrse=one,
        chi2=one,
        result=verdict(name),
        steps=np.asarray(7),
        method="maximum_likelihood",
        support=Support.unknown(3),
    )


def fits():
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), fit(), fit(), fit("misfit"))
    known = [{"subject": f"s{number}", "condition": "<b>"} for number in (1, 1, 2)]
    return etid.Fits(batch, described(known), np.array(["", "", "why"]))


def driver():
    parameters = map(np.asarray, (9.0, [11.0], [0.0], [1e3], [1e3], [6.0], [1e4]))
    source = SourceImpedance(*map(jnp.asarray, parameters))
    one = jnp.asarray(1.0)
    return ContinuousDriver(
        source=source,
        cov=1e-4 * jnp.eye(7),
        calibration=Calibration(jnp.array([98.8e3]), jnp.zeros(1), one),
        b=jnp.ones(3),
        a=jnp.ones(4),
        sample_rate=200e3,
        rrse=one,
        chi2=one,
        result=verdict("successful"),
        steps=jnp.asarray(3),
        method="output_error",
    )


def study():
    volts = np.arange(100.0)
    rates: dict[str, Any] = {"sample_rate": 200e3, "pulse_rate": 4e3}
    known: dict[str, Any] = {"path": "s01/dry", "subject": "s01", "condition": "<b>"}
    calibration = etid.Recording(volts, volts, r_load=98.8e3, path="calibration", **rates)
    return etid.Study.from_recordings([calibration, etid.Recording(volts, volts, **rates, **known)])


def found_driver():
    """A driver that says all it can: known resistors that disagree, a drift, a remark, a misfit."""
    of = driver()
    known = Calibration(
        r_load=jnp.array([98.8e3, 21.62e3]),
        delay_samples=jnp.array([0.2, -0.1]),
        delay_std_samples=jnp.array(0.5),
        mismatch=jnp.array([[0.02, -0.03], [0.001, 0.002]]),
    )
    return dataclasses.replace(
        of,
        calibration=known,
        chi2=jnp.asarray(7.654321),
        rrse=jnp.asarray(0.0123456),
        instrument=etid.Instrument(drift=0.02).as_arrays(),
        remarks=np.asarray(int(Remark.mains_hum)),
        result=verdict("misfit"),
    )


def changed():
    """A fit of a load that changed."""
    moved = np.array([0.01, -0.2, 0.003, 0.0001])
    stderr = 0.1 * abs(moved)
    stderr[2] = 8e3  # not determined
    return dataclasses.replace(fit("changed"), change=moved, change_stderr=stderr)


SHOWN = {
    "fit": (
        fit,
        ["SkinRC: successful in 7 steps", "r_s 33.40 ± 0.10 kΩ", "c_p 0.1200 ± 0.0010 nF"],
    ),
    "failed fit": (lambda: fit("misfit"), ["SkinRC: misfit", "misses the recording", "chi2 is 1"]),
    "changed fit": (changed, ["During the record: r_s +1 ± 0.1 %, r_p -20 ± 2 %, amplitude +0.01"]),
    "driver with findings": (
        found_driver,
        ["r_load 98.8 kΩ is +2.02 ± 0.1 % off", "misfit", "misses the recording"],
    ),
    "batch": (lambda: fits().fit, ["2 successful, 1 misfit", "r_p 186 … 186 kΩ"]),
    "one fit": (lambda: fits().take(np.array([0])), ["1 fit of SkinRC: 1 successful"]),
    "fits": (fits, ["3 fits of SkinRC: 2 successful, 1 misfit", "s1 <b> 2/2 33.40 ± 0.10"]),
    "circuit": (lambda: DRY, ["SkinRC", "186 kΩ", "0.12 nF"]),
    "circuits": (lambda: fits().circuit, ["SkinRC", "186 … 186 kΩ"]),
    "stderr": (lambda: fit().stderr, ["SkinRC", "100 Ω"]),
    "scene": (
        lambda: etid.scenes.paper_dry(),
        [
            "1 calibration, 10 trials, 10000 samples",
            "typical/dry/10 r_s 33.4 kΩ, r_p 186 kΩ",
        ],
    ),
    "samples": (lambda: etid.Samples(np.zeros(4, "i2"), 0.5), ["Samples: 4 of int16"]),
    "spectrum": (
        lambda: MeasuredImpedance(np.array([60.0]), np.array([2e5 - 1e3j]), None),
        ["Impedance at 1 frequency", "60 200 -1"],
    ),
    "driver": (driver, ["Driver of order 3: successful", "|Z_th| at 1 kHz", "±", "kΩ"]),
    "study fits": (
        lambda: etid.StudyFits(fits(), {("a/b", "c"): driver()}, {("d",): "no signal"}),
        ["3 fits of SkinRC", "2 drivers, 1 failed", "a/b, c 3 successful", "d: no signal"],
    ),
    "recording": (lambda: study()["s01/dry"], ["s01/dry", "200000 Hz", "<b>"]),
    "study": (study, ["1 calibration, 1 loaded"]),
    "selection": (lambda: Selection.of({0: fit()}, 0, [DRY]), ["1 candidate: successful"]),
    "candidate": (
        lambda: Selection.of({0: fit()}, 0, [DRY]).candidates[0],
        ["Candidate SkinRC", "100.0 %", "r_s 33.40 ± 0.10 kΩ"],
    ),
    "bound": (lambda: Bound("s01", DRY, 1e-4 * np.eye(3)), ["r_s 33.4 kΩ ± 1 %"]),
}


@pytest.mark.parametrize(("make", "texts"), SHOWN.values(), ids=SHOWN)
def test_numbers_have_units_and_no_array_is_printed(make, texts):
    one = make()
    for form in (str, repr):
        shown = " ".join(form(one).split())
        assert [text for text in texts if text not in shown] == []
        assert not ARRAYS.search(shown)
    assert str(one) == one._overview().text()


def test_errors_and_derivatives_are_not_printed_as_a_circuit():
    """A derivative had units such as pΩ and kF; standard errors had the formula of the circuit."""
    errors = fit().stderr
    assert str(errors).startswith("Standard errors of SkinRC\n")
    assert str(copy.deepcopy(errors)) == str(errors)
    assert str(jax.tree.map(np.asarray, DRY)).startswith("SkinRC: R_s")
    derivative = jax.tree.unflatten(jax.tree.structure(DRY), [2.0, 1.8, -1.6e14])
    assert str(derivative).splitlines() == [
        "SkinRC: numbers by element in SI units, no circuit",
        "  r_s         2",
        "  r_p       1.8",
        "  c_p  -1.6e+14",
    ]


def test_a_layout_and_a_change_are_a_sentence():
    assert str(etid.Layout.grid(2, 3, 1e-3)) == "Layout of 6 electrodes, E1 … E6: 2 x 1 mm"
    assert str(Change(7, 3, "jump", "c_p", 1.2345)) == (
        "pulse 7: jump of c_p, to 1.2 times its value, at electrode 3"
    )
    assert (
        str(Change(7, None, "driver", "", np.nan))
        == "pulse 7: the driver has changed; calibrate again"
    )


def test_several_circuits_say_how_many_and_one_does_not():
    assert str(fits().circuit).startswith("SkinRC, batch of (3,)")
    assert "batch" not in str(DRY)


def test_tables_of_fits_are_those_of_before():
    many, numbers = fits(), {}
    size = np.array([1.0, 1.02, 1.1, 0.99, 1.3])
    four = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf[:2]]), many.fit)
    circuit = jax.tree.map(lambda leaf, size=size: leaf * size, four.circuit)
    cov = four.cov * (size**8)[:, None, None]
    varied = {"circuit": circuit, "cov": cov, "shared_cov": 0.3 * cov, "rrse": np.arange(5.0)}
    known = [{"subject": f"s{number}", "condition": "<b>"} for number in (1, 2, 2, 1, 1)]
    many = etid.Fits(dataclasses.replace(four, **varied), described(known), np.array(["why"] * 5))
    columns, units, attributes = many.as_table()
    attributes.pop("etid_version")
    for name, value in (columns | units | attributes).items():
        numbers[name] = kept_numbers.Number(np.asarray(value))
    for number, row in enumerate([*many.summary("subject"), *many.summary()]):
        for name, value in row.items():
            numbers[f"{number}_{name}"] = kept_numbers.Number(np.asarray(value))
    for name, ends in many[0].intervals(0.9).items():
        numbers[f"{name}_interval"] = kept_numbers.Number(np.array(ends))
    numbers["correlation"] = kept_numbers.Number(many.fit.correlation)
    kept_numbers.check("tables", numbers)


@pytest.mark.parametrize("make", [make for make, _ in SHOWN.values()], ids=SHOWN)
def test_a_notebook_shows_the_words_of_the_terminal_as_a_table(make):
    one = make()
    page = one._repr_html_()
    words = re.sub(r"<[^>]*>", " ", page).split()
    escaped = str(one).replace("<", "&lt;").replace(">", "&gt;").replace("'", "&#x27;")
    assert sorted(words) == sorted(escaped.split())
    assert "<table>" in page


def test_a_table_of_a_notebook_has_headings_and_cells():
    page = Overview("a & b", [("  1 ", "x")], ("n", "what"), ["note"]).html()
    assert "<b>a &amp; b</b>" in page
    assert page.count("<th") == 2
    assert re.findall(r"<td[^>]*>(.*?)</td>", page) == ["1", "x"]


def test_a_long_table_is_cut():
    rows = [(str(number),) for number in range(ROWS + 5)]
    shown = Overview("numbers", rows)
    assert shown.text().splitlines()[-1] == "  … and 5 more"
    assert len(shown.text().splitlines()) == ROWS + 2
    assert shown.html().count("<tr>") == ROWS
    assert "… and 40 more" in Overview("numbers", rows[:ROWS], count=ROWS + 40).text()


@pytest.mark.parametrize("make", [fit, lambda: fit().circuit, driver])
def test_what_jax_traces_or_maps_can_be_shown(make):
    seen = []

    def note(one):
        seen.extend([repr(one), str(one), str(one._repr_html_())])
        return jnp.zeros(())

    one = jax.tree.map(jnp.asarray, make())
    jax.jit(note)(one)
    jax.vmap(note)(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), one))
    jax.grad(lambda scale: note(jax.tree.map(lambda leaf: leaf * scale, DRY)))(1.0)
    note(jax.tree.map(lambda _: None, one))
    note(jax.eval_shape(lambda of: of, one))
    assert all(
        type(one).__name__ in text or text == "None" for text in seen if "SkinRC" not in text
    )


@pytest.mark.parametrize(
    ("value", "error", "unit", "text"),
    [
        (33.4e3, 77.0, "ohm", "33.400 ± 0.077 kΩ"),
        (5.5, 0.1, "ohm", "5.50 ± 0.10 Ω"),
        (33.4e3, 33.4e-6, "ohm", "33.4 ± 0 kΩ"),  # a fixed element
        (22e6, 1e6, "ohm", "22.0 ± 1.0 MΩ"),
        (200.02, 0.11, "ohm", "200.02 ± 0.11 Ω"),  # not 0.20002 kΩ
        (0.99978, 4e-4, "ohm", "0.99978 ± 0.00040 Ω"),  # not 999.78 mΩ
        (9.9956e-6, 4e-9, "farad", "9.9956 ± 0.0040 µF"),
        (0.12e-9, 4e-13, "farad", "0.12000 ± 0.00040 nF"),
        (47e-6, 1e-6, "farad", "47.0 ± 1.0 µF"),
        (0.4e-12, 1e-14, "farad", "400 ± 10 fF"),
        (102e-9, 23.5, "ohm", "0 ± 24 Ω"),  # not 102 ± 23540528502 nΩ
    ],
)
def test_the_prefix_of_a_unit_fits_the_value(value, error, unit, text):
    assert quantity(value, unit, error) == text


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (33.29e3, 33.61e3, "33.290 … 33.610 kΩ"),  # a quarter is 0.080 kΩ
        (33e3, 34.2e3, "33.00 … 34.20 kΩ"),
        (5.5, 5.5, "5.5 … 5.5 Ω"),
    ],
)
def test_the_digits_of_an_interval_are_those_of_a_quarter_of_its_length(low, high, text):
    assert between(low, high, "ohm") == text


def test_an_estimate_that_diverges_predicts_nothing():
    diverged = dataclasses.replace(fit("nonphysical"), rrse=np.asarray(np.inf))
    assert "no finite prediction" in str(diverged)
    assert not re.search(r"\binf\b", str(diverged))
