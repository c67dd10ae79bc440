"""One fit of a circuit: elements, standard errors, verdict, and what else the data support."""

import operator
import os
import statistics
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.circuit import Circuit
from etid.circuits.directions import ALIKE, DIRECTIONS, FAST, SPREAD, Direction, named
from etid.precision import Module, namespace
from etid.printing import Overview, element_rows, per_cent, quality, quantity, rounded, several
from etid.recordings.remarks import Remark, texts
from etid.results.columns import described, table_of
from etid.results.data import HasSource
from etid.results.instrument import Effects, largest
from etid.results.method_options import without_known
from etid.results.posterior import tails
from etid.results.presented import Presented
from etid.results.unlike_noise import why_not_noise
from etid.results.verdicts import RESULTS, Judged, counted, leaving, message
from etid.signals.transfer import AnyArray, power


def rrse(
    predicted: Float[AnyArray, "*row time"], measured: Float[AnyArray, "*row time"]
) -> Float[AnyArray, "*row"]:
    """Root relative squared error, sqrt(Σ (V − W)² / Σ (W − mean W)²)   (paper, eq. 3).

    The RRSE does not show errors of the circuit: 2.73 % is as common with a correct C_p as with a
    C_p that is wrong by 85 %. Judge a fit by χ² and the standard errors.
    """
    off = measured - measured.mean(-1, keepdims=True)
    missed = ((predicted - measured) ** 2).sum(-1)
    return namespace(missed).sqrt(missed / (off**2).sum(-1))


def complex_rrse(
    predicted: Complex[AnyArray, "*row value"],
    measured: Complex[AnyArray, "*row value"],
    used: Bool[AnyArray, "*row value"] | bool = True,
) -> Float[AnyArray, "*row"]:
    """RRSE of the harmonics or impedances that are used; their mean is not subtracted."""
    xp = namespace(predicted, measured)
    missed = xp.where(used, power(measured - predicted), 0.0).sum(-1)
    return xp.sqrt(missed / xp.where(used, power(measured), 0.0).sum(-1))


class IdentificationError(RuntimeError):
    """The result of an identification cannot be used.

    Attributes:
        outcome: The unusable fit or driver; None if there is none.
    """

    def __init__(self, text: str, outcome: Any) -> None:
        super().__init__(text)
        self.outcome = outcome

    def __reduce__(self) -> tuple:
        # By default a copy would be made of the text alone, and a pool of processes would break.
        return type(self), (str(self), self.outcome)


