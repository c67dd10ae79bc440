"""A study: many recordings by path, in memory or in a file."""

import dataclasses
import difflib
import functools
import itertools
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from etid.precision import unmasked
from etid.printing import ROWS, Overview, Overviewed, several
from etid.recordings.fields import LABELS, Metadata
from etid.recordings.labels import Label, wanted_labels
from etid.recordings.recording import AbstractSource, Layout, Recording, RecordingError, Samples


@dataclasses.dataclass(frozen=True, eq=False)
class _InMemory(AbstractSource):
    """A recording in memory."""

    recording: Recording

    @property
    def metadata(self) -> Metadata:
        return self.recording.metadata

    def blocks(self, name: str) -> Iterator[npt.NDArray]:
        yield self.recording.samples[name].stored

    def load(self) -> Recording:
        return self.recording


def _in_memory(recording: Recording) -> _InMemory:
    layout = tuple(
        Layout(name, record.stored.dtype.str, record.stored.size, record.conversion, record.offset)
        for name, record in recording.samples.items()
    )
    return _InMemory(layout, id(recording.samples.get("v_th", recording)), recording)


def refuse_nested(paths: Collection[str]) -> None:
    """Raise an error if one path lies inside another path."""
    for path in paths:
        outer = path.rpartition("/")[0]
        while outer:
            if outer in paths:
                raise RecordingError(
                    f"lies inside another recording, {outer!r}",
                    path=path,
                    remedy="Give it a path outside of the other",
                )
            outer = outer.rpartition("/")[0]


