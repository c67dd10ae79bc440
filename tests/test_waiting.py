"""A person who waits for the compiler is told so, once."""

import io
import sys
import threading
import time

import jax.numpy as jnp
import pytest
from tqdm import tqdm

from etid.numpy_tier import waiting
from etid.numpy_tier.tiers import program


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self):
        return True


@pytest.fixture
def said(monkeypatch):
    """A function that calls another one, and returns what this prints on such a stream."""

    def said(call, screen):
        monkeypatch.setattr(waiting, "PATIENCE", 0.05)
        monkeypatch.setattr(waiting, "_told", threading.Event())
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", screen)
            call()
        return screen.getvalue()

    return said


def slowly_traced():
    def function(x):
        time.sleep(0.5)  # tracing and compiling
        return x + 1

    return program(function, batch=True)


def test_a_long_compilation_is_announced_once(said):
    text = said(lambda: [slowly_traced()(jnp.zeros(3)) for _ in range(2)], Screen())
    assert text.count("JAX compiles") == 1


def test_the_line_does_not_continue_a_progress_bar(said):
    def call():
        with tqdm(total=3, file=sys.stderr, ncols=60):
            slowly_traced()(jnp.zeros(3))

    before, _, _ = said(call, Screen()).partition("etid: JAX compiles")
    assert before.endswith("\r")  # the bar is wiped out, and drawn again below
    assert not before.rstrip("\r").rpartition("\r")[2].strip()


def test_nothing_is_said_when_nothing_compiles(said):
    function = slowly_traced()
    function(jnp.zeros(3))
    assert said(lambda: [function(jnp.zeros(3)), time.sleep(0.1)], Screen()) == ""


def test_nothing_is_said_in_a_file(said):
    assert said(lambda: slowly_traced()(jnp.zeros(3)), io.StringIO()) == ""
