"""The loads of one driver, behind the Z_th of given common parameters.

All loads share Z_th, the delays of the calibrations and the errors of the instrument, `common`. The
elements and the delays of a load, `own`, appear only in the terms of this load.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.likelihood.calibrations import DENSE, Calibrations
from etid.likelihood.gains import FAULTS
from etid.likelihood.load import ROWS, Load
from etid.likelihood.shared import Calibrated, Unloaded
from etid.likelihood.source import Source
from etid.precision import namespace
from etid.signals.knots import DENSITY, knots
from etid.signals.transfer import AnyArray, as_complex, reciprocal

W = 2  # number of signals of W: real and imaginary part


@dataclasses.dataclass(frozen=True)
class Loads:
    """Recordings of one length with one driver.

    Attributes:
        load: The recordings, with the priors of their own parameters.
        same: Whether the unloaded record of each calibration is that of the recording; None if
            none can be.
        used: Whether the recording takes part. The others are fitted, but do not affect Z_th.
        unloaded: Index of the unloaded record among those that several recordings share; −1 if no
            other recording has it.
    """

    load: Load
    same: Bool[np.ndarray, "row calibration"] | None
    used: Bool[np.ndarray, " row"]
    unloaded: np.ndarray

    @property
    def count(self) -> int:
        """Number of recordings."""
        return len(self.used)

    @property
    def frequency(self) -> Float[np.ndarray, " bin"]:
        """The harmonics of the first recording [Hz]."""
        return self.load.gains.frequency[0]

    def of(self, rows: np.ndarray) -> "Loads":
        """Some of the recordings."""
        same = None if self.same is None else self.same[rows]
        return Loads(self.load.of(rows), same, self.used[rows], self.unloaded[rows])

    def parts(self) -> Iterator[tuple[np.ndarray, "Loads"]]:
        """A few recordings at a time, and their numbers."""
        for first in range(0, self.count, ROWS):
            rows = np.arange(first, min(first + ROWS, self.count))
            yield rows, self.of(rows)

    def behind(
        self, source: Source, known: Calibrated | None = None, density: int = DENSITY
    ) -> Load:
        """The recordings behind a source, whose z have no prior."""
        load, xp = self.load, namespace(source.by_z)
        own, z = load.gains.owned, source.mean
        width, delay = load.width[:own], load.gains.elements
        width = xp.where(np.arange(own) == delay, source.delay_width, width)
        unloaded = None
        if known is not None and self.same is not None:
            unloaded = Unloaded.by(known, load.records, self.same)
        return dataclasses.replace(
            load,
            gains=dataclasses.replace(load.gains, source=source),
            centre=xp.concatenate([load.centre[:own], z]),
            width=xp.concatenate([width, np.inf + z]),
            unloaded=unloaded,
            density=density,
        )


@dataclasses.dataclass(frozen=True)
class Signals:
    """Functions of frequency through which a driver acts on loads of one length.

    These are W = log(Z_th + R) at the knots, then the errors of the instrument that change loads,
    which are constant, then, if a load may have the unloaded record of a calibration, the gains of
    the calibrations. Real and imaginary parts are signals of their own.

    Attributes:
        calibrations: The calibrations.
        loads: The loads.
    """

    calibrations: Calibrations
    loads: Loads

    @property
    def frequency(self) -> Float[np.ndarray, " knot"]:
        """The knots [Hz]."""
        return knots(self.loads.frequency.size, DENSE).at(self.loads.frequency)

    @property
    def _faults(self) -> int:
        return 0 if self.calibrations.instrument is None else FAULTS

    @property
    def smooth(self) -> int:
        """Number of signals that act through gains of loads, not through X."""
        return W + self._faults

    def __call__(self, common: Float[AnyArray, "*row common"]) -> AnyArray:
        """The signals, each at all knots (*row change)."""
        of = self.calibrations
        z_th = of.source.impedance(of.parameters(common), self.frequency)
        w = namespace(z_th).log(z_th + as_complex(of.calibration.r_load.mean()))
        known = None if self.loads.same is None else of.gains(common, of.knots)
        return self._all(_parts(w[..., None, :]), of.errors(common), known)

    def slopes(self, common: Float[AnyArray, "*row common"]) -> AnyArray:
        """Derivatives of the signals (*row common change)."""
        of, xp = self.calibrations, namespace(common)
        z_th, rows = of.source.slopes(of.parameters(common), self.frequency)
        rows = rows * reciprocal(z_th + as_complex(of.calibration.r_load.mean()))[..., None, :]
        rest = common.shape[-1] - rows.shape[-2]
        none = xp.zeros((*rows.shape[:-2], rest, rows.shape[-1]), rows.dtype)
        w = xp.concatenate([rows, none], -2)[..., None, :]
        known = None if self.loads.same is None else of.slopes(common, of.knots).by_q
        errors = np.eye(common.shape[-1]) + xp.zeros((*common.shape[:-1], 1, 1))
        return self._all(_parts(w), of.errors(errors), known)

    def _all(
        self, w: AnyArray, errors: AnyArray, known: Complex[AnyArray, "*row record knot"] | None
    ) -> AnyArray:
        xp, parts = namespace(w), [w]
        faults = errors[..., : self._faults, None]
        parts.append(faults + xp.zeros((*faults.shape[:-1], w.shape[-1])))
        parts += [] if known is None else [_parts(known)]
        every = xp.concatenate(parts, -2)
        return every.reshape(*every.shape[:-2], -1)

    def behind(self, common: Float[AnyArray, " common"], loads: Loads) -> Load:
        """Some of the loads; z are the signals at each harmonic, and 0."""
        of, xp = self.calibrations, namespace(common)
        nothing = xp.zeros((common.shape[0], 0))
        source = of.around(common, nothing, loads.frequency)
        known, count = None, self.smooth
        unit = np.array([1.0, 1.0j])
        if loads.same is not None:
            at, records = of.calibrated(common, nothing), len(of.spectra.x)
            count += W * records
            alone = np.zeros((count, records), complex)
            alone[self.smooth :] = np.kron(np.eye(records), unit[:, None])
            by_z = np.broadcast_to(alone[..., None], (*alone.shape, at.x.shape[-1]))
            known = at._replace(gains_by_z=by_z)
        zero, by_w = xp.zeros(count), np.zeros((count, len(loads.frequency)), complex)
        by_w[:W] = unit[:, None]
        tolerances = source.tolerances
        if tolerances is not None:
            by_z = np.zeros((count, FAULTS))
            by_z[W : self.smooth] = np.diag(of.tolerances[:FAULTS])
            tolerances = tolerances._replace(faults_by_z=by_z, bending_by_z=zero)
        source = source._replace(by_z=by_w, mean=zero, cov=xp.diag(zero), tolerances=tolerances)
        return loads.behind(source, known, DENSE)


def _parts(values: Complex[AnyArray, "*row of knot"]) -> AnyArray:
    """Real and imaginary part of each function in turn (*row signal knot)."""
    parts = namespace(values).stack([values.real, values.imag], -2)
    return parts.reshape(*values.shape[:-2], -1, values.shape[-1])
