"""The fields of a recording are declared once: a new one is a change of one file."""

import os
import pathlib
import shutil
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[1]
BEFORE = "    adc_range: tuple[float, float] | None"
NEW = """\
    temperature: float | None = _field(
        "number", unit="kelvin", positive=True, description="Of the skin.", example=306.0
    )
"""
USE = """
import pathlib, runpy, sys
import h5py, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import etid
from etid import cli
from etid.report.study import summary
from etid.results.columns import described
from etid.results.verdicts import verdicts_of

folder, make_page = pathlib.Path(sys.argv[1]), sys.argv[2]
volts = np.sin(np.arange(40.0))
rates = {"sample_rate": 200e3, "pulse_rate": 60.0}
warm = etid.Recording(volts, volts, path="a/0", temperature=306, trial=0, **rates)
other = etid.Recording(volts, volts, path="b", **rates)
for wrong in (-1.0, "warm"):
    try:
        warm.replace(temperature=wrong)
    except etid.RecordingError as error:
        assert "temperature: is" in str(error), error
    else:
        raise AssertionError(wrong)

# write, read, check
etid.Study.from_recordings([warm, other]).write(folder / "study.h5")
assert etid.check(folder / "study.h5") == []
with etid.read(folder / "study.h5") as study:
    known = [vars(study.metadata(path)) for path in study]
assert [of["temperature"] for of in known] == [306.0, None]
with h5py.File(folder / "study.h5", "a") as file:
    file["a/0"].attrs["temperature"] = "warm"
[problem] = etid.check(folder / "study.h5")
assert "[kelvin]" in str(problem), problem

# import, by a mapping and by the command
table = "t,a,b\\n" + "\\n".join(f"{i / 200e3},{v},{v}" for i, v in enumerate(volts))
(folder / "table.csv").write_text(table)
said = {"v_th": "a", "v_out": "b", "time": "t", "pulse_rate": 60.0, "scale": 1, "temperature": 305}
units = {"time": "s"}
mapping = {
    name: {"channel": value, "unit": units.get(name, "V")} if isinstance(value, str) else value
    for name, value in said.items()
}
etid.import_file(folder / "table.csv", folder / "mapped.h5", mapping)
options = [word for name, value in said.items()
           for word in ("--" + name.replace("_", "-"), str(value))]
assert cli.main(["import", str(folder / "table.csv"), "-o", str(folder / "told.h5"), *options]) == 0
for name in ("mapped.h5", "told.h5"):
    with etid.read(folder / name) as study:
        assert study["loaded/0"].temperature == 305.0

# fits: table, file, export, report
nothing = np.zeros((2, 3, 3))
fit = etid.Fit(etid.SkinRC(*np.ones((3, 2))), nothing, nothing, np.zeros(2), np.ones(2),
               verdicts_of(np.array(["successful"] * 2)), np.ones(2, int), "output_error",
               np.zeros(2, int))
fits = etid.Fits(fit, described(known), np.array(["", ""]))
np.testing.assert_array_equal(fits.table()["temperature"], [306.0, np.nan])
fits.write(folder / "fits.h5")
read = etid.Fits.read(folder / "fits.h5")
np.testing.assert_array_equal(read.table()["temperature"], [306.0, np.nan])
etid.export_fits(folder / "fits.h5", folder / "fits.csv")
assert "temperature [kelvin]" in (folder / "fits.csv").read_text().splitlines()[0].split(",")
assert "temperature 306 to 306 kelvin" in summary(etid.StudyFits(read, {}, {}))

# the page of the schema
runpy.run_path(make_page)["write"](folder)
assert "| `temperature` | number | () | kelvin | optional |" in (folder / "README.md").read_text()
"""


def test_a_new_field_passes_through_everything_from_its_declaration_alone(tmp_path):
    package = tmp_path / "etid"
    shutil.copytree(ROOT / "etid", package, ignore=shutil.ignore_patterns("__pycache__"))
    file = package / "recordings" / "fields.py"
    text = file.read_text("utf-8")
    assert text.count(BEFORE) == 1
    file.write_text(text.replace(BEFORE, NEW + BEFORE), encoding="utf-8")
    (tmp_path / "use.py").write_text(USE, encoding="utf-8")
    page = ROOT / "data_schema" / "make_page.py"
    done = subprocess.run(
        [sys.executable, "use.py", str(tmp_path), str(page)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
