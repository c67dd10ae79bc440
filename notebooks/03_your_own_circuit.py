# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Your own circuit
#
# At the end you will know how to identify a circuit of your own, in ten lines from its definition
# to a SPICE netlist: skin of two layers, and skin with Cole's relaxation, a constant-phase element.
# etid has both, as `etid.SkinLayers` and `etid.SkinCole`; this is how they are made. You will also
# know how to see that a circuit is too small, or too large.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)  # before the first array: etid needs float64

import numpy as np

import etid
from etid.circuits.elements import Exponent, Farad, Ohm, Second

SEED = 0


# %% [markdown]
# ## Two circuits
# A circuit is a class with named parameters, each with a unit and a typical value where fits start,
# and one method, which connects elements. Stratum corneum and the living skin below it are two
# relaxations in series:


# %%
class SkinTwoLayer(etid.AbstractCircuit):
    r_s: Ohm = etid.parameter("ohm", typical=20e3)
    r_1: Ohm = etid.parameter("ohm", typical=80e3)
    c_1: Farad = etid.parameter("farad", typical=0.2e-9)
    r_2: Ohm = etid.parameter("ohm", typical=40e3)
    c_2: Farad = etid.parameter("farad", typical=2e-9)

    def impedance(self):
        outer = etid.parallel(etid.resistor(self.r_1), etid.capacitor(self.c_1))
        inner = etid.parallel(etid.resistor(self.r_2), etid.capacitor(self.c_2))
        return etid.series(etid.resistor(self.r_s), outer, inner)


# %% [markdown]
# Cole (1940) found that the relaxation of membranes is spread over time constants,
# R / (1 + (jωτ)^α) with α below 1. No filter with a finite number of coefficients has this
# impedance; at the harmonics of the pulses it is exact.


# %%
class SkinCole(etid.AbstractCircuit):
    r_s: Ohm = etid.parameter("ohm", typical=20e3)
    r_p: Ohm = etid.parameter("ohm", typical=100e3)
    tau: Second = etid.parameter("second", typical=30e-6)
    alpha: Exponent = etid.parameter("1", typical=0.9)

    def impedance(self):
        return etid.series(etid.resistor(self.r_s), etid.cole(self.r_p, self.tau, self.alpha))


# %%
truth = {
    "one RC": etid.SkinRC(r_s=33.4e3, r_p=186e3, c_p=0.12e-9),
    "two layers": SkinTwoLayer(r_s=33.4e3, r_1=150e3, c_1=0.12e-9, r_2=36e3, c_2=5e-9),
    "Cole": SkinCole(r_s=33.4e3, r_p=186e3, tau=22e-6, alpha=0.85),
}
etid.plot(truth)

# %% [markdown]
# ## Recordings
# A load of a scene may be any circuit. With your own recordings, `etid.read("study.h5")` takes the
# place of this cell.

# %%
trials = tuple(etid.scenes.Trial(name, circuit) for name, circuit in truth.items())
calibration = etid.scenes.paper_calibration().calibration
scene = etid.scenes.Scene(trials, calibration, snr_db=60.0, trigger_jitter_rms=50e-9)
study = scene.simulate(SEED)
driver = etid.identify_driver(study["calibration/98k8"])
study

# %% [markdown]
# ## Elements with standard errors
# Nothing else has to be said of a circuit: the fit, its gradients, the covariance and the units
# follow from its ten lines. It starts at the typical values.

# %%
layers = etid.identify_skin(study["two layers"], driver, circuit=SkinTwoLayer())
print(layers)

# %%
spread = etid.identify_skin(study["Cole"], driver, circuit=SkinCole())
print(spread)

# %% [markdown]
# What rings in the residual at the edges lies near half the sample rate, where the recording holds
# what has aliased; the fit itself leaves that out.

# %%
etid.plot(spread, study["Cole"], driver)

# %% [markdown]
# ## Could it be known better?
# The Cramer-Rao bound of the scene is the smallest standard error of any unbiased estimator that
# has no model of the driver. A fit, which has one, comes close to it or is a little better.

# %%
bounds = etid.bound(scene)
for name, fit in {"two layers": layers, "Cole": spread}.items():
    print(name)
    for element, smallest in bounds[name].stderr.items():
        print(f"  {element:<6} {float(getattr(fit.stderr, element)) / smallest:.2f} of the bound")

# %% [markdown]
# ## Is it the right circuit?
# **Too small.** With one RC for the skin of two layers, or for Cole's, R_s would be off by 10 and
# 45 %. The verdict says that the circuit cannot be it: `misfit`; or `inconsistent` where the fit
# had to bend the impedance of the driver to come near.

# %%
small = {
    name: etid.identify_skin(study[name], driver, throw=False) for name in ("two layers", "Cole")
}
for name, fit in small.items():
    print(f"{name:<12} {fit.verdict:<13} χ² {float(fit.chi2):.3g}")
    print(f"{'':<12} R_s {float(fit.circuit.r_s) / 1e3:.1f} kΩ, in truth 33.4 kΩ\n")

# %% [markdown]
# **Too large.** Two layers for skin that is one RC: the recording does not tell the layers apart,
# their standard errors exceed their values, and the verdict is `insensitive`. Cole's circuit is not
# too large, for α = 1 is one RC; α is found to be 1 within its error.

# %%
large = etid.identify_skin(study["one RC"], driver, circuit=SkinTwoLayer(), throw=False)
print(large)

# %%
one = etid.identify_skin(study["one RC"], driver, circuit=SkinCole())
print(one)

# %% [markdown]
# ## To other programs
# `etid.netlist` writes a subcircuit that any SPICE simulates, to be used as `X1 out 0 skin`.

# %%
netlist = etid.netlist(layers.circuit, name="skin")
print(netlist)

# %% [markdown]
# SPICE has no constant phase. A chain of resistors and capacitors takes its place, within 0.01 % of
# its impedance from 1 Hz to 10 MHz:

# %%
chain = etid.netlist(spread.circuit, name="skin")
print(*chain.splitlines()[:12], "…", sep="\n")

# %% [markdown]
# `etid.circuit_string` is the notation of impedance.py, for
# `CustomCircuit(string, initial_guess=values)`.

# %%
string, values = etid.circuit_string(spread.circuit)
print(string, values)

# %% [markdown]
# ## What must hold
# These lines make the notebook a test.

# %%
for name, fit in {"two layers": layers, "Cole": spread}.items():
    true, stderr = np.asarray(truth[name].values()), np.asarray(fit.stderr.values())
    assert np.all(abs(np.asarray(fit.circuit.values()) - true) < 5 * stderr), name  # 1 in 10⁶
    smallest = np.array(list(bounds[name].stderr.values()))
    assert np.all(stderr < 1.3 * smallest), name
assert {fit.verdict for fit in small.values()} <= {"misfit", "inconsistent"}
assert large.verdict == "insensitive"
assert abs(float(one.circuit.alpha) - 1) < 5 * float(one.stderr.alpha)
assert sum(line[0] in "RC" for line in netlist.splitlines()) == 5
assert string == "R0-p(R1,CPE1)"
assert values[-1] == float(spread.circuit.alpha)
