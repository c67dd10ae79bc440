"""Ctrl-C while the command is still imported: one line, status 130, every time."""

import subprocess
import sys

import pytest

# Interrupts itself when a module is imported, as the user would. With `lost` it does so within a
# callback of the garbage collector, where Python ignores exceptions.
EARLY = """
import gc, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
(module, how), sys.argv[1:] = sys.argv[1:], ["report"]

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            if how == "lost":
                gc.callbacks.append(lambda *_: os.kill(os.getpid(), signal.SIGINT))
                gc.collect()
            else:
                os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Finder())
from etid.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("program", "module", "how"),
    [
        ("etid", "jax", "raised"),
        ("etid", "jax", "lost"),
        ("etid", "etid.commands.report", "raised"),
        ("etid-live", "etid.display.command", "raised"),
    ],
)
def test_ctrl_c_during_the_imports_is_one_line(program, module, how):
    package = {"etid": "etid", "etid-live": "etid.display"}[program]
    code = EARLY.replace("from etid.", f"from {package}.")
    done = subprocess.run(
        [sys.executable, "-c", code, module, how], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == f"{program}: interrupted: nothing was changed\n"


def test_a_program_in_the_background_is_not_interrupted():
    """A shell lets a program in the background ignore Ctrl-C."""
    code = EARLY.replace("signal.default_int_handler", "signal.SIG_IGN")
    done = subprocess.run(
        [sys.executable, "-c", code, "jax", "raised"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2  # a report of which file?
    assert done.stderr.startswith("usage: etid report")
