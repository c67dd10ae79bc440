"""What each command of a day prints: when it works, when there is nothing to do, when it fails."""

import pathlib
import shutil

import h5py
import numpy as np
import pytest

import etid
from etid.simulation.scenes import Scene, SkinLoad, Trial, paper_calibration
from etid.simulation.transformer import ResistorLoad
from tests import printed

ROOT = pathlib.Path(__file__).parents[1]
DRY = SkinLoad(33.4e3, 186e3, 0.12e-9)

# Name of the stored text, whether its numbers come from fits, and the commands.
OUTPUTS = {
    "simulate": (False, [
        "simulate paper_dry -o study.h5 --truth truth.json",
        "simulate paper_dry -o study.h5",
        "simulate paper_dri -o other.h5",
        "simulate paper_dry -o absent/study.h5",
    ]),
    "check": (False, [
        "check example.h5",
        "check faults.h5",
        "check milli.h5",
        "check fits.h5",
        "check table.csv",
        "check absent.h5",
    ]),
    "import_file": (False, [
        "import table.csv -o first.h5 --v-th open --v-out skin --sample-rate 2e5 --pulse-rate 60 "
        "--scale 0.0535 --subject s01 --condition dry",
        "import table.csv -o known.h5 --r-load 98k8 --v-th open --v-out skin --sample-rate 2e5 "
        "--pulse-rate 60 --scale 0.0535",
        "import table.csv -o two.h5",
        "import table.csv -o two.h5 --v-th opne --v-out skin --sample-rate 2e5 --pulse-rate 60 "
        "--scale 1",
        "import table.csv -o two.h5 --v-th open --v-out open --sample-rate 2e5 --pulse-rate 60 "
        "--scale 1",
        "import notes.docx -o two.h5 --v-th open --v-out skin --scale 1 --pulse-rate 60",
    ]),
    "import_folder": (False, [
        "import week -o week.h5 --labels '{session}_{r_load}.csv' "
        "--labels '{subject}_{site}_{session}.csv' --v-th CH1 --v-out CH2 --sample-rate 2e5 "
        "--pulse-rate 60 --scale 0.0535",
        "check week.h5",
        "import week -o other.h5 --labels '{subject}-{session}.csv' --v-th CH1 --v-out CH2 "
        "--sample-rate 2e5 --pulse-rate 60 --scale 0.0535",
        "import empty -o other.h5 --labels '{subject}.csv' --v-th CH1 --v-out CH2 --scale 1",
    ]),
    "merge": (False, [
        "merge example.h5 milli.h5 -o merged.h5",
        "merge example.h5 fits.h5 -o other.h5",
        "merge example.h5 -o example.h5",
    ]),
    "calibrate": (True, [
        "calibrate example.h5 -o driver.h5",
        "calibrate two_resistors.h5 -o driver_2.h5 --former driver.h5",
        "calibrate slip.h5 -o other.h5",
        "calibrate loaded.h5 -o other.h5",
        "calibrate fits.h5 -o other.h5",
    ]),
    "fit": (True, [
        "fit example.h5 -o all.h5",
        "fit one.h5 -o one_fit.h5",
        "fit loaded.h5 -o day.h5 --driver two_resistors.h5",
    ]),
    "fit_some": (True, ["fit some.h5 -o some_fits.h5"]),
    "fit_without_driver": (True, [
        "fit slip.h5 -o f.h5",
        "fit flat.h5 -o f2.h5",
        "fit slip.h5 -o f3.h5 --json",
    ]),
    "fit_options": (True, [
        "fit one.h5 -o f.h5 --circuit auto",
        "fit one.h5 -o f3.h5 --fix r_s=33.4e3 --bound r_p=100e3:180e3",
        "fit one.h5 -o f4.h5 --tolerance gain=1e-3 --tolerance r_load=1e-3",
        "fit one.h5 -o f5.h5 --method steiglitz_mcbride",
        "fit one.h5 -o f6.h5 --joint",
        "fit one.h5 -o f7.h5 --json",
    ]),
    "fit_errors": (False, [
        "fit absent.h5 -o f.h5",
        "fit table.csv -o f.h5",
        "fit fits.h5 -o f.h5",
        "fit example.h5 -o example.h5",
        "fit example.h5 -o fits.h5",
        "fit example.h5 -o f.csv",
        "fit paper_calibration.h5 -o f.h5",
        "fit loaded.h5 -o l.h5",
        "fit example.h5 -o f.h5 --circuit SkinCoel",
        "fit example.h5 -o f.h5 --circuit 'R0-p(R1,C1'",
        "fit example.h5 -o f0.h5 --fix r_z=3",
        "fit example.h5 -o f.h5 --fix r_s=three",
        "fit example.h5 -o f1.h5 --bound r_s=5:1",
        "fit example.h5 -o f2.h5 --tolerance gian=0.1",
        "fit example.h5 -o f3.h5 --joint --resume",
        "fit example.h5 -o f.h5 --order 50",
        "fit example.h5 -o f4.h5 --driver fits.h5",
        "fit example.h5",
    ]),
    "report": (False, [
        "report fits.h5",
        "report fits.h5",
        "report example.h5",
        "report fits.h5 -o page.pdf",
    ]),
    "merge_fits_and_circuits": (False, [
        "export fits.h5 -o skin.cir --path typical/dry/01",
        "export fits.h5 -o skin.json --path typical/dry/9",
        "export fits.h5 -o fits.xyz",
        "export example.h5 -o fits.csv",
    ]),
    "no_command": (False, ["", "nonsense", "--help"]),
    "help": (False, [
        f"{name} --help" for name in (
            "import", "calibrate", "check", "fit", "report", "export", "merge", "simulate",
        )
    ]),
}  # fmt: skip
OF_ETID_LIVE = (
    "one.h5 --file pulses.h5 --electrodes 2 --speed 50 --port 0",
    "one.h5 --file pulses.h5 --electrodes 3 --port 0",
    "one.h5 --file absent.h5 --electrodes 2 --port 0",
    "loaded.h5 --file pulses.h5 --port 0",
    "one.h5 --socket localhost --electrodes 2 --port 0",
    "one.h5 --port 0",
    "--help",
)


