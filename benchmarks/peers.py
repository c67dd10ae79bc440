"""What others take for a fit: SciPy and stock optimistix; and trials behind one driver for it.

All get the same residual and the same start. optimistix, which has no filters, runs as its users
run it, `vmap` over lanes, `SIDE_BY_SIDE` at a time. SciPy goes from lane to lane with residual and
Jacobian in NumPy, and is measured on a few of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.optimize
import scipy.signal
from jaxtyping import Float

import etid
from benchmarks.ladder import recorded
from etid.circuits.circuit import SkinRC
from etid.estimators.lanes import Harmonics, stacked
from etid.estimators.maximum_likelihood.rows import load_of, source_of
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import known_of
from etid.likelihood.driver import MAX_STEPS
from etid.likelihood.load import Load
from etid.likelihood.profile import Profile
from etid.likelihood.search import minimum
from etid.likelihood.source import Source
from etid.likelihood.starts import starts
from etid.precision import array_function
from etid.recordings.preflight import Inspected
from etid.signals.filtering import lfilter
from etid.signals.harmonics import real_parts
from etid.signals.transfer import AnyArray
from etid.simulation.published import REFERENCE, TYPICAL

SAMPLES = 33_330  # ten pulse periods at 200 kHz
LOAD = TYPICAL["dry"]
# Logarithms of typical values, a factor of two from the truth, and no delay.
START = np.append(np.log([20e3, 100e3, 0.3e-9]), 0.0)
SIDE_BY_SIDE = 98
BY_SCIPY = 8  # lanes
B, A = cast(tuple[np.ndarray, np.ndarray], scipy.signal.butter(6, 0.3))


def filter_calls(v: Any) -> dict[str, Callable[[], Any]]:
    """One pass, gradient and normal equations of three coefficients of a filter of order 6."""
    v, b, a = map(jnp.asarray, (v, B, A))
    forward = jax.jit(lambda b, v: lfilter(b, a, v)[0])
    gradient = jax.jit(jax.grad(lambda b, v: jnp.sum(lfilter(b, a, v)[0] ** 2)))

    def three(q, v):
        return lfilter(b, a.at[1:4].add(q), v)[0]

    @jax.jit
    def equations(q, v):
        residual, slopes = three(q, v), jax.jacfwd(three)(q, v)
        return slopes.T @ residual, slopes.T @ slopes

    return {
        "filter": lambda: forward(b, v),
        "gradient": lambda: gradient(b, v),
        "normal equations of 3": lambda: equations(jnp.zeros(3), v),
    }


Run = Callable[[np.ndarray], Any]  # lanes by their numbers


class Problem(NamedTuple):
    """Trials of one load with their driver."""

    study: etid.Study  # all recordings
    driver: etid.Driver  # as identified from the calibration
    records: list[etid.Recording]  # the trials
    lanes: Harmonics  # their harmonics, stacked
    source: Source  # Z_th as the calibration tells it, without its error

    def load(self, lanes: Any) -> Load:
        """Lanes with Z_th as it is: elements and delay are unknown."""
        return load_of(lanes, self.source, SkinRC(), None, None)


@array_function
def terms(own: Float[AnyArray, " own"], load: Load) -> Float[AnyArray, " term"]:
    """What all solvers minimise the squares of."""
    of = Profile.of(load.records, load.gains(own))
    scale = jnp.where(load.records.used, jnp.sqrt(2 / of.expected), 0.0)
    return jnp.concatenate([real_parts((of.innovations * scale).ravel()), load.rest(own)])


def harmonics(record: etid.Recording) -> Harmonics:
    """The lane of a trial: harmonics and noise."""
    return Harmonics.of(Inspected.of(record))


def problem_of(study: etid.Study, driver: etid.Driver) -> Problem:
    """The same for given recordings."""
    records = list(study.loaded.recordings())
    lanes = [harmonics(record) for record in records]
    of = source_of(known_of(lanes[0], driver, False, MAXIMUM_LIKELIHOOD))
    none = np.zeros(0)
    known = of._replace(
        loaded=of.z_loaded(of.w(of.mean, np.zeros(1))),
        by_z=of.by_z[:0],
        mean=none,
        cov=np.diag(none),
        errors=None,
    )
    return Problem(study, driver, records, stacked(lanes), known)


def problem(samples: int, lanes: int, sample_rate: float = 200e3) -> Problem:
    """Simulate `lanes` trials of `samples` samples and identify their driver."""
    loads = {f"loaded/{i}": LOAD for i in range(lanes)}
    resistors = {"calibration/0": REFERENCE}
    scene = recorded(loads, resistors, samples=samples, sample_rate=sample_rate)
    study = scene.simulate(seed=3)
    driver = etid.identify_driver(study["calibration/0"], method="maximum_likelihood", throw=False)
    return problem_of(study, driver)


class ByNumPy:
    """The same terms and their Jacobian as one would write them with NumPy.

    e = w (Y − G X), w = √(2 / (σ_y² + |G|² σ_x²)), G = Z_L / (Z_L + Z_th) e^(−jωτ), and a weak
    prior of the delay.
    """

    def __init__(self, load: Load):
        spectrum = load.records
        used = np.asarray(spectrum.used[0])
        self.x, self.y = np.asarray(spectrum.x)[used], np.asarray(spectrum.y[0])[used]
        self.of_x = np.asarray(spectrum.variance_x)[used]
        self.of_y = np.asarray(spectrum.variance_y[0])[used]
        self.s = 2j * np.pi * np.asarray(spectrum.frequency)[used]
        source = load.gains.source
        assert source.loaded is not None
        self.z_th = (source.loaded - source.resistance)[used]
        self.rate = float(load.gains.sample_rate)
        self.width = float(load.width[-1])

    def _parts(self, q: np.ndarray):
        r_s, r_p, c_p = np.exp(q[:3])
        one = 1 / (1 + self.s * r_p * c_p)
        z = r_s + r_p * one
        turn = np.exp(-self.s * q[3] / self.rate)
        total = 1 / (z + self.z_th)
        g = z * total * turn
        weight = np.sqrt(2 / (self.of_y + np.abs(g) ** 2 * self.of_x))
        return r_s, r_p, c_p, one, turn, total, g, weight, self.y - g * self.x

    def terms(self, q: np.ndarray) -> np.ndarray:
        """Residuals."""
        *_, weight, e = self._parts(q)
        e = e * weight
        return np.concatenate([e.real, e.imag, [q[3] / self.width]])

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Their derivatives."""
        r_s, r_p, c_p, one, turn, total, g, weight, e = self._parts(q)
        by_z = self.z_th * total**2 * turn
        slope = r_p * one**2
        of_g = np.stack(
            [by_z * r_s, by_z * slope, -by_z * slope * self.s * r_p * c_p, -g * self.s / self.rate]
        )
        of_weight = -0.5 * weight**3 * self.of_x * (np.conj(g) * of_g).real
        columns = of_weight * e - of_g * self.x * weight
        last = np.array([[0.0, 0.0, 0.0, 1 / self.width]])
        return np.concatenate([columns.real.T, columns.imag.T, last])


