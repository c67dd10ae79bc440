"""Recordings that are not fitted: why, and a fit without numbers in their place."""

import jax
import jax.numpy as jnp
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits, limited, of_circuit
from etid.identify import changes
from etid.recordings.causes import why_implausible, why_misaligned
from etid.recordings.preflight import Inspected, preflight
from etid.results.fit import Fit, Support
from etid.results.verdicts import message, verdict

# Verdicts whose message says more of a recording.
EXPLAINED = ("rate_mismatch", "misaligned", "wrong_unit", "flat", "nonfinite_samples")


def explained(seen: Inspected, name: str) -> str:
    """The message of a verdict of `etid.recordings.preflight`, with the numbers found."""
    found = ""
    if seen.by_current is not None and name in EXPLAINED and preflight(seen) != name:
        seen = seen.by_current  # the fault is in the current
    if name == "rate_mismatch":
        found = seen.train.mismatch
    elif name == "misaligned":
        found = why_misaligned(seen)
    elif name == "wrong_unit":
        found = why_implausible(seen.by_current or seen)
    elif name in ("flat", "nonfinite_samples"):
        found = f"The fault is in {' and '.join(_faulty(seen, name))}."
    return f"{found} {message(name)}".strip()


def _faulty(seen: Inspected, name: str) -> list[str]:
    """Names of the records that are flat, or that hold numbers that are not finite."""
    records = seen.recording.cause, "v_out"
    if name == "flat":
        faults = seen.is_flat
    else:
        faults = [not np.isfinite(seen.recording.samples[one].values).all() for one in records]
    return [one for one, fault in zip(records, faults, strict=True) if fault]


def failed_fit(name: str, circuit: AbstractCircuit, method: str, bounds: Limits = ()) -> Fit:
    """A fit without numbers, for a recording that was not fitted."""
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    empty = circuit.with_log_values(jnp.full(size, jnp.nan))
    scalar = np.asarray(np.nan)
    none = changes.unknown(size)
    fit = Fit(
        circuit=empty,
        cov=nan,
        shared_cov=nan,
        rrse=scalar,
        chi2=scalar,
        result=verdict(name),
        steps=np.asarray(0),
        method=method,
        change=none.size,
        change_stderr=none.stderr,
        support=Support.unknown(size),
        limits=limited(circuit, of_circuit(bounds, circuit)),
    )
    return jax.tree.map(np.asarray, fit)
