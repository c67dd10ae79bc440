"""What an installed etid must do, in Python and on the command line; run outside the source tree.

    python -I smoke.py

It needs nothing but what the wheel has brought, and ends with an AssertionError if that fails.
"""

import importlib.metadata
import importlib.resources
import json
import os
import pathlib
import statistics
import subprocess
import sys
import sysconfig
import tempfile
import time

PROGRAM = pathlib.Path(sysconfig.get_path("scripts"), "etid")
TRUTH = {"r_s": 33.4e3, "r_p": 186e3, "c_p": 0.12e-9}


def seconds(code):
    """Median of three processes, after one that compiles to bytecode."""
    times = []
    for _ in range(4):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-I", "-c", code], check=True)
        times.append(time.perf_counter() - begun)
    return statistics.median(times[1:])


def command(*arguments, status=0):
    """The JSON object a command prints, which must end with this status."""
    done = subprocess.run(
        [PROGRAM, *map(str, arguments), "--json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == status, (arguments, done)
    return json.loads(done.stdout)


def in_python():
    """Simulate, fit, and compare with the truth."""
    import jax.monitoring

    import etid

    compiled = []

    def listen(event, _, **of):
        if "backend_compile" in event:
            compiled.append(of.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(listen)

    assert "site-packages" in etid.__file__, f"{etid.__file__} is not the installed one"
    assert importlib.metadata.version("etid") == etid.__version__
    assert importlib.resources.files("etid").joinpath("py.typed").is_file()
    study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
    driver = etid.identify_driver(study["calibration/98k8"], order=5)
    fit = etid.identify_skin(study["typical/dry/01"], driver)
    assert fit.verdict == "successful"
    for name, true in TRUTH.items():
        error = abs(float(getattr(fit.circuit, name)) - true)
        assert error < 5 * float(getattr(fit.stderr, name)), name  # 1 in 10⁶ by chance
    skins = [study[path] for path in study if path.startswith("typical")]
    batch = etid.identify_skins(skins * 50, driver)
    assert not compiled, f"small work compiles {compiled}"
    assert batch.counts()["successful"] >= 450, batch.counts()  # one of ten is a false alarm


def on_the_command_line(folder):
    """The same from file to file, read again."""
    import etid

    study, fits = folder / "study.h5", folder / "fits.h5"
    assert command("simulate", "paper_dry", "-o", study)["recordings"] == 11
    assert command("check", study)["problems"] == []
    found = command("fit", study, "-o", fits)
    assert found["verdicts"] == {"successful": 10}, found
    assert etid.Fits.read(fits).counts() == found["verdicts"]
    command("report", fits, "-o", folder / "report.html")
    new = folder / "new.h5"
    assert "no such file" in command("fit", folder / "absent.h5", "-o", new, status=1)["error"]
    assert "--force" in command("fit", study, "-o", fits, status=1)["error"]  # it exists
    wrong = subprocess.run([PROGRAM, "fit"], capture_output=True, check=False)
    assert wrong.returncode == 2
    subprocess.run([PROGRAM.with_name("etid-live"), "--help"], capture_output=True, check=True)


def main():
    """Run all of it and say how long an import takes."""
    names = ("equinox", "jax", "lineax", "numpy", "optimistix", "scipy", "h5py", "matplotlib")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    print(f"Python {sys.version.split()[0]}: {versions}")
    in_python()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # what commands compile is not to stay
        on_the_command_line(pathlib.Path(folder))
    both, jax_alone = seconds("import etid"), seconds("import jax, optimistix")
    print(f"  import etid {both:.2f} s, of which JAX and optimistix {jax_alone:.2f} s")


if __name__ == "__main__":
    main()