def _vmapped(one: Callable[[Any], Any], data: Any) -> Run:
    """Lanes side by side."""

    @jax.jit
    def run(data, index):
        lanes = jax.tree.map(lambda leaf: leaf[index], data)
        if index.shape[0] <= SIDE_BY_SIDE:
            return jax.vmap(one)(lanes)
        return jax.lax.map(one, lanes, batch_size=SIDE_BY_SIDE)

    return lambda index: run(data, jnp.asarray(index))


def _looped(one: Callable[[Any], Any], data: Any) -> Run:
    """Lanes in a Python loop, those few that SciPy is measured on."""
    return lambda index: [
        one(jax.tree.map(lambda leaf, i=i: leaf[i], data)) for i in index[:BY_SCIPY]
    ]


def numpy_steiglitz_mcbride(
    v_th: np.ndarray, v_out: np.ndarray, b: np.ndarray, a: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """N and D of the skin (paper, eqs. 1, 8, 9), as one would write it with NumPy and SciPy."""
    x, w = v_th - v_out, scipy.signal.lfilter(b, a, v_out)
    den = np.array([1.0])
    num = den
    for _ in range(iterations):
        xf, wf = scipy.signal.lfilter([1.0], den, x), scipy.signal.lfilter([1.0], den, w)
        columns = np.stack([xf, np.r_[0.0, xf[:-1]], -np.r_[0.0, wf[:-1]]], axis=1)
        found = np.linalg.lstsq(columns, wf)[0]
        num, den = found[:2], np.array([1.0, found[2]])
    return num, den


def harmonic_steiglitz_mcbride(of: Problem) -> Run:
    """Our Steiglitz-McBride on the harmonics, a start of fits: the elements."""
    return lambda index: np.exp(starts(of.load(_rows(of, index)))[0, :, :3])


def ours(of: Problem) -> Run:
    """Our fits as rows."""

    def run(index: np.ndarray) -> np.ndarray:
        return minimum(of.load(_rows(of, index)), np.tile(START, (1, len(index), 1))).q

    return run


def _rows(of: Problem, index: np.ndarray) -> Harmonics:
    return jax.tree.map(lambda leaf: leaf[index], of.lanes)


def _by_optimistix(of: Problem) -> Callable[[Any], Any]:
    """Elements and delay of one lane."""
    start, settings = jnp.asarray(START), {"max_steps": MAX_STEPS, "throw": False}
    stock = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def fit(one: Any) -> Float[AnyArray, " own"]:
        load = of.load(one)
        return optx.least_squares(lambda q, _: terms(q, load), stock, start, **settings).value

    return fit


def _minpack(value: Callable, slope: Any) -> np.ndarray:
    return scipy.optimize.least_squares(value, START, jac=slope, method="lm", x_scale="jac").x


def _scipy_fit(of: Problem) -> Callable[[Any], np.ndarray]:
    def fit(one):
        by = ByNumPy(of.load(one))
        return _minpack(by.terms, by.jacobian)

    return fit


def compiled_scipy_fit(of: Problem) -> Callable[[Any], np.ndarray]:
    """By MINPACK with our compiled terms, and a Jacobian by forward differentiation."""
    value, slope = jax.jit(terms), jax.jit(jax.jacfwd(terms))

    def fit(one):
        load = of.load(one)
        return _minpack(lambda q: np.asarray(value(q, load)), lambda q: np.asarray(slope(q, load)))

    return fit


def solvers(of: Problem) -> dict[str, Run]:
    """One fit per lane, Z_th known, by every solver."""
    return {
        "ours": ours(of),
        "scipy": _looped(_scipy_fit(of), of.lanes),
        "optimistix": _vmapped(_by_optimistix(of), of.lanes),
    }


def from_samples_by_scipy(of: Problem) -> Run:
    """SciPy's fits from the samples on, with our harmonics."""
    fit = _scipy_fit(of)

    def one(i: int) -> np.ndarray:
        harmonics(of.records[i])
        return fit(jax.tree.map(lambda leaf: leaf[i], of.lanes))

    return lambda index: [one(i) for i in index[:BY_SCIPY]]


def judged(of: Problem) -> Run:
    """What etid does by default: jointly with the calibration, with errors and a verdict."""
    return lambda index: etid.identify_skins([of.records[i] for i in index], of.driver).fit.chi2
