"""Two kinds of data that etid does not have: all that one has to write for them.

- The current of a load is measured twice, before and behind it.
- Two loads are in series, and one is known: the voltage of both and that of the known one.

`fit` gives standard errors, score tests and a verdict, for any outputs.
"""

from typing import ClassVar

import numpy as np

import etid
from etid.circuits.elements import resistor
from etid.circuits.impedance import series
from etid.estimators.maximum_likelihood.rows import load_with
from etid.estimators.maximum_likelihood.verdict import ACCEPT, judged
from etid.likelihood.fit import fit as estimated
from etid.likelihood.gains import AbstractOutputs, Gains
from etid.likelihood.profile import Records
from etid.likelihood.starts import starts
from etid.results.verdicts import verdict

KNOWN = 47e3  # [Ω]


class TwoCurrents(AbstractOutputs):
    """V_out, and the current twice."""

    count: ClassVar[int] = 3

    def __call__(self, z_load, current):
        return [(z_load * current, current, z_load), (current, 0.0, 1.0), (current, 0.0, 1.0)]


class WithKnown(AbstractOutputs):
    """The voltage of a load with a known resistor behind it, and that of the resistor."""

    count: ClassVar[int] = 2

    def __call__(self, z_load, current):
        return [(z_load * current, current, z_load), (KNOWN * current, 0.0, KNOWN)]


class SkinAndKnown(etid.SkinRC):
    """Skin in series with the known resistor."""

    def impedance(self):
        return series(resistor(KNOWN), super().impedance())


def fit(gains: Gains, records: Records) -> etid.Fit:
    """The loads of recordings, side by side."""
    load, circuit = load_with(gains, records), gains.circuit
    changed = np.zeros(len(records.x), bool)
    of = circuit, changed, verdict("successful"), "new data", None, (), ACCEPT
    return judged(estimated(load, starts(load)), *of)
