"""Recordings of an HDF5 file, and the faults of the others, found in one walk through the file.

The walk reads attributes and the headers of datasets. Samples are read when a recording is loaded.
"""

import contextlib
import dataclasses
import functools
import os
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np
from h5py import h5o  # type: ignore[attr-defined]  # compiled, without stubs

from etid.printing import several
from etid.recordings import limits, schema
from etid.recordings.errors import near_miss
from etid.recordings.fields import SIGNALS, Field, Metadata, metadata_from, tidy_path
from etid.recordings.labels import natural
from etid.recordings.recording import (
    AbstractSource,
    Layout,
    Recording,
    RecordingError,
    Samples,
    check_rates,
    of_checked,
)
from etid.recordings.untrusted import (
    attribute,
    check_size,
    local_link,
    translated,
)

OPEN = 8  # most datasets of stacks that stay open


class SamplesFile:
    """An HDF5 file whose samples are read; a pickle opens it again when it is used."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._file: h5py.File | None = None

    def open(self) -> h5py.File:
        """The file, open until `close`, and false then."""
        if self._file is None:
            self._file = h5py.File(self.name, "r")
        return self._file

    @functools.cached_property
    def stack(self) -> Callable[[str], Any]:
        """A dataset of a stack by its path.

        To open a stack takes as long as to read a row, but an open stack keeps megabytes of chunks
        in memory.
        """
        return functools.lru_cache(OPEN)(self.open().__getitem__)

    def close(self) -> None:
        """Close the file, if it is open."""
        if self._file is not None:
            self._file.close()

    def __reduce__(self) -> tuple:
        return SamplesFile, (os.path.abspath(self.name),)


@dataclasses.dataclass(eq=False)
class _Block:
    """A recording group of the file: one recording, or a stack of trials.

    `stacked` are the names of the records with one row for each trial.
    """

    samples_of: SamplesFile
    metadata: Metadata
    trials: tuple[str, ...] | None
    layout: tuple[Layout, ...]
    rows: int | None
    stacked: frozenset[str]
    shared: weakref.ref[Samples] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "trials": None, "shared": None}  # each row has its own trial

    def sources(self) -> "Iterator[_Row]":
        recorded = any(record.name == "v_th" for record in self.layout)
        common, own = recorded and "v_th" not in self.stacked, id(self)
        for row in [None] if self.rows is None else range(self.rows):
            trial = "" if row is None or not self.trials else self.trials[row]
            yield _Row(self.layout, (own, None if common else row), self, row, trial)

    def samples(self, record: Layout, row: int | None) -> Samples:
        name, stacked = record.name, record.name in self.stacked
        common = row is not None and not stacked
        kept = self.shared() if common and self.shared else None
        if kept is not None:
            return kept
        with translated(self.samples_of.name, self.metadata.path, name):
            file = self.samples_of.open()
            if not file:
                raise RecordingError("the file is closed", remedy="Read it again, or use `with`")
            path = f"{self.metadata.path}/{name}"
            dataset = self.samples_of.stack(path) if stacked else file[path]
            assert isinstance(dataset, h5py.Dataset)  # the scan has checked this
            stored = dataset[row] if stacked else dataset[()]
            stored.flags.writeable = False
            samples = Samples(stored, record.conversion, record.offset)
        if common:  # shared as long as a recording of the stack is in use
            self.shared = weakref.ref(samples)
        return samples


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class _Row(AbstractSource):
    """One recording of a file; `row` is None if the group is not a stack."""

    block: _Block
    row: int | None
    trial: str

    @property
    def metadata(self) -> Metadata:
        common = self.block.metadata
        if self.row is None:
            return common
        return common.of_trial(f"{common.path}/{self.row}", self.trial)

    def blocks(self, name: str) -> Iterator[np.ndarray]:
        (record,) = (record for record in self.layout if record.name == name)
        yield self.block.samples(record, self.row).stored

    def load(self) -> Recording:
        samples = {record.name: self.block.samples(record, self.row) for record in self.layout}
        return of_checked(samples, self.metadata)


class Scan:
    """Recording groups of a file, and the faults of the others.

    Args:
        guarded: The file behind a guard; it is read here only.
        samples_of: The same file without a guard; samples are read from it later.
    """

    def __init__(self, guarded: h5py.File, samples_of: SamplesFile) -> None:
        self.samples_of, self.name = samples_of, samples_of.name
        self.blocks: dict[str, _Block] = {}
        self.problems: list[RecordingError] = []
        self._kinds: dict[str, str] = {}
        self._seen: dict[int, str] = {}
        self._walk(guarded, "")
        for path, block in self.blocks.items():
            for calibration in block.metadata.calibration:
                self._check_calibration(path, calibration)
        wrong = {problem.path for problem in self.problems}
        self.blocks = {path: block for path, block in self.blocks.items() if path not in wrong}

    def sources(self) -> dict[str, AbstractSource]:
        """The readable recordings, by path."""
        return {row.metadata.path: row for block in self.blocks.values() for row in block.sources()}

    def check_samples(self) -> None:
        """Read all samples, and report what no fit can use of them."""
        for path, source in self.sources().items():
            with self._reported(path):
                self._check(path, source.load())

    def _check(self, path: str, recording: Recording) -> None:
        before = len(self.problems)
        for name, record in recording.samples.items():
            count = int(np.sum(~np.isfinite(record.stored)))
            if count:
                are = "is" if count == 1 else "are"
                message = f"{count} of {record.stored.size} samples {are} not finite"
                remedy = "Record again; a fit of this recording only gives a verdict"
                self._report(path, name, message, remedy)
        with self._reported(path):
            check_rates(recording.samples[recording.cause].values, recording.metadata)
        current = recording.current
        if len(self.problems) == before and current is not None and np.ptp(current) == 0:
            remedy = "Record the current of the pulses, or remove the dataset"
            self._report(path, "current", f"is constant, {current[0]:g} A", remedy)

    def _report(self, path: str, field: str, message: str, remedy: str = "") -> None:
        self.problems.append(
            RecordingError(message, file=self.name, path=path or "/", field=field, remedy=remedy)
        )

    @contextlib.contextmanager
    def _reported(self, path: str, field: str = "") -> Iterator[None]:
        """Add an error to `problems` and continue."""
        try:
            with translated(self.name, path or "/", field):
                yield
        except RecordingError as problem:
            self.problems.append(problem)

    def _walk(self, group: h5py.Group, path: str) -> None:
        with self._reported(path):
            address = h5o.get_info(group.id).addr
            if address in self._seen:
                first = self._seen[address] or "/"
                remedy = "Store each recording once"
                return self._report(path, "", f"is the same group as {first!r}", remedy)
            self._seen[address] = path
            if path.count("/") >= limits.DEPTH:
                raise RecordingError(
                    f"lies more than {limits.DEPTH} groups deep",
                    remedy="Use a path such as 's01/dry/03'",
                )
            present = list(group.attrs)
            near = "kind" in present or near_miss("kind", present)
            names = sorted(group, key=natural)
            if near or "v_out" in names:
                return self._inspect(group, path, names, present)
            for name in names:
                child = f"{path}/{name}".lstrip("/")
                with self._reported(child):
                    self._enter(group, name, child)
        return None

    def _enter(self, group: h5py.Group, name: str, path: str) -> None:
        """Continue the walk in a member of a group that is not a recording."""
        link = local_link(group, name)
        if isinstance(link, h5py.SoftLink):
            member = group.get(name)
            if member is None:
                raise RecordingError(
                    f"is a dangling link to {link.path!r}", remedy="Remove or repair it"
                )
            if isinstance(member, h5py.Group):
                raise RecordingError(
                    f"is a soft link to the group {link.path!r}", remedy="Remove the link"
                )
            return
        member = group[name]
        if isinstance(member, h5py.Group):
            self._walk(member, path)
        elif name in schema.at("dataset"):
            raise RecordingError(
                "is a dataset outside of a recording group",
                remedy="Give its group the attribute kind and a dataset v_out",
            )
        elif isinstance(member, h5py.Dataset) and "kind" in member.attrs:
            raise RecordingError(
                "is a dataset with the attribute kind, but must be a group",
                remedy="Make it a group with the datasets v_th and v_out",
            )

    def _inspect(self, group: h5py.Group, path: str, names: list[str], present: list[str]) -> None:
        """Check a recording group against the schema, field by field."""
        before = len(self.problems)
        if not path:
            remedy = "Put the recording into a group of its own"
            return self._report(path, "kind", "the root of a file cannot be a recording", remedy)
        with self._reported(path, "path"):
            tidy_path(path)
        found = self._attributes(group, present, schema.at("group attribute"), path, "")
        kind = found.get("kind", "")
        self._kinds[path] = kind
        for field in schema.at("group attribute").values():
            if field.required in ("always", kind) and field.name not in present:
                self._missing(path, field)
            if kind and field.forbidden == kind and field.name in present:
                remedy = "Remove it, or change the kind"
                self._report(path, field.name, f"a {kind} recording must not have it", remedy)
        allowed = {
            name: field
            for name, field in schema.at("group attribute").items()
            if not kind or field.forbidden != kind
        }
        self._near_misses(present, allowed, path, "")
        shapes: dict[str, tuple[int, ...]] = {}
        layout: list[Layout] = []
        for field in schema.at("dataset").values():
            with self._reported(path, field.name):
                if field.name in names:
                    shapes[field.name], record = self._header(group, field, path)
                    layout.append(record)
                elif field.required in ("always", kind) or (
                    field.name == "v_th" and "current" not in names
                ):
                    self._missing(path, field)
        self._near_misses(names, schema.at("dataset"), path, "")
        for name in set(names) - set(SIGNALS):
            if isinstance(group.get(name, getlink=True), h5py.HardLink):
                member = group[name]
                if isinstance(member, h5py.Group) and "kind" in member.attrs:
                    remedy = "Move it out of that recording"
                    self._report(
                        f"{path}/{name}", "", f"lies inside the recording {path!r}", remedy
                    )
        if len(self.problems) == before:
            with self._reported(path):
                self.blocks[path] = self._block(path, found, shapes, layout)
        return None

    def _missing(self, path: str, field: Field) -> None:
        self._report(path, field.name, "is missing", f"Add {field.expects}")

    def _near_misses(self, names: list[str], known: dict[str, Field], path: str, of: str) -> None:
        absent = [name for name in known if name not in names]
        other = {field.name for field in schema.FIELDS}
        for name in names:
            near = None if name in other else near_miss(name, absent)
            if near:
                message = f"is not in the schema, did you mean {near}?"
                self._report(path, f"{of}{name}", message, "Rename it")

    def _attributes(
        self, owner: h5py.HLObject, names: list[str], known: dict[str, Field], path: str, of: str
    ) -> dict[str, Any]:
        """Parsed values of the attributes in the schema; invalid values are reported."""
        found: dict[str, Any] = {}
        for name in names:
            if name not in known:
                continue
            try:
                value = attribute(owner, name)
            except Exception as error:
                self._report(path, f"{of}{name}", f"cannot be read ({error})", "Write it again")
                continue
            try:
                found[name] = known[name].parse(value)
            except RecordingError as error:
                remedy = error.remedy or f"The schema requires {known[name].expects}"
                self._report(path, f"{of}{name}", error.message, remedy)
        return found

    def _header(self, group: h5py.Group, field: Field, path: str) -> tuple[tuple[int, ...], Layout]:
        """Shape and description of a dataset; its samples must be in this file."""
        link = local_link(group, field.name)
        try:
            dataset = group[field.name]
        except KeyError:
            target = getattr(link, "path", "")
            raise RecordingError(
                f"is a dangling link to {target!r}", remedy="Repair the link"
            ) from None
        if not isinstance(dataset, h5py.Dataset):
            what = "group" if isinstance(dataset, h5py.Group) else "datatype"
            raise RecordingError(f"is a {what}", remedy=f"Add {field.expects} as a dataset")
        dtype, shape = dataset.dtype, dataset.shape
        if dtype.kind not in "iuf" or dtype.itemsize > 8:
            raise RecordingError(
                f"has dtype {dtype}", remedy="Store integers or real numbers of at most 64 bits"
            )
        if shape is None or len(shape) not in (1, 2) or 0 in shape:
            what = "is empty" if shape is None or 0 in shape else f"has shape {shape}"
            what = "is one number" if shape == () else what
            raise RecordingError(what, remedy=f"The schema requires {field.expects}")
        if shape[-1] > limits.SAMPLES or (shape[0] > limits.TRIALS and len(shape) == 2):
            raise RecordingError(
                f"has shape {shape}; at most {limits.TRIALS} trials of {limits.SAMPLES} samples "
                "are read",
                remedy="Split the recording",
            )
        check_size(dataset)
        before = len(self.problems)
        known, of = schema.at("dataset attribute"), f"{field.name}."
        present = list(dataset.attrs)
        found = self._attributes(dataset, present, known, path, of)
        self._near_misses(present, known, path, of)
        if len(self.problems) == before and found.get("unit") != field.unit:
            what = f"is {found['unit']!r}" if "unit" in found else "is missing"
            raise RecordingError(
                what, field=f"{field.name}.unit", remedy=f"It must be {field.unit!r}"
            )
        scale = found.get("conversion", 1.0), found.get("offset", 0.0)
        try:
            Samples(np.zeros(1, dtype), *scale)
        except RecordingError as error:
            raise RecordingError(error.message, field=f"{of}{error.field}") from None
        return shape, Layout(field.name, dtype.str, shape[-1], *scale)

    def _block(
        self,
        path: str,
        found: dict[str, Any],
        shapes: dict[str, tuple[int, ...]],
        layout: list[Layout],
    ) -> _Block:
        """Block of a group whose fields are valid; checks that the fields match each other."""
        out = shapes["v_out"]
        once = [name for name, shape in shapes.items() if shape != out]
        if once and (once != ["v_th"] or shapes["v_th"] != out[-1:]):
            found_shapes = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise RecordingError(
                f"shapes do not fit each other: {found_shapes}",
                remedy="The schema requires (time,) or (trial, time); only v_th may be (time,) "
                "if v_out is stacked",
            )
        stacked = len(out) == 2
        if stacked and found["kind"] == "calibration":
            raise RecordingError(
                f"holds {out[0]} stacked calibrations",
                field="v_out",
                remedy="Write one group per calibration",
            )
        trials = found.pop("trial", None)
        trials = (trials,) if isinstance(trials, str) else trials
        if trials is not None and len(trials) != (out[0] if stacked else 1):
            wanted = f"{several(out[0], 'label')}, one per row" if stacked else "one label"
            raise RecordingError(
                f"has {several(len(trials), 'label')}", field="trial", remedy=f"Write {wanted}"
            )
        found.pop("kind")
        if not stacked and trials:
            found["trial"] = trials[0]
        metadata = metadata_from(**found, path=path)
        for trial in trials or ():
            metadata_from(**{**found, "trial": trial})  # checks the text of the label
        return _Block(
            self.samples_of,
            metadata,
            trials if stacked else None,
            tuple(layout),
            out[0] if stacked else None,
            frozenset(name for name, shape in shapes.items() if len(shape) == 2),
        )

    def _check_calibration(self, path: str, calibration: str) -> None:
        kind = self._kinds.get(calibration)
        if kind == "calibration":
            return
        what = "is not in the file" if kind is None else f"is a {kind or 'broken'} recording"
        remedy = "Name the HDF5 path of a group with kind='calibration'"
        self._report(path, "calibration", f"{calibration!r} {what}", remedy)