class Support(Module):
    """How well the data of a fit support its circuit.

    Attributes:
        deviance: −2 log L at the minimum, up to a constant that depends on the data only.
        terms: Number of real numbers in the data.
        z: Score of each change of `named` [standard deviations]. 0 if the change is too small to
            matter, or if the circuit can make it itself.
        spread_stderr: Standard error of the size of the spread; 0 if the circuit
            can make it itself.
        spread_slope: Change of the logarithm of each element for each unit of this size.
        layer_shows: How much the data would show that the load is a layer through which charge
            diffuses, in place of the circuit [standard deviations]; infinite if an element would be
            negative, 0 if the circuit can be this layer, NaN if this is not tested.
    """

    deviance: Float[Array | np.ndarray, "*lane"]
    terms: Float[Array | np.ndarray, "*lane"]
    z: Float[Array | np.ndarray, "*lane change"]
    spread_stderr: Float[Array | np.ndarray, "*lane"]
    spread_slope: Float[Array | np.ndarray, "*lane element"]
    layer_shows: Float[Array | np.ndarray, "*lane"]

    @staticmethod
    def changes() -> int:
        """Number of scores."""
        return sum(DIRECTIONS[name].count for name in named())

    @classmethod
    def unknown(cls, elements: int, *lane: int) -> "Support":
        """The support of a fit whose estimator does not compute it, or of a batch of them: NaN."""
        sizes = (), (), (cls.changes(),), (), (elements,), ()
        return cls(*(np.full((*lane, *size), np.nan) for size in sizes))

    def of(self, name: str) -> Float[AnyArray, "*lane change"]:
        """The scores of one of `named`."""
        first = sum(DIRECTIONS[other].count for other in named()[: named().index(name)])
        return self.z[..., first : first + DIRECTIONS[name].count]

    def _likeliest(self) -> tuple[float, list[tuple[Direction, str]]]:
        """The largest score that a passive load can have, and what the residual looks like then.

        A negative relaxation, or a spread above that of a capacitor, is not passive. A gain has no
        sign that it must have. For one fit.
        """
        found = []
        for name in named():
            row, z = DIRECTIONS[name], np.nan_to_num(np.asarray(self.of(name), float))
            # The scores have the sign of −ε.
            looks = (row.looks_back,) if row.looks_back and z[0] < 0 else row.looks
            z = np.maximum(-row.passive * z, 0.0) if row.passive else np.abs(z)
            found += [(size, row, like) for size, like in zip(z.tolist(), looks, strict=True)]
        circuits = [each for each in found if each[1].of_circuit]
        other, spread = max(circuits, key=operator.itemgetter(0)), circuits[0]
        faults = [each for each in found if not each[1].of_circuit]
        if other[0] > other[1].limit:
            # It changes the load much as a capacitance or an inductance does. Only a fast
            # relaxation beyond the band does it alike.
            faults = [
                each
                for each in faults
                if not each[1].on_load or ALIKE < each[0] / other[0] < 1 / ALIKE
            ]
        worst = max(other, *faults, key=operator.itemgetter(0))
        if worst[1].on_load and spread[0] > max(SPREAD * other[0], spread[1].limit):
            return spread[0], [spread[1:]]
        if worst is other and other[2] != FAST:
            return other[0], [other[1:]]
        return worst[0], [each[1:] for each in (other, *faults) if each[0] > ALIKE * worst[0]]

    def looks_like(self) -> str:
        """A sentence on the largest score; empty if the residual looks like no change.

        For one fit.
        """
        z, causes = self._likeliest()
        if z < 3.0:
            return ""
        *first, last = [looks for _, looks in causes]
        what = f"{', '.join(first)} or {last}" if first else last
        return f"The residual looks like {what} ({z:.0f} standard deviations)."

    def is_of_circuit(self) -> bool:
        """Whether the largest score is surely that of another circuit; for one fit.

        A driver that changed looks like one more fast relaxation, and less spread than a capacitor
        has: so do all of 16 drivers with 30 % more leakage inductance at 40 dB.
        """
        z, [(row, looks), *more] = self._likeliest()
        return z >= 5.0 and row.of_circuit and looks != FAST and not more


class Limited(Module):
    """Bounds of the elements of a fit, or of a batch of fits.

    Attributes:
        lower: Lower bounds [SI]; 0 without one.
        upper: Upper bounds [SI]; infinite without one.
        outside: Distance from its bounds of each element as it would be without them [standard
            errors]: negative below the lower one, positive above the upper one, 0 inside.
    """

    lower: Float[Array | np.ndarray, "*lane parameter"]
    upper: Float[Array | np.ndarray, "*lane parameter"]
    outside: Float[Array | np.ndarray, "*lane parameter"]

    def text(self, units: Mapping[str, str]) -> str:
        """A sentence that names the elements outside and their bounds; empty if there are none.

        Args:
            units: SI units of the elements by name.
        """
        found = []
        for row, (name, unit) in enumerate(units.items()):
            by = float(self.outside[row])
            if not abs(by) > 0:  # NaN where a fit failed
                continue
            bound, where = (self.lower, "below") if by < 0 else (self.upper, "above")
            end = quantity(float(bound[row]), unit)
            found.append(f"{name} would be {abs(by):.1f} standard errors {where} {end}")
        return f"Without bounds, {' and '.join(found)}." if found else ""


