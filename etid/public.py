"""What `etid` offers. `etid` imports this module when one of these names is first used."""

from etid.circuits.circuit import (
    AbstractCircuit,
    ParallelRC,
    Resistor,
    SkinCole,
    SkinLayers,
    SkinRC,
    SkinWarburg,
    parameter,
)
from etid.circuits.circuit_string import circuit
from etid.circuits.current_dependent import SkinCurrent, current_dependent_resistor
from etid.circuits.elements import capacitor, cole, constant_phase, inductor, resistor
from etid.circuits.impedance import parallel, series
from etid.circuits.netlist import circuit_string, netlist
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.non_parametric.estimator import NonParametric
from etid.estimators.output_error.estimator import OutputError
from etid.estimators.registry import register
from etid.estimators.steiglitz_mcbride.estimator import EquationError, SteiglitzMcBride
from etid.identify import posterior as _posterior
from etid.identify import profile as _profile
from etid.identify.amplitudes import identify_amplitudes
from etid.identify.driver import identify_driver
from etid.identify.file import fit_file
from etid.identify.impedance import identify_impedance
from etid.identify.jointly import identify_jointly
from etid.identify.kramers_kronig import KramersKronig, kramers_kronig
from etid.identify.many import identify_skins, identify_study
from etid.identify.one import identify_skin
from etid.identify.predict import predict
from etid.identify.samples import identify_samples
from etid.identify.selecting import select_circuit
from etid.online.controller import Controller
from etid.online.tracker import Tracker
from etid.plotting import plot
from etid.recordings.hdf5 import check, read
from etid.recordings.recording import Recording, RecordingError, Samples
from etid.recordings.study import Study
from etid.results.data import attach_methods as _attach_methods
from etid.results.driver import Driver
from etid.results.fit import Fit, IdentificationError
from etid.results.fits import Fits
from etid.results.posterior import Posterior, Profile
from etid.results.study_fits import StudyFits
from etid.results.verdicts import RESULTS
from etid.selection.selection import Candidate, Selection
from etid.simulation import scenes
from etid.simulation.bound import Bound, Bounds, bound

_attach_methods(plot=plot, posterior=_posterior.posterior, profile=_profile.profile)

__all__ = [
    "RESULTS",
    "AbstractCircuit",
    "AbstractEstimator",
    "Bound",
    "Bounds",
    "Candidate",
    "Controller",
    "Driver",
    "EquationError",
    "Fit",
    "Fits",
    "IdentificationError",
    "KramersKronig",
    "MaximumLikelihood",
    "NonParametric",
    "OutputError",
    "ParallelRC",
    "Posterior",
    "Profile",
    "Recording",
    "RecordingError",
    "Resistor",
    "Samples",
    "Selection",
    "SkinCole",
    "SkinCurrent",
    "SkinLayers",
    "SkinRC",
    "SkinWarburg",
    "SteiglitzMcBride",
    "Study",
    "StudyFits",
    "Tracker",
    "bound",
    "capacitor",
    "check",
    "circuit",
    "circuit_string",
    "cole",
    "constant_phase",
    "current_dependent_resistor",
    "fit_file",
    "identify_amplitudes",
    "identify_driver",
    "identify_impedance",
    "identify_jointly",
    "identify_samples",
    "identify_skin",
    "identify_skins",
    "identify_study",
    "inductor",
    "kramers_kronig",
    "netlist",
    "parallel",
    "parameter",
    "plot",
    "predict",
    "read",
    "register",
    "resistor",
    "scenes",
    "select_circuit",
    "series",
]
