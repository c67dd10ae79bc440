"""The arithmetic of the demo's tables."""

import dataclasses

import numpy as np
import pytest

import etid
from benchmarks.paper import demo, tables
from tests import pictures, printed

EXCESS = 1.1  # of every identified element over the true one


@pytest.fixture
def outcome():
    """Every element `EXCESS` times the true one with an error of 100 %; half of it successful."""
    scene = etid.scenes.paper()
    truth, trials = scene.truth(), {trial.path: trial for trial in scene.trials}

    def fits(circuit, paths):
        values = [EXCESS * np.array([truth[path][name] for path in paths])
                  for name in circuit.names()]  # fmt: skip
        verdicts = np.resize(["successful", "misfit"], len(paths))
        fit = dataclasses.replace(
            pictures.fit(verdicts, circuit(*values), 1.0), rrse=np.full(len(paths), 0.05)
        )
        names = ("path", "subject", "condition", "electrode", "trial")
        labels = {name: np.array([getattr(trials[path], name) for path in paths]) for name in names}
        return pictures.fits_of(fit, **labels)

    skins = fits(etid.SkinRC, [path for path in truth if "r_s" in truth[path]])
    resistors = fits(etid.Resistor, [path for path in truth if path.startswith("resistors/")])
    return tables.Outcome("quiet", "output_error", truth, pictures.driver(), skins, resistors)


def test_demo_tables_show_the_error_that_was_made(outcome):
    assert demo.table_1([outcome]).rows[1][2:] == ("10.00",) * 5
    for condition in ("dry", "damp"):
        rows = demo.table_fingertips([outcome], condition).rows
        ours = [row for row in rows if row[0] == "quiet"]
        assert len(ours) == len(rows) - len(ours) == 3
        good = outcome.skins.verdicts[outcome.skins.labels["condition"] == condition]
        counted = f"{(good == 'successful').sum()}/60"  # ten trials and ten subjects of five
        for row in ours:
            assert (row[4], row[5], row[7], row[8], row[9]) == (
                "10.00", "0.00", "10.00", "10.00", counted,
            )  # fmt: skip
    built = demo.table_4([outcome]).rows[1]
    assert built[2:] == ("10.00 / 0.00",) * 3 + ("5.00", "12/23")
    verdicts = demo.table_verdicts([outcome]).rows[0]
    assert verdicts[2:] == ("successful", "72 successful, 71 misfit", *("100 %",) * 3)


def test_the_tables_that_the_demo_prints(outcome):
    shown = "\n\n".join(map(str, demo.sections([outcome])))
    printed.check("demo_tables", shown, fitted=False)


@pytest.mark.slow
def test_all_that_the_demo_prints(tmp_path, capsys):
    demo.main([str(tmp_path)])
    shown = printed.masked(capsys.readouterr().out, tmp_path)
    # Steiglitz-McBride does not converge in some of its fits.
    printed.check("demo", shown, fitted=True, chaotic=True)