def _recordings(scene, seed=1):
    return list(scene.simulate(seed=seed).recordings())


def _scene(*calibrations, trials=1, subject="s01", samples=10_000):
    known = tuple(Trial(f"calibration/{r:.0f}", ResistorLoad(r)) for r in calibrations)
    loaded = tuple(
        Trial(f"s01/dry/{i + 1:02d}", DRY, subject=subject, condition="dry", trial=str(i + 1))
        for i in range(trials)
    )
    return Scene(loaded, known, samples=samples, snr_db=60.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with the files of all commands."""
    folder = tmp_path_factory.mktemp("files")
    write = etid.Study.from_recordings
    shutil.copy(ROOT / "data_schema" / "example.h5", folder)
    known, one = _recordings(_scene(98.8e3))
    write([known, one]).write(folder / "one.h5")
    write([known.replace(r_load=98.8), one]).write(folder / "slip.h5")
    write([known.replace(v_out=0 * known.v_out), one]).write(folder / "flat.h5")
    write([one.replace(calibration=())]).write(folder / "loaded.h5")
    write(_recordings(_scene(98.8e3, 21.62e3, trials=0))).write(folder / "two_resistors.h5")
    paper_calibration().simulate(seed=0).write(folder / "paper_calibration.h5")
    _write_some(folder / "some.h5")
    _write_faults(folder / "faults.h5")
    i = 1e-3 * np.sin(2 * np.pi * 60 * np.arange(10_000) / 200e3)
    milli = etid.Recording(
        v_out=5e4 * i, current=1e3 * i, sample_rate=200e3, pulse_rate=60.0, path="milli"
    )
    write([milli]).write(folder / "milli.h5")
    etid.fit_file(folder / "example.h5", folder / "fits.h5")
    with h5py.File(folder / "pulses.h5", "w") as stream:
        stream["v_out"] = np.stack([one.v_out, one.v_out])
    columns = np.column_stack([known.v_th, known.v_out])[:500] * 0.0535
    options = {"delimiter": ",", "comments": "", "fmt": "%.5f"}
    np.savetxt(folder / "table.csv", columns, header="open,skin", **options)
    (folder / "notes.docx").write_bytes(b"PK")
    (folder / "empty").mkdir()
    (folder / "week").mkdir()
    for name in ("d1_98k8", "s01_index_d1", "s02_thumb_d1"):
        np.savetxt(folder / "week" / f"{name}.csv", columns, header="CH1,CH2", **options)
    (folder / "week" / "readme.txt").write_text("cold hands", "utf-8")
    return folder


def _write_some(path):
    """Good trials and one of each usual fault."""
    known, *trials = _recordings(_scene(98.8e3, trials=6))
    v_out = [one.v_out.copy() for one in trials]
    v_out[1][100] = np.nan
    v_out[2][:] = 0.0
    v_out[3] = np.clip(v_out[3], -25.0, 25.0)
    v_out[4] = np.roll(v_out[4], 400)
    changed = [one.replace(v_out=values) for one, values in zip(trials, v_out, strict=True)]
    etid.Study.from_recordings([known, *changed]).write(path)
    with h5py.File(path, "a") as file:
        file.create_group("s01/dry/99").attrs.update(kind="loaded")


def _write_faults(path):
    etid.Study.from_recordings(_recordings(_scene(98.8e3, trials=3))).write(path)
    with h5py.File(path, "a") as file:
        file["calibration/98800/v_th"].attrs["unit"] = "millivolt"
        file["s01/dry/01"].attrs["sample_rate"] = 0.0
        del file["s01/dry/03/v_out"]
        file["s01/dry/02"].attrs["pulse_rate"] = "sixty"


@pytest.fixture
def place(files, tmp_path, monkeypatch):
    """A copy of these files, where commands run in a terminal of a fixed width."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", str(printed.WIDTH))
    return tmp_path


@pytest.mark.parametrize("name", OUTPUTS)
def test_what_a_command_prints(name, place):
    fitted, commands = OUTPUTS[name]
    shown = printed.masked(printed.transcript(*commands), place)
    printed.check(name, shown, fitted=fitted)


def test_what_etid_live_prints(place):
    shown = printed.transcript(*OF_ETID_LIVE, program="etid-live")
    printed.check("live", printed.masked(shown, place), fitted=False)


@pytest.mark.parametrize("options", ["", " --long", " --all"])
def test_what_an_exported_table_holds(options, place):
    shown = printed.transcript(f"export fits.h5 -o fits.csv{options}")
    table = (place / "fits.csv").read_text("utf-8")
    # Changes during a record are noise in a good one, so that their values say nothing.
    table = table.partition("\n")[0] if options == " --all" else table
    printed.check(f"export{options.replace(' --', '_')}", shown + table, fitted=True)


@pytest.mark.parametrize("source", ["example.h5", "some.h5"])
def test_what_the_page_of_a_report_says(source, place):
    assert "page.html" in printed.transcript(f"fit {source} -o page.h5", "report page.h5")
    page = printed.of_page((place / "page.html").read_text("utf-8"))
    name = f"page_{pathlib.Path(source).stem}"
    printed.check(name, printed.masked(page, place), fitted=True)