class Fit(Judged, Presented, HasSource[Circuit]):
    """One identified circuit, or a batch of them along a leading axis.

    Attributes:
        circuit: Identified elements in SI units.
        cov: Covariance of the elements in SI units; NaN if the method gives none. It contains the
            tolerance of the known resistor, which passes 1:1 into every resistance, only if an
            `Instrument` states it.
        shared_cov: The part of `cov` that comes from the driver. All fits with this driver share
            it, so the spread between trials does not show it.
        rrse: Root relative squared error of V_out (paper, eq. 3).
        chi2: Σ residual² / expected variance, per degree of freedom; 1 if the model is right.
        result: Verdict.
        steps: Iterations of the solver.
        method: Name of the estimator with the options that are not the default. A batch has all
            names, joined by " + ".
        remarks: Remarks on the recording, `etid.recordings.remarks.Remark` as integers.
        change: Relative change of each element and, last, of the amplitude during the record: from
            the first to the last period, or the size of the detected step. NaN if the record holds
            less than two periods; None if no change was computed.
        change_stderr: Standard errors of `change`.
        support: How well the data support this circuit, for the choice between circuits; NaN or
            None if the method computes no likelihood.
        limits: Bounds of the elements; None without bounds.
        by_tolerance: What errors of the instrument do to the elements; NaN if the method does not
            compute it, None in files.
    """

    circuit: Circuit
    cov: Float[Array | np.ndarray, "*lane parameter parameter"]
    shared_cov: Float[Array | np.ndarray, "*lane parameter parameter"]
    rrse: Float[Array | np.ndarray, "*lane"]
    chi2: Float[Array | np.ndarray, "*lane"]
    result: RESULTS
    steps: Int[Array | np.ndarray, "*lane"]
    method: str = eqx.field(static=True)
    remarks: Int[Array | np.ndarray, "*lane"] = eqx.field(default_factory=lambda: np.zeros((), int))
    change: Float[Array | np.ndarray, "*lane moved"] | None = None
    change_stderr: Float[Array | np.ndarray, "*lane moved"] | None = None
    support: Support | None = None
    limits: Limited | None = None
    by_tolerance: Effects | None = None

    @property
    def inexact(self) -> Any:
        """Whether the circuit leaves more than noise; an array for a batch.

        The standard errors then contain it. Of fits in a file, only the verdict tells it.
        """
        of, found = self.by_tolerance, np.asarray(self.verdict == "approximate")
        if of is not None:
            found = found | (np.nan_to_num(np.asarray(of.discrepancy)) > 0).any(-1)
        return found if found.ndim else bool(found)

    @property
    def leaves(self) -> str:
        """A sentence on what the circuit leaves, if ± contain it; otherwise empty. For one fit."""
        if not (self.usable and self.inexact):
            return ""
        return leaving("The circuit", self.chi2, self.rrse)

    @property
    def stderr(self) -> Circuit:
        """Standard errors of the elements, as a circuit of the same kind."""
        # With `jnp`, six programs would compile.
        xp: Any = jnp if isinstance(self.cov, jax.core.Tracer) else np
        cov = xp.asarray(self.cov)
        variance = xp.diagonal(cov, axis1=-2, axis2=-1)
        values = xp.sqrt(xp.where(variance >= 0, variance, xp.nan))
        errors = type(self.circuit).of_fit(xp.moveaxis(values, -1, 0))
        return errors.titled(f"Standard errors of {type(errors).__name__}")

    @property
    @np.errstate(all="ignore")  # a fit that failed may hold any number
    def correlation(self) -> Float[np.ndarray, "*lane parameter parameter"]:
        """Correlation coefficients of the errors of the elements; NaN without a covariance."""
        errors = np.asarray(self.stderr.values())
        return np.asarray(self.cov) / (errors[..., :, None] * errors[..., None, :])

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals of the elements: value ± z · standard error; for one fit.

        They come from the normal distribution, to which maximum likelihood leads if the standard
        errors are small. A bound ends an interval. The distribution inside the bounds is not
        normal; its part in an interval of 95 % is 94.8 % or more (a bound far beyond which the
        estimate would lie), and all of it between close bounds.

        Args:
            level: Probability that an interval contains the true value.

        Returns:
            Both ends [SI] by name; NaN without a covariance.

        Raises:
            ValueError: The level is not between 0 and 1, or this is a batch.
        """
        self.refuse_batch()
        z = statistics.NormalDist().inv_cdf(tails(level)[1])
        values, errors = np.asarray(self.circuit.values()), np.asarray(self.stderr.values())
        low, high = values - z * errors, values + z * errors
        if self.limits is not None:
            low, high = (np.clip(end, self.limits.lower, self.limits.upper) for end in (low, high))
        ends = zip(low.tolist(), high.tolist(), strict=True)
        return dict(zip(self.circuit.names(), ends, strict=True))

    def table(self) -> dict[str, Any]:
        """Elements [SI], standard errors, changes, quality and verdict, by name.

        Returns:
            Numbers and texts; arrays for a batch.
        """
        columns = table_of(self, {})
        return {name: one if one.ndim else one.item() for name, one in columns.items()}

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the fit and the labels of its recording to an HDF5 file; `Fits.read` reads it.

        Raises:
            ValueError: This is a batch.
        """
        from etid.results.fits import Fits  # a table of this class

        self.refuse_batch()
        batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], self)
        Fits(batch, described([self.described]), np.array([self.note])).write(path)

    def refuse_batch(self) -> None:
        """Raise ValueError if this is a batch."""
        if np.ndim(self.rrse):
            raise ValueError("this is a batch of fits; take one of them, as in fits[0]")

    @property
    def outside(self) -> Any:
        """A sentence on elements that would lie outside their bounds; an array for a batch."""
        units, shape = self.circuit.units(), np.shape(self.rrse)
        each = [jax.tree.map(operator.itemgetter(row), self.limits) for row in np.ndindex(shape)]
        found = np.array([one.text(units) if one else "" for one in each], str).reshape(shape)
        return found if found.ndim else str(found)

    @property
    def all_limits(self) -> Limited:
        """`limits`; without bounds those that every value meets."""
        none = np.zeros(np.shape(self.circuit.values()))
        return self.limits or Limited(none, none + np.inf, none)

    @property
    def known_changes(self) -> tuple[np.ndarray, np.ndarray]:
        """`change` and `change_stderr` as arrays; NaN if none were computed."""
        nothing = np.full((*np.shape(self.rrse), len(self.circuit.names()) + 1), np.nan)
        if self.change is None or self.change_stderr is None:
            return nothing, nothing
        return np.asarray(self.change), np.asarray(self.change_stderr)

    @property
    def elements(self) -> tuple[str, ...]:
        """Each element as text, with standard error and unit; for one fit."""
        return tuple(" ".join(" ".join(row).split()) for row in self._rows())

    @property
    def changes(self) -> str:
        """A sentence on the changes of elements and amplitude that are determined; for one fit."""
        if self.change is None or self.change_stderr is None:
            return ""
        names = *self.circuit.names(), "amplitude"
        known = [
            f"{name} {'+' if size >= 0 else ''}{rounded(100 * float(size))} ± "
            f"{per_cent(float(error), 1)}"
            for name, size, error in zip(names, self.change, self.change_stderr, strict=True)
            if error < 1  # else the record does not determine it
        ]
        return f"During the record: {', '.join(known)}." if known else ""

    @property
    def undetermined(self) -> str:
        """A sentence that names the elements whose standard error is not below their value."""
        sure = np.asarray(self.stderr.values()) < np.asarray(self.circuit.values())
        names = [name for name, one in zip(self.circuit.names(), sure, strict=True) if not one]
        return f"Not determined: {' and '.join(names)}." if names else ""

    @property
    def missed(self) -> str:
        """A sentence on the test that a `misfit` has failed, with its size; for one fit.

        Empty without a test and without χ², as of a spectrum without standard errors.
        """
        falls = int(self.remarks) & Remark.falls_with_current
        if falls:
            return texts(falls)[0]
        looks = "" if self.support is None else self.support.looks_like()
        chi2 = float(self.chi2)
        return looks or (
            "" if np.isnan(chi2) else f"chi2 is {rounded(chi2, 3)}; noise alone gives 1."
        )

    @property
    def remarked(self) -> list[str]:
        """The sentences of the remarks, and where an impedance is missed; for one fit."""
        remarks = int(self.remarks)
        if not remarks & Remark.not_noise or self.measured is None:
            return texts(remarks)
        frequency, z = self.measured.frequency, self.measured.z
        where = why_not_noise(frequency, self.circuit.response(frequency) / z - 1)
        return [*texts(remarks), where]

    @property
    def other_circuit(self) -> str:
        """A sentence if another circuit is a likelier cause of `inconsistent` than the driver."""
        support = self.support
        if self.verdict != "inconsistent" or support is None or not support.is_of_circuit():
            return ""
        likelier = "Another circuit is the likelier cause: let etid choose it (auto)."
        return f"{support.looks_like()} {likelier}"

    @property
    def note(self) -> str:
        """The message of the verdict, with the numbers that explain it; for one fit."""
        return " ".join(self._reasons)

    @property
    def unstated(self) -> str:
        """A sentence on the error of the instrument that exceeds ± most; for one fit.

        Empty if each has a tolerance, moves no element further than ±, or is not known.
        """
        if self.by_tolerance is None or not self.usable:
            return ""
        values, errors = np.asarray(self.circuit.values()), np.asarray(self.stderr.values())
        return largest(self.by_tolerance.unstated, self.circuit.names(), errors / values)

    @property
    def _told(self) -> tuple[str, str]:
        """The method without what was told of elements, and a sentence that says it."""
        return without_known(self.method, self.circuit.units())

    @property
    def _reasons(self) -> list[str]:
        said = {"changed": "changes", "misfit": "missed", "out_of_bounds": "outside"}
        said |= dict.fromkeys(("insensitive", "resolution"), "undetermined")
        own = getattr(self, said.get(self.verdict, ""), "")
        doubtful = self.verdict in ("misfit", "inconsistent", "max_steps_reached")
        doubt = "Is what was told right, and in SI units?" if doubtful and self._told[1] else ""
        driver = "" if self.driver is None or self.usable else self.driver.why
        text = message(self.verdict, self.of_impedance)
        return [*filter(None, (self.other_circuit, text, own, self.leaves, doubt, driver))]

    def _rows(self) -> list[tuple[str, str, str]]:
        values, errors = np.asarray(self.circuit.values()), np.asarray(self.stderr.values())
        return element_rows(self.circuit.units(), values, errors)

    def _overview(self) -> Overview:
        kind, verdict = type(self.circuit).__name__, self.verdict
        rows = self._rows()
        if np.ndim(self.rrse):
            batch = f"{kind} fits, batch of {np.shape(self.rrse)}: {counted(verdict)}"
            return Overview(batch, rows)
        method, told = self._told
        title = f"{kind}: {verdict} in {several(int(self.steps), 'step')} ({method})"
        known = self.measured is None or self.measured.stderr is not None  # else there is no chi2
        title += f", {quality(float(self.rrse), float(self.chi2) if known else np.nan)}"
        outside = "" if verdict == "out_of_bounds" else self.outside
        said = [told, *self._reasons, outside, self.unstated, *self.remarked]
        notes = list(dict.fromkeys(filter(None, said)))  # a remark may be the reason
        return Overview(title, rows, notes=notes)
