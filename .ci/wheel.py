"""Build wheel and sdist, check them for an upload, and try the wheel in environments of its own.

    python .ci/wheel.py --python python3.11 python3.13 --dependencies newest oldest

In each environment the README's sixty seconds are followed, too. The oldest dependencies are the
lower bounds that pyproject.toml names, exactly. An interpreter that this machine does not have is
named, and the others are tried. Interpreters of pyenv are found with
PYENV_VERSION=3.11.7:3.12.1:3.13.0.
"""

import argparse
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib

ROOT = pathlib.Path(__file__).parents[1]


def run(*command, **options):
    """Run a program that has to succeed."""
    subprocess.run([str(part) for part in command], check=True, **options)


def built(folder):
    """The wheel, which is built from the sdist."""
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, stdout=subprocess.DEVNULL)
    run(sys.executable, "-m", "twine", "check", "--strict", *sorted(folder.iterdir()))
    for path in sorted(folder.iterdir()):
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")
    return next(folder.glob("*.whl"))


def bounds():
    """The dependencies of pyproject.toml at their lower bounds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    return [each.replace(">=", "==") for each in project["dependencies"]]


def present(interpreter):
    """Whether there is such an interpreter; a name alone may be there for another version."""
    try:
        asked = subprocess.run([interpreter, "--version"], capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return asked.returncode == 0


def tried(interpreter, wheel, dependencies, folder):
    """Install the wheel in an environment of its own and run what it must do."""
    run(interpreter, "-m", "venv", folder)
    python = folder / "bin" / "python"
    install = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    run(*install, "--only-binary", ":all:", wheel, *dependencies)
    run(python, "-m", "pip", "check", stdout=subprocess.DEVNULL)
    run(python, "-I", ROOT / ".ci" / "smoke.py", cwd=folder)
    follow_readme(python, folder / "clone")


def follow_readme(python, clone):
    """After the README's `pip install .`: its example with words and picture, and its commands."""
    text = (ROOT / "README.md").read_text("utf-8")
    section = text.split("## Sixty seconds\n")[1].split("\n## ")[0]
    installed, example, told = re.findall(r"```\w*\n(.*?)```", section, re.DOTALL)
    assert installed == "pip install .\n"
    (clone / "data_schema").mkdir(parents=True)
    shutil.copy(ROOT / "data_schema" / "example.h5", clone / "data_schema")
    command = [python, "-I", "-c", example]
    printed = subprocess.run(command, cwd=clone, check=True, capture_output=True, text=True).stdout
    # tests/test_notebooks.py compares the digits, with the versions of constraints.txt
    words = [re.sub(r"[\d.]+", "#", of).split() for of in (told, printed)]
    assert words[0] == words[1], printed
    assert (clone / "fit.png").stat().st_size > 10_000
    for program, *arguments in map(str.split, re.findall("`(etid [^`]*)`", section)):
        run(python.parent / program, *arguments, cwd=clone, capture_output=True)
    assert (clone / "fits.html").stat().st_size > 100_000
    print("  the README's sixty seconds: as it says")


def main():
    """Try every interpreter with the dependencies that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", nargs="+", default=[sys.executable], metavar="PROGRAM")
    sets = {"newest": [], "oldest": bounds()}
    parser.add_argument("--dependencies", nargs="+", choices=sets, default=["newest"])
    arguments = parser.parse_args()
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        wheel = built(pathlib.Path(folder, "dist"))
        for interpreter in arguments.python:
            if not present(interpreter):
                print(f"{interpreter}: not tried, this machine does not have it")
                continue
            for name in arguments.dependencies:
                place = pathlib.Path(folder, f"{name}-{pathlib.Path(interpreter).name}")
                print(f"{interpreter}, {name} dependencies", flush=True)
                try:
                    tried(interpreter, wheel, sets[name], place)
                except (subprocess.CalledProcessError, AssertionError) as error:
                    print(f"  failed: {error}")
                    failed.append(f"{interpreter} with the {name} dependencies")
    return f"the wheel fails on {', '.join(failed)}" if failed else 0


if __name__ == "__main__":
    sys.exit(main())
