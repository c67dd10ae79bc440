# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
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
#
# It needs etid and Jupyter (`pip install . jupyterlab`), and takes ten seconds.

# %%
# %matplotlib inline

import etid
from etid.circuits.elements import Exponent, Farad, Ohm, Second

SEED = 2


# %% [markdown]
# ## Two circuits
# A circuit is a class with named parameters and one method, which connects elements. Each parameter
# has a unit and a typical value, where fits start. The stratum corneum and the living skin below it
# are two relaxations in series:


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
# Cole (1940) found that the relaxation of membranes is distributed over time constants:
# R / (1 + (jωτ)^α) with α below 1. No filter with a finite number of coefficients has this
# impedance. etid evaluates it exactly at the harmonics of the pulses.


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
axes = etid.plot(truth)

# %% [markdown]
# ## Recordings
# Any circuit can be a load of a scene. For your own recordings, replace this cell by
# `study = etid.read("study.h5")`.

# %%
trials = tuple(etid.scenes.Trial(name, circuit) for name, circuit in truth.items())
calibration = etid.scenes.paper_calibration().calibration
scene = etid.scenes.Scene(trials, calibration, snr_db=60.0, trigger_jitter_rms=50e-9)
study = scene.simulate(SEED)
driver = etid.identify_driver(study["calibration/98k8"])
study

# %% [markdown]
# ## Elements with standard errors
# The ten lines of a circuit are enough: the fit, its gradients, the covariance and the units follow
# from them. The fit starts at the typical values.

# %%
layers = etid.identify_skin(study["two layers"], driver, circuit=SkinTwoLayer())
print(layers)

# %%
spread = etid.identify_skin(study["Cole"], driver, circuit=SkinCole())
print(spread)

# %% [markdown]
# The residual rings at the edges, with a frequency near half the sample rate. There the recording
# contains aliases. The fit does not use these frequencies.

# %%
axes = etid.plot(spread, study["Cole"], driver)

# %% [markdown]
# ## Comparison with the bound
# The Cramer-Rao bound of the scene is the smallest standard error of any unbiased estimator without
# a model of the driver. A fit has a model of the driver. It comes close to the bound or is slightly
# better.

# %%
bounds = etid.bound(scene)
for name, fit in {"two layers": layers, "Cole": spread}.items():
    print(name)
    for element, smallest in bounds[name].stderr.items():
        print(f"  {element:<6} {float(getattr(fit.stderr, element)) / smallest:.2f} of the bound")

# %% [markdown]
# ## Is it the right circuit?
# **Too small.** One RC gives an error of R_s of 10 % for the skin of two layers, and of 45 % for
# Cole's. The verdict rejects the circuit: `misfit`, or `inconsistent` if the fit had to change the
# impedance of the driver to explain the recording.

# %%
small = {
    name: etid.identify_skin(study[name], driver, throw=False) for name in ("two layers", "Cole")
}
for name, fit in small.items():
    print(f"{name:<12} {fit.verdict:<13} χ² {float(fit.chi2):.3g}")
    print(f"{'':<12} R_s {float(fit.circuit.r_s) / 1e3:.1f} kΩ, in truth 33.4 kΩ\n")

# %% [markdown]
# **Too large.** With a circuit of two layers for skin that is one RC, the recording does not
# separate the layers. Their standard errors exceed their values, and the verdict is `insensitive`.
# Cole's circuit is not too large, because α = 1 is one RC. The fit finds α = 1 within its error.

# %%
large = etid.identify_skin(study["one RC"], driver, circuit=SkinTwoLayer(), throw=False)
print(large)

# %%
one = etid.identify_skin(study["one RC"], driver, circuit=SkinCole())
print(one)

# %% [markdown]
# ## To other programs
# `etid.netlist` writes a subcircuit for every SPICE simulator. Use it as `X1 out 0 skin`.

# %%
netlist = etid.netlist(layers.circuit, name="skin")
print(netlist)

# %% [markdown]
# SPICE has no constant-phase element. A chain of resistors and capacitors replaces it, with an
# error below 0.01 % of its impedance from 1 Hz to 10 MHz:

# %%
chain = etid.netlist(spread.circuit, name="skin")
print(*chain.splitlines()[:12], "…", sep="\n")

# %% [markdown]
# `etid.circuit_string` gives the circuit in the notation of impedance.py, for
# `CustomCircuit(string, initial_guess=values)`.

# %%
string, values = etid.circuit_string(spread.circuit)
print(string, values)

# %% [markdown]
# ## Conclusion
# A circuit of ten lines has everything that a circuit of etid has: a fit as precise as the bound, a
# verdict that refuses the wrong circuit, and a netlist.
