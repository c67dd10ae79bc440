"""A table of many fits, its labels, its file, and medians, spreads and errors of its groups."""

import dataclasses
import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Generic

import jax
import numpy as np

import etid
from etid.circuits.circuit import AbstractCircuit, Circuit
from etid.circuits.lookup import class_path
from etid.printing import Overview, Overviewed, heading, per_cent, plus_minus, scaled, several
from etid.recordings.errors import install
from etid.recordings.labels import Label, check_names, natural, wanted_labels
from etid.results.columns import DESCRIBED, LABELS, long_form, named, table_of
from etid.results.data import with_data
from etid.results.fit import Fit
from etid.results.fits_file import SCHEMA, VERSION, fits_of
from etid.results.hdf5_table import Table, opened_table, write_table
from etid.results.verdicts import counted, counts, left, message, own_part

FEW = 20  # unusable fits that are explained
AND = " + "  # between the names of estimators


def joined(methods: Iterable[str]) -> str:
    """One name for fits by several estimators; it holds each estimator once."""
    return AND.join(sorted({name for method in methods for name in method.split(AND)}))


def concatenated(fits: Sequence[Fit]) -> Fit:
    """Fits of several parts; those that were refused have no χ², and their method was not used.

    What some of them do not have, as those of a file, is NaN there.

    Raises:
        ValueError: Their circuits are not of one kind.
    """
    kinds = {type(one.circuit): class_path(type(one.circuit)) for one in fits}
    if len(kinds) > 1:
        raise ValueError(
            f"fits of {' and '.join(sorted(kinds.values()))} cannot be in one table: make a table "
            "for each circuit, or identify all recordings with one circuit"
        )
    used = [one.method for one in fits if np.isfinite(one.chi2).any()]
    method = joined(used or [one.method for one in fits])
    parts = [dataclasses.replace(one, method=method) for one in fits]
    for field in dataclasses.fields(parts[0]):
        known = [of for one in parts if (of := getattr(one, field.name)) is not None]
        if 0 < len(known) < len(parts):
            parts = [_with(one, field.name, known[0]) for one in parts]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _with(fit: Fit, name: str, like: Any) -> Fit:
    """Fits with a field; NaN, or limits that every value meets, if they do not have it.

    Args:
        fit: Fits along one axis.
        name: Name of the field.
        like: The field of other fits.
    """
    if getattr(fit, name) is not None:
        return fit
    nothing = jax.tree.map(lambda leaf: np.full((len(fit.rrse), *leaf.shape[1:]), np.nan), like)
    return dataclasses.replace(fit, **{name: fit.all_limits if name == "limits" else nothing})


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fits(Overviewed, Generic[Circuit]):
    """Identified circuits of many recordings, in the order of the recordings.

    Attributes:
        fit: The fits, batched along one leading axis, as numpy arrays.
        labels: `path`, `subject`, `session`, `site`, `condition`, `electrode` and `trial` of each
            recording, empty where not given, and numbers that describe the recording.
        notes: A sentence for each fit that is not successful, or whose ± contain what its circuit
            leaves; empty for the others.
        measured: The impedance of each fit of `identify_impedances`; None for others, and in files.
    """

    fit: Fit[Circuit]
    labels: Mapping[str, np.ndarray]
    notes: np.ndarray
    measured: np.ndarray | None = None

    def __post_init__(self) -> None:
        nothing = {name: np.full(len(self.notes), "", object) for name in LABELS}
        object.__setattr__(self, "labels", nothing | dict(self.labels))

    @property
    def circuit(self) -> Circuit:
        """Identified elements, arrays (fit,)."""
        return self.fit.circuit

    @property
    def stderr(self) -> Circuit:
        """Standard errors, arrays (fit,)."""
        return self.fit.stderr

    cov = property(lambda self: self.fit.cov, doc="Covariances, (fit, parameter, parameter).")
    rrse = property(lambda self: self.fit.rrse, doc="Root relative squared errors (fit,).")
    chi2 = property(lambda self: self.fit.chi2, doc="χ² per degree of freedom (fit,).")
    verdicts = property(lambda self: self.fit.verdict, doc="Names of the verdicts (fit,).")

    def __len__(self) -> int:
        return len(self.notes)

    def __getitem__(self, index: int | str) -> Fit[Circuit]:
        """The fit of a row, or of the recording at a path.

        Raises:
            KeyError: No fit has this path, or several have it.
        """
        row = self._row(index) if isinstance(index, str) else index
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[row], self.fit)
        if np.ndim(found.rrse):
            return found
        labels = {name: np.asarray(of)[row] for name, of in self.labels.items()}
        if self.measured is not None:
            labels["measured"] = self.measured[row]
        return with_data(found, labels)

    def _row(self, path: str) -> int:
        """The row of a path."""
        paths = [str(one) for one in self.labels["path"]]
        rows = [row for row, one in enumerate(paths) if one.strip("/") == path.strip("/")]
        if len(rows) == 1:
            return rows[0]
        if rows:
            raise KeyError(f"{len(rows)} fits have the path {path!r}; take one by its row, {rows}")
        near = difflib.get_close_matches(path, paths, n=3) or paths[:3]
        raise KeyError(
            f"no fit {path!r}; this table has {several(len(self), 'fit')}, such as "
            f"{', '.join(map(repr, near))}"
        )

    def take(self, index: np.ndarray) -> "Fits[Circuit]":
        """The fits selected by an array.

        Args:
            index: Indices of the fits, or a mask with one entry for each fit.

        Returns:
            The selected fits, in the order of `index`.
        """
        return type(self)(
            jax.tree.map(lambda leaf: np.asarray(leaf)[index], self.fit),
            {name: column[index] for name, column in self.labels.items()},
            self.notes[index],
            None if self.measured is None else self.measured[index],
        )

    @classmethod
    def concatenate(cls, parts: Sequence["Fits"]) -> "Fits":
        """One table made of several.

        Args:
            parts: Tables of fits of circuits of one kind.

        Returns:
            All fits, in this order.
        """
        measured = [part.measured for part in parts if part.measured is not None]
        return cls(
            concatenated([part.fit for part in parts]),
            {name: np.concatenate([part.labels[name] for part in parts]) for name in DESCRIBED},
            np.concatenate([part.notes for part in parts]),
            np.concatenate(measured) if len(measured) == len(parts) else None,
        )

    def where(self, **labels: Label | None) -> "Fits[Circuit]":
        """The fits whose labels equal the given ones, as in `where(condition="dry")`.

        Args:
            **labels: `path`, `subject`, `condition`, `electrode` or `trial`.

        Returns:
            The selected fits, in their order.

        Raises:
            RecordingError: A label does not exist, or its value is neither text nor an integer.
        """
        chosen = np.ones(len(self), bool)
        for name, value in wanted_labels(labels, LABELS).items():
            chosen &= self.labels[name] == value
        return self.take(chosen)

    def usable(self) -> "Fits[Circuit]":
        """The fits that can be used: their verdict is `successful` or `approximate`."""
        return self.take(self.fit.usable)

    def counts(self) -> dict[str, int]:
        """How often each verdict occurs, most frequent first."""
        return counts(self.verdicts)

    def table(self, *, long: bool = False) -> dict[str, np.ndarray]:
        """One column per label, element [SI], standard error, quality and verdict.

        Args:
            long: One row per element in place of one per fit, as mixed models and plots of groups
                take it: the columns `element`, `unit`, `value`, `stderr` and `change` in place of
                those of the elements.
        """
        whole = table_of(self.fit, {**self.labels, "note": self.notes})
        return long_form(whole, self.circuit.units()) if long else whole

    def to_pandas(self, *, long: bool = False) -> Any:
        """The table as a pandas DataFrame.

        Args:
            long: As in `table`.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError(f"to_pandas needs pandas: {install('table')}") from error
        return pandas.DataFrame(self.table(long=long))

    def summary(self, *by: str) -> list[dict[str, Any]]:
        """Counts, and medians of the usable fits, for each group of labels.

        Each element has these keys:

        - `NAME`: the median.
        - `NAME_spread`: the standard deviation between the recordings.
        - `NAME_stderr`: the median standard error.
        - `NAME_own`: the part of the standard error from the noise of the recording. The spread
          contains it.
        - `NAME_shared`: the part that all recordings with one driver share. The spread does not
          contain it.
        - `NAME_between`: the variation between the recordings without noise,
          sqrt(spread² − mean own²), or 0. Noise adds the mean of own² to spread². If some
          recordings are noisier than others, this mean differs from the square of the median.

        Args:
            *by: Labels that define the groups. Without a label, all fits are one group.

        Returns:
            A row for each group, sorted by the labels, 2 before 10. Numbers are in SI units; they
            are NaN if the group has no usable fit.

        Raises:
            RecordingError: A label does not exist.
        """
        return _summary(self, by)

    def pooled(self, *by: str) -> list[str]:
        """Labels that differ between the fits of a group by other labels, such as `session`.

        Args:
            *by: Labels that define the groups.
        """
        groups = list(zip(*(self.labels[name].tolist() for name in by), strict=True))
        several = len(set(groups))
        return [
            name
            for name in LABELS
            if name not in ("path", "trial", *by)
            and len(set(zip(groups, self.labels[name].tolist(), strict=True))) > several
        ]

    def _unusable(self) -> list[str]:
        """Paths, verdict and note of the first `FEW` unusable fits; a message is said once."""
        verdicts, of_spectra = self.verdicts.tolist(), self.fit.of_impedance
        failed = np.flatnonzero(~self.fit.usable).tolist()
        alike: dict[tuple[str, str], list[str]] = {}
        for row in failed[:FEW]:
            verdict, path = verdicts[row], str(self.labels["path"][row])
            note = " ".join(str(self.notes[row]).split()).removeprefix(f"{path!r}: ")
            why = verdict, note or message(verdict, of_spectra)
            alike.setdefault(why, []).append(path or f"fit {row}")
        lines, told = [], set()
        for (verdict, note), paths in alike.items():
            text = own_part(verdict, note, of_spectra) if verdict in told else note
            lines.append(f"{', '.join(paths)}: {verdict}. {text}".rstrip())
            told.add(verdict)
        more = len(failed) - FEW
        return [*lines, *[f"… and {more} more unusable; their notes say why"] * (more > 0)]

    @np.errstate(over="ignore", invalid="ignore")  # of a damaged file
    def _overview(self) -> Overview:
        units, groups = self.circuit.units(), self.summary("subject", "condition")
        rows, usable = [], self.usable()
        middle = {
            name: np.median(getattr(usable.circuit, name)) if len(usable) else np.nan
            for name in units
        }  # each column has one unit
        for group in groups:
            where = " ".join(filter(None, (group["subject"], group["condition"])))
            elements = []
            for name, unit in units.items():
                scale = scaled(unit, middle[name])[0]
                elements.append(plus_minus(group[name] / scale, group[f"{name}_stderr"] / scale))
            where = where or ("all" if len(groups) == 1 else "-")
            rows.append((where, f"{group['usable']}/{group['fits']}", *elements))
        title = f"{several(len(self), 'fit')} of {type(self.circuit).__name__}"
        medians = "Median of the usable fits ± median standard error of one fit."
        names = [f"{name}s" for name in self.pooled("subject", "condition")]
        pooled = [f"Each row pools {' and '.join(names)}."] if names else []
        return Overview(
            f"{title}: {counted(self.verdicts)}" if len(self) else title,
            rows,
            ("", "usable", *(heading(name, of, middle[name]) for name, of in units.items())),
            [*([medians, *pooled, *self._inexact()] if len(usable) else []), *self._unusable()],
        )

    def _inexact(self) -> list[str]:
        """A sentence on what circuits leave, if ± of some fits contain it."""
        some = self.take(self.fit.usable & self.fit.inexact)
        if not len(some):
            return []
        most = per_cent(float(left(np.asarray(some.chi2), np.asarray(some.rrse)).max()))
        of = several(len(some), "fit")
        return [f"The circuit leaves up to {most} of the signal in {of}; ± contain it."]

    def as_table(self) -> tuple[dict[str, np.ndarray], dict[str, str], dict[str, Any]]:
        """Columns of the file that `write` makes, their units, and its attributes."""
        columns = table_of(self.fit, {**self.labels, "note": self.notes}, file=True)
        known = named(self.circuit.units())
        units = {name: unit for name, (*_, unit) in known.items() if unit}
        attributes = {
            "schema": SCHEMA,
            "schema_version": VERSION,
            "etid_version": etid.__version__,
            "circuit": class_path(type(self.circuit)),
            "parameters": list(self.circuit.names()),
            "method": self.fit.method,
        }
        return columns, units, attributes

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the table, the covariances, the method and the version of etid to an HDF5 file."""
        columns, units, attributes = self.as_table()
        write_table(path, columns, units=units, attributes=attributes)

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], circuit: type[AbstractCircuit] | None = None
    ) -> "Fits":
        """Read a file written by `write`.

        Args:
            path: The file.
            circuit: The class of the circuit. It can be left out if its module is imported.

        Raises:
            RecordingError: The file is not a file of fits, or its circuit is not `circuit`, or
                its circuit is neither given nor imported. Reading a file never imports a module.
        """
        with opened_table(path, SCHEMA, VERSION) as table:
            return cls.of_table(table, circuit)

    @classmethod
    def of_table(cls, table: Table, circuit: type[AbstractCircuit] | None) -> "Fits":
        """The fits of an open file; `read` calls this.

        Raises:
            RecordingError: A column or an attribute is missing or invalid.
        """
        fit, beside = fits_of(table, circuit)
        return Fits(fit, beside, beside.pop("note"))


