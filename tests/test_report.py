"""Tables and pages, and the arithmetic of the demo's tables."""

import html.parser
import re

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid import demo, experiments, report
from etid.verdicts import verdict, verdicts_of

EXCESS = 1.1  # of every identified element over the true one


def test_table_sets_words_left_and_numbers_right():
    table = report.Table(("name", "value", "verdict"), (("a", "1.5", "flat"), ("bc", "", "ok")))
    assert str(table).splitlines() == [
        "name  value  verdict",
        "a       1.5  flat",
        "bc           ok",
    ]


def test_table_refuses_a_row_of_another_length():
    with pytest.raises(ValueError, match="1 cells for 2 columns"):
        report.Table(("a", "b"), (("1",),))


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
    figure = tmp_path / "figure.svg"
    figure.write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    section = report.Section(
        "R < 1", "a & b", (report.Table(("x",), (("<1>",),)),), (("caption <c>", figure),)
    )
    report.write_page(tmp_path / "page.html", "Title <t>", "text", [section])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    parser = _Balance()
    parser.feed(page)
    assert parser.open == []
    for escaped in ("Title &lt;t&gt;", "R &lt; 1", "a &amp; b", "&lt;1&gt;", "caption &lt;c&gt;"):
        assert escaped in page
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)"', page))
    assert "href" not in page


def _fits(circuit, paths, elements):
    """Fits of which every element is `EXCESS` times the true one, half successful."""
    study = etid.scenes.paper()
    labels = {trial.path: trial for trial in study.trials}
    values = {
        name: np.array([EXCESS * element[name] for element in elements]) for name in circuit.names()
    }
    size, count = len(values), len(paths)
    cov = np.zeros((count, size, size))
    cov[:, range(size), range(size)] = np.stack(list(values.values()), -1) ** 2  # 100 % error
    verdicts = np.array(["successful", "misfit"] * count)[:count]
    fit = etid.Fit(
        circuit(**values), cov, 0 * cov, np.full(count, 0.05), np.ones(count),
        verdicts_of(verdicts), np.ones(count, int), "output_error",
    )  # fmt: skip
    names = ("path", "subject", "condition", "electrode", "trial")
    columns = {name: np.array([getattr(labels[path], name) for path in paths]) for name in names}
    return etid.Fits(fit, columns, np.full(count, ""))


@pytest.fixture
def outcome():
    truth = etid.scenes.paper().truth()
    skins = [path for path in truth if "r_s" in truth[path]]
    resistors = [path for path in truth if path.startswith("resistors/")]
    driver = etid.Driver(
        b=jnp.ones(2), a=jnp.ones(2), sample_rate=2e5, source=None, cov=None, calibration=None,
        rrse=jnp.array(0.1), chi2=jnp.array(1.0), result=verdict("successful"), steps=jnp.array(1),
        method="by hand",
    )  # fmt: skip
    return experiments.Outcome(
        "quiet",
        "output_error",
        driver,
        _fits(etid.SkinRC, skins, [truth[path] for path in skins]),
        _fits(etid.Resistor, resistors, [truth[path] for path in resistors]),
    )


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
