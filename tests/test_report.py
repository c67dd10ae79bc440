"""Tables and pages, and the arithmetic of the demo's tables."""

import csv
import dataclasses
import html.parser
import re

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks import paper
from benchmarks.__main__ import asked
from etid.paper import demo, tables
from etid.report import html as report
from etid.results.driver import DiscreteDriver
from etid.results.verdicts import verdict, verdicts_of

EXCESS = 1.1  # of every identified element over the true one


def test_table_sets_words_left_and_numbers_right():
    table = report.Table(("name", "value", "verdict"), (("a", "1.5", "flat"), ("bc", "", "ok")))
    assert str(table).splitlines() == [
        "name  value  verdict",
        "a       1.5  flat",
        "bc           ok",
    ]


@pytest.mark.parametrize(
    ("rows", "groups", "message"),
    [((("1",),), (), "1 cells for 2 columns"), ((), (("x", 1),), "span 1 columns of 2")],
)
def test_a_table_refuses_rows_and_headings_that_do_not_cover_it(rows, groups, message):
    with pytest.raises(ValueError, match=message):
        report.Table(("a", "b"), rows, groups)


class _Balance(html.parser.HTMLParser):
    """Fails on an element that is not closed where it was opened."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_page_is_whole_escaped_and_needs_no_other_file(tmp_path):
    picture = report.Picture("caption <c>", b"<svg xmlns='http://www.w3.org/2000/svg'/>", 'a "b"')
    table = report.Table(("x", "y"), (("<1>", "2"),), (("", 1), ("<g>", 1)), "of <t>")
    section = report.Section(
        "R < 1", "a & `b < c`", (table,), (picture,), "<w>", "in full", "@x{<key>}"
    )
    report.write_page(tmp_path / "page.html", "Title <t>", "text", [section])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    parser = _Balance()
    parser.feed(page)
    assert parser.open == []
    for escaped in (
        "Title &lt;t&gt;", "R &lt; 1", "a &amp; <code>b &lt; c</code>",
        "&lt;1&gt;", "&lt;g&gt;", "of &lt;t&gt;",
        "caption &lt;c&gt;", "a &#34;b&#34;", "&lt;w&gt;", "@x{&lt;key&gt;}",
    ):  # fmt: skip
        assert escaped in page
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)"', page))
    assert re.findall(r'href="([^"]*)"', page) == ["#r-1"]
    assert 'id="r-1"' in page


def _fits(circuit, paths, elements, excess):
    """Fits of which every element is `excess` times the true one, half successful."""
    study = etid.scenes.paper()
    labels = {trial.path: trial for trial in study.trials}
    values = {
        name: np.array([excess * element[name] for element in elements]) for name in circuit.names()
    }
    size, count = len(values), len(paths)
    cov = np.zeros((count, size, size))
    cov[:, range(size), range(size)] = np.stack(list(values.values()), -1) ** 2  # 100 % error
    verdicts = np.array(["successful", "misfit"] * count)[:count]
    fit = etid.Fit(
        circuit=circuit(**values),
        cov=cov,
        shared_cov=0 * cov,
        rrse=np.full(count, 0.05),
        chi2=np.ones(count),
        result=verdicts_of(verdicts),
        steps=np.ones(count, int),
        method="output_error",
        remarks=np.zeros(count, int),
    )
    names = ("path", "subject", "condition", "electrode", "trial")
    columns = {name: np.array([getattr(labels[path], name) for path in paths]) for name in names}
    return etid.Fits(fit, columns, np.full(count, ""))


def _outcome(excess):
    truth = etid.scenes.paper().truth()
    skins = [path for path in truth if "r_s" in truth[path]]
    resistors = [path for path in truth if path.startswith("resistors/")]
    driver = DiscreteDriver(
        b=jnp.ones(2), a=jnp.ones(2), sample_rate=2e5,
        rrse=jnp.array(0.1), chi2=jnp.array(1.0), result=verdict("successful"), steps=jnp.array(1),
        method="by hand",
    )  # fmt: skip
    return tables.Outcome(
        "quiet",
        "output_error",
        driver,
        _fits(etid.SkinRC, skins, [truth[path] for path in skins], excess),
        _fits(etid.Resistor, resistors, [truth[path] for path in resistors], excess),
    )


@pytest.fixture
def outcome():
    return _outcome(EXCESS)


def test_demo_tables_show_the_error_that_was_made(outcome):
    truth = etid.scenes.paper().truth()
    assert [row[2] for row in demo.table_1([outcome]).rows] == ["10.00"] * 5
    for condition in ("dry", "damp"):
        rows = demo.table_fingertips([outcome], truth, condition).rows
        ours = [row for row in rows if row[0] == "quiet"]
        assert len(ours) == len(rows) - len(ours) == 3
        good = outcome.skins.verdicts[outcome.skins.labels["condition"] == condition]
        counted = f"{(good == 'successful').sum()}/60"  # ten trials and ten subjects of five
        for row in ours:
            assert (row[4], row[5], row[7], row[8], row[9]) == (
                "10.00", "0.00", "10.00", "10.00", counted,
            )  # fmt: skip
    built = demo.table_4([outcome], truth).rows[1]
    assert built[2:] == ("10.00 / 0.00",) * 3 + ("5.00", "12/23")
    verdicts = demo.table_verdicts([outcome], truth).rows[0]
    assert verdicts[2:] == ("successful", "72 successful, 71 misfit", *("100 %",) * 3)


# --- the paper's tables by cause (benchmarks/paper.py) --------------------------------------------


@pytest.fixture
def groups(outcome):
    """Two studies whose elements are 10 and 30 % too large."""
    return {("good", "output_error"): [outcome, _outcome(1.3)]}


def test_tables_tell_errors_of_studies_from_scatter_of_trials(groups):
    truth = etid.scenes.paper().truth()
    between = np.sqrt(200.0)  # standard deviation of 10 and 30
    for row in paper.table_1(groups):
        assert (row["circuits"], row["fits"]) == (2, 2)
        found = [row[name] for name in ("error", "spread", "rms")]
        np.testing.assert_allclose(found, [20.0, between, np.sqrt(500.0)])
    rows = paper.table_4(groups, truth)
    assert [row["element"] for row in rows] == ["r_p", "c_p", "r_s"]
    for row in rows:
        assert (row["circuits"], row["successful"], row["studies"]) == (46, 24, 2)
        found = [row[name] for name in ("error", "between", "scatter", "rrse")]
        np.testing.assert_allclose(found, [20.0, between, 0.0, 5.0], atol=1e-9)
        # every fit has an error of 100 %, nothing is shared, and a study has 23 trials
        assert row["stderr"] == pytest.approx(100 * 1.2 / np.sqrt(23))


def _without(fits, rows):
    """The same fits, of which some found no circuit."""
    values = {name: np.array(getattr(fits.circuit, name)) for name in fits.circuit.names()}
    for column in values.values():
        column[rows] = np.nan
    circuit = type(fits.circuit)(**values)
    return dataclasses.replace(fits, fit=dataclasses.replace(fits.fit, circuit=circuit))


def test_fits_without_a_circuit_are_counted_and_left_out(outcome):
    truth = etid.scenes.paper().truth()
    lost = outcome.skins.labels["path"] == "built/01"
    some = dataclasses.replace(outcome, skins=_without(outcome.skins, lost))
    groups = {("good", "output_error"): [some]}
    for row in paper.table_4(groups, truth):
        assert (row["circuits"], row["fits"]) == (22, 23)
        assert row["error"] == pytest.approx(10.0)


def test_each_cause_is_one_change_of_the_good_laboratory():
    good, both = paper.LABORATORIES["good"], paper.LABORATORIES["both"]
    default = {"trigger_jitter_rms": 0.0, **good}
    for name, settings in paper.LABORATORIES.items():
        changed = [key for key, value in {**default, **settings}.items() if value != default[key]]
        assert len(changed) == {"good": 0, "both": 2}.get(name, 1)
    alone = [paper.LABORATORIES[name] for name in ("noise 40 dB", "delays 200 ns")]
    assert {**alone[1], **alone[0]} == both


def test_a_study_has_the_resistors_and_trials_of_the_built_circuit():
    few, whole = ([t.path for t in paper.scene_of("both", quick).trials] for quick in (True, False))
    assert (len(few), len(whole)) == (5 + 3, 5 + 23)
    assert {"resistors/555k", "built/03"} <= {*few}


def test_what_is_missed_is_said(groups):
    truth = etid.scenes.paper().truth()
    same = {
        ("good", paper.DEFAULT): groups["good", "output_error"],
        (paper.OWN_NOISE, paper.DEFAULT): groups["good", "output_error"],
    }
    first, fourth = paper.table_1(same), paper.table_4(same, truth)
    assert [of.met for of in paper.targets(first, fourth)] == [False, True, True, True]
    for row in fourth:
        row["stderr"] /= 10.0
    assert not any(of.met for of in paper.targets(first, fourth))


@pytest.mark.slow
def test_the_papers_tables_and_the_figure_of_causes_are_made(tmp_path, capsys):
    assert paper.main(asked(["paper", "--quick", "--folder", str(tmp_path)]))
    for number in (1, 4):
        with (tmp_path / f"table_{number}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["laboratory"] for row in rows} == set(paper.LABORATORIES)
        assert {row["source"] for row in rows} == {"simulated"}
    assert (tmp_path / "table_4.svg").read_text().startswith("<?xml")
    assert "white noise alone shifts all trials by -28" in capsys.readouterr().out