class Study(Overviewed, Mapping[str, Recording]):
    """Ordered recordings by path; recordings of a file are loaded when they are accessed.

    `Study.from_recordings` and `etid.read` make a study. A study from a file keeps the file open:
    use `with`, or call `close()`. A pickle or a deep copy of such a study opens the file again.

    Attributes:
        file: Path of the file; empty for a study in memory.
        problems: Errors of the recordings that cannot be read, by path. Access to such a recording
            raises its error.
    """

    def __init__(
        self,
        sources: Mapping[str, AbstractSource],
        *,
        problems: Mapping[str, RecordingError] | None = None,
        file: str = "",
        close: Callable[[], None] | None = None,
        named: "Study | None" = None,
    ) -> None:
        self._sources = dict(sources)
        self._close = close
        self._named = named
        self.problems: dict[str, RecordingError] = dict(problems or {})
        self.file = file

    @classmethod
    def from_recordings(cls, recordings: Iterable[Recording]) -> "Study":
        """A study in memory; recordings without a path become `loaded/0`, `loaded/1`, ….

        Args:
            recordings: Calibrations and loaded recordings.

        Returns:
            Study with the recordings in the given order.

        Raises:
            RecordingError: Two recordings have the same path, or a path lies inside another path.
        """
        sources: dict[str, AbstractSource] = {}
        unnamed = {"loaded": 0, "calibration": 0}
        for recording in recordings:
            kind = recording.metadata.kind
            if not recording.path:
                recording = recording.replace(path=f"{kind}/{unnamed[kind]}")
                unnamed[kind] += 1
            if recording.path in sources:
                raise RecordingError(
                    "two recordings have this path",
                    path=recording.path,
                    remedy="Give each recording a path of its own",
                )
            sources[recording.path] = _in_memory(recording)
        refuse_nested(sources)
        return cls(sources)

    @classmethod
    def from_arrays(
        cls,
        v_th: npt.ArrayLike,
        v_out: npt.ArrayLike,
        *,
        calibrations: Mapping[float, tuple[npt.ArrayLike, npt.ArrayLike]] | None = None,
        **fields: Any,
    ) -> "Study":
        """A study in memory from arrays, as in a notebook.

        Args:
            v_th: Unloaded output of the driver [V], (trial, time), or (time,) for all trials.
            v_out: Output with the load [V], (trial, time) or (time,).
            calibrations: Records (v_th, v_out) of the same shapes with a known resistor, by its
                resistance [ohm].
            **fields: Fields of all recordings, as in `Recording`. The number of a trial is its
                `trial`.

        Returns:
            Study of `calibration/0`, … and `loaded/0`, …, which name these calibrations.

        Raises:
            RecordingError: A field is wrong, or the arrays do not fit each other.
        """
        found: list[Recording] = []
        for r_load, (th, out) in (calibrations or {}).items():
            place = f"calibration/{len(found)}"
            found += _trials(th, out, place, {**fields, "r_load": r_load})
        known = tuple(one.path for one in found)
        named: dict[str, Any] = {"calibration": known} if known else {}
        return cls.from_recordings([*found, *_trials(v_th, v_out, "loaded", {**fields, **named})])

    def __getitem__(self, path: str) -> Recording:
        return self.source(path).load()

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)

    def __contains__(self, path: object) -> bool:
        return isinstance(path, str) and path.strip("/") in self._sources

    def __eq__(self, other: object) -> bool:
        return self is other  # the method of Mapping would load and compare all samples

    def __hash__(self) -> int:
        return id(self)

    def source(self, path: str) -> AbstractSource:
        """Source of the recording at a path; it gives metadata without reading samples.

        Raises:
            RecordingError: `path` is no text, or the recording at this path cannot be read.
            KeyError: There is no recording at this path; the message suggests similar paths.
        """
        if not isinstance(path, str):
            first = next(iter(self._sources), "s01/dry/0")
            raise RecordingError(
                f"is {path!r}, must be the path of a recording",
                field="path",
                remedy=f"Write study[{first!r}]; list(study) has all paths",
            )
        tidy = path.strip("/")
        if tidy in self._sources:
            return self._sources[tidy]
        if (tidy or "/") in self.problems:
            raise self.problems[tidy or "/"]
        rows = [name for name in self._sources if name.startswith(f"{tidy}/")]
        if rows:
            raise KeyError(
                f"{path!r} is a group of {several(len(rows), 'recording')}: "
                f"{rows[0]!r} … {rows[-1]!r}"
            )
        near = difflib.get_close_matches(tidy, self._sources, n=3)
        known = ", ".join(repr(name) for name in near or list(self._sources)[:3])
        raise KeyError(f"no recording {path!r}; this study has {len(self)}, such as {known}")

    def metadata(self, path: str) -> Metadata:
        """All fields of a recording except its samples; no samples are read.

        Raises:
            RecordingError: The recording at this path cannot be read.
            KeyError: There is no recording at this path.
        """
        return self.source(path).metadata

    def recordings(self) -> Iterator[Recording]:
        """Iterator over the recordings; it loads one recording at a time."""
        return (source.load() for source in self._sources.values())

    def where(self, **labels: Label | None) -> "Study":
        """Study of the recordings with these labels; no samples are read.

        Args:
            **labels: Values of `subject`, `condition`, `electrode` or `trial`.

        Returns:
            Study that reads from the same file.

        Raises:
            RecordingError: The name of a label is unknown, or a value is neither text nor an
                integer.
        """
        wanted = wanted_labels(labels, LABELS)
        chosen = {
            path: source
            for path, source in self._sources.items()
            if all(getattr(source.metadata, name) == label for name, label in wanted.items())
        }
        return self._part(chosen, {})  # a recording that cannot be read has no labels

    @property
    def calibrations(self) -> "Study":
        """Study of the recordings with a known resistor."""
        return self._part(self._known, self.problems)

    @property
    def loaded(self) -> "Study":
        """Study of the recordings with an unknown load."""
        loaded = {p: of for p, of in self._sources.items() if p not in self._known}
        return self._part(loaded, self.problems)

    @property
    def named(self) -> "Study":
        """Study with the calibrations that its recordings name.

        A part of a study, as `where` makes it, finds them in the whole.
        """
        return self if self._named is None else self._named

    def only(self, paths: Iterable[str]) -> "Study":
        """Study of the recordings at these paths; those that cannot be read are its problems."""
        return self._part(
            {path: self._sources[path] for path in paths if path in self._sources},
            {path: self.problems[path] for path in paths if path in self.problems},
        )

    @functools.cached_property
    def _known(self) -> dict[str, AbstractSource]:
        """The recordings with a known resistor."""
        return {p: of for p, of in self._sources.items() if of.metadata.kind == "calibration"}

    def _part(
        self, chosen: Mapping[str, AbstractSource], problems: Mapping[str, RecordingError]
    ) -> "Study":
        of: dict[str, Any] = {"file": self.file, "close": self._close}
        named = self._named
        if named is None:
            named = Study(self._known, problems=self.problems, **of)
        return Study(chosen, problems=problems, named=named, **of)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the study to an HDF5 file, completely or not at all.

        Loaded recordings `g/0 … g/T-1` become one stacked group `g`, if there are at least two, if
        there are no other recordings below `g`, and if all fields except samples and trial are
        equal. If they share one `v_th`, it is stored once. Every other recording becomes a separate
        group. `etid.read` gives the same paths, stored integers and metadata. A part of a study is
        written with the calibrations that its recordings name.

        Args:
            path: File to write. An existing file is replaced at the end.

        Raises:
            RecordingError: A recording of the study cannot be read, a named calibration is missing
                in the study, or the file cannot be written.
        """
        if self.problems:
            raise RecordingError(
                f"{several(len(self.problems), 'recording')} of the study cannot be read",
                file=self.file,
                remedy="Remove them with Study.from_recordings(study.recordings())",
            )
        from etid.recordings.hdf5 import write  # it imports this module

        names = {name for one in self._sources.values() for name in one.metadata.calibration}
        known = {name: of for name, of in self.named._sources.items() if name in names}
        write(known | self._sources, path)

    def close(self) -> None:
        """Close the file of the study; all parts of the study use the same file."""
        if self._close is not None:
            self._close()

    def __enter__(self) -> "Study":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _overview(self) -> Overview:
        rows = []
        for path, source in itertools.islice(self._sources.items(), ROWS):
            of = source.metadata
            known = "" if of.r_load is None else f"{of.r_load / 1e3:.6g} kΩ"
            labels = [getattr(of, name) for name in LABELS]
            rows.append((path, known, f"{of.sample_rate:g}", f"{of.pulse_rate:g}", *labels))
        heads = ("path", "r_load", "sample_rate [Hz]", "pulse_rate [Hz]", *LABELS)
        notes = [str(problem) for problem in self.problems.values()]
        return Overview(repr(self).strip("<>"), rows, heads, notes[:ROWS], count=len(self))

    def __repr__(self) -> str:
        place = f" {self.file!r}" if self.file else ""
        bad = f", {len(self.problems)} that cannot be read" if self.problems else ""
        known, loaded = several(len(self._known), "calibration"), len(self) - len(self._known)
        return f"<Study{place}: {known}, {loaded} loaded{bad}>"


def _trials(
    v_th: npt.ArrayLike, v_out: npt.ArrayLike, path: str, fields: Mapping[str, Any]
) -> list[Recording]:
    """One recording for each row of `v_out`."""
    th, out = np.asarray(unmasked(v_th)), np.asarray(unmasked(v_out))
    if out.ndim == 1 and path.startswith("calibration"):
        return [Recording(th, out, path=path, **fields)]
    rows = np.atleast_2d(out)
    shared = th.ndim == 1
    if rows.ndim != 2 or (not shared and th.shape != rows.shape):
        raise RecordingError(
            f"shapes do not fit each other: v_th {th.shape}, v_out {out.shape}",
            path=path,
            remedy="Both must be (trial, time) or (time,); v_th may be (time,) for all trials",
        )
    unloaded = Samples(th) if shared and th.dtype.kind == "f" else th
    found = []
    for number, row in enumerate(rows):
        own: dict[str, Any] = {"trial": number, **fields, "path": f"{path}/{number}"}
        found.append(Recording(unloaded if shared else th[number], row, **own))
    return found