@np.errstate(over="ignore", invalid="ignore")  # of a damaged file
def _summary(fits: Fits, by: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of `Fits.summary`."""
    check_names(dict.fromkeys(by), LABELS, "label")
    columns = [map(str, fits.labels[name].tolist()) for name in by]
    keys = list(zip(*columns, strict=True)) if by else [()] * len(fits)
    groups = sorted(set(keys), key=lambda key: [natural(label) for label in key])
    number = {key: i for i, key in enumerate(groups)}
    place = np.array([number[key] for key in keys], int)
    good = fits.usable()
    place_good = place[fits.fit.usable]
    order = np.argsort(place_good, kind="stable")
    ends = np.searchsorted(place_good[order], np.arange(len(groups) + 1))
    rows: list[dict[str, Any]] = [
        dict(zip(by, key, strict=True)) | {"fits": int(count), "usable": int(size)}
        for key, count, size in zip(
            groups, np.bincount(place, minlength=len(groups)), np.diff(ends), strict=True
        )
    ]
    for i, name in enumerate(fits.circuit.names()):
        total, common = good.cov[:, i, i], good.fit.shared_cov[:, i, i]
        parts = {
            "": np.asarray(getattr(good.circuit, name)),
            "_stderr": np.asarray(getattr(good.stderr, name)),
            "_own": np.sqrt(np.maximum(total - common, 0.0)),
            "_shared": np.sqrt(np.where(common >= 0, common, np.nan)),
        }
        for row, start, end in zip(rows, ends[:-1], ends[1:], strict=True):
            chosen = order[start:end]
            for part, values in parts.items():
                row[name + part] = float(np.median(values[chosen])) if end > start else np.nan
            more, values = chosen.size > 1, parts[""][chosen]
            row[f"{name}_spread"] = float(np.std(values, ddof=1)) if more else np.nan
            noise = float(np.mean(parts["_own"][chosen] ** 2)) if more else np.nan
            excess = np.square(row[f"{name}_spread"]) - noise
            row[f"{name}_between"] = float(np.sqrt(np.maximum(excess, 0.0)))
    return rows
