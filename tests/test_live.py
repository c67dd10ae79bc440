"""The live view: what a browser shows of a running display, its stop, and what is refused."""

import contextlib
import http.client
import json
import multiprocessing
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import h5py
import numpy as np
import pytest
from chromium import chromium

import etid
from etid.live import view as views
from etid.live.loop import Tick, follow
from etid.live.view import LiveView
from etid.online.stream import Pulses, connected, received, sender
from etid.plotting.layout import Layout
from etid.simulation.transformer import ResistorLoad, Sampler, loading
from tests.test_online import LOADS, NOISE, PERIOD, PULSES, RATE, scene, tracker_of

FEW = 8
WANTED = 80e-9
SKINS = {**LOADS, "open": ResistorLoad(1e9), "short": ResistorLoad(1.0)}


def alone():
    """A pulse alone behind each load, and the period after it: (load, 2, sample) [V]."""
    of = scene(1)
    sampler = Sampler(RATE, PULSES / 2, of.antialias * RATE)
    v_th, z_th = of.driver.v_th_spectrum(sampler.f) * PULSES / 2, of.driver.z_th(sampler.f)
    return {
        name: np.stack(
            [
                sampler.sample(v_th * loading(load(sampler.f), z_th), 3333, start)
                for start in (0.0, 1 / PULSES)
            ]
        )
        for name, load in SKINS.items()
    }


class Stimulator:
    """A display at a socket: gives a pulse of each amplitude that it is sent, and records it.

    Attributes:
        skin: Name of the load at each electrode, which a test may change.
        given: Amplitudes of all pulses.
    """

    def __init__(self, electrodes, pause=0.0):
        self.skin, self.given, self.pause = ["dry"] * electrodes, [], pause
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.server.getsockname()[1]}"
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        pulses, noise = alone(), np.random.default_rng(0)
        with self.server, self.server.accept()[0] as line, line.makefile("rb") as stream:
            before = np.zeros(len(self.skin))
            with contextlib.suppress(ConnectionError):
                while len(told := stream.read(8 * len(self.skin))) == 8 * len(self.skin):
                    now = np.frombuffer(told, "<f8")
                    self.given.append(now)
                    of = np.stack([pulses[name] for name in self.skin])
                    v = now[:, None] * of[:, 0] + before[:, None] * of[:, 1]
                    v += NOISE * noise.standard_normal(v.shape)
                    begin = round((len(self.given) - 1) * PERIOD)
                    line.sendall(np.array([begin, *v.shape], "<i8").tobytes() + v.tobytes())
                    before = now
                    time.sleep(self.pause)
