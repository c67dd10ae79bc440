"""Where the electrodes of a display are."""

import dataclasses
import os
import pathlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from etid.precision import unmasked
from etid.printing import Overview, Overviewed, several
from etid.recordings.errors import RecordingError, located, optional, require_file
from etid.recordings.tables import rows_of


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Layout(Overviewed):
    """Places of electrodes.

    Attributes:
        electrodes: Names, as in the label `electrode` of recordings.
        x: Places along the width of the display [m].
        y: Places along its length, towards the tip of the finger [m].
    """

    electrodes: Sequence[str]
    x: Float[np.ndarray, " electrode"]
    y: Float[np.ndarray, " electrode"]

    def __post_init__(self) -> None:
        names = [str(one) for one in self.electrodes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise RecordingError(f"a layout has these electrodes twice: {', '.join(twice)}")
        x, y = (np.asarray(unmasked(of), float) for of in (self.x, self.y))
        if not x.shape == y.shape == (len(names),) or not np.isfinite([x, y]).all():
            raise RecordingError(
                f"a layout needs a finite place for each of {several(len(names), 'electrode')}; x "
                f"is of shape {x.shape} and y of shape {y.shape}"
            )
        for name, value in (("electrodes", tuple(names)), ("x", x), ("y", y)):
            object.__setattr__(self, name, value)

    def _overview(self) -> Overview:
        names = self.electrodes
        ends = " … ".join(dict.fromkeys([*names[:1], *names[-1:]]))
        size = " x ".join(f"{1e3 * np.ptp(of) if of.size else 0.0:g}" for of in (self.x, self.y))
        return Overview(f"Layout of {several(len(names), 'electrode')}, {ends}: {size} mm")

    @classmethod
    def grid(cls, rows: int, columns: int, pitch: float, first: str = "E1") -> "Layout":
        """Electrodes in a rectangle, numbered along the rows from the tip of the finger.

        Args:
            rows: Number of rows.
            columns: Number of electrodes in a row.
            pitch: Distance of neighbours [m].
            first: Name of the first electrode: a text that ends with a number.
        """
        start = first.rstrip("0123456789")
        number = int(first[len(start) :])
        row, column = np.divmod(np.arange(rows * columns), columns)
        names = [f"{start}{number + one}" for one in range(rows * columns)]
        return cls(names, pitch * column, pitch * (rows - 1 - row))

    def place(self, names: np.ndarray) -> np.ndarray:
        """Row of the layout of each name.

        Raises:
            ValueError: An electrode is not in the layout.
        """
        rows = {name: row for row, name in enumerate(self.electrodes)}
        for name in names:
            if not str(name):
                raise ValueError(
                    "a fit has no label electrode, so it has no place on a map; give each "
                    "recording its electrode"
                )
            if str(name) not in rows:
                raise ValueError(
                    f"electrode {str(name)!r} is not in the layout, which has "
                    f"{self.electrodes[0]} to {self.electrodes[-1]}; give a layout with the names "
                    "of your recordings: etid.plot(fits, map=…, layout=…)"
                )
        return np.array([rows[str(name)] for name in names], int)


def like_fingertip(electrodes: int) -> Layout:
    """Electrodes in rows as those of the paper's display."""
    whole = Layout.grid(-(-electrodes // 7), 7, 2e-3)
    return Layout(whole.electrodes[:electrodes], whole.x[:electrodes], whole.y[:electrodes])


FINGERTIP = like_fingertip(98)
"""The paper's display: 98 electrodes, 2 mm apart, on 26 x 12 mm²."""


def read_layout(path: str | os.PathLike[str]) -> Layout:
    """Places of electrodes from a table or a probe file.

    Args:
        path: A CSV table with the columns `electrode`, `x` and `y` [m], or a file of
            probeinterface (`.json`; extra `probe`) with one planar probe; its contacts are
            electrodes by their `contact_ids`.

    Raises:
        RecordingError: The file is missing, is neither of both, or needs a package.
    """
    require_file(os.fspath(path))
    file = pathlib.Path(path)
    if file.suffix.lower() == ".json":
        return _of_probe(file)
    with located(str(file), foreign=UnicodeDecodeError):
        rows = rows_of(file, ("electrode", "x", "y"))
        x, y = (np.array([_metres(row, name) for row in rows]) for name in ("x", "y"))
        return Layout([row["electrode"] for row in rows], x, y)


def _metres(row: dict[str, str], name: str) -> float:
    try:
        return float(row[name])
    except ValueError:
        raise RecordingError(
            f"is {row[name]!r} for electrode {row['electrode']!r}, must be a number", field=name
        ) from None


def _of_probe(file: pathlib.Path) -> Layout:
    """The layout of the one probe of a file of probeinterface."""
    reader = optional("probeinterface", "probe", str(file))
    with located(str(file), foreign=Exception):
        probes = reader.read_probeinterface(file).probes
        if len(probes) != 1 or probes[0].ndim != 2:
            raise RecordingError("must hold one planar probe")
        [probe] = probes
        unit = {"um": 1e-6, "mm": 1e-3, "m": 1.0}[probe.si_units]
        return Layout(probe.contact_ids.tolist(), *(unit * probe.contact_positions).T)
