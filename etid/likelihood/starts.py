"""Starts of the fits of loads: Steiglitz-McBride on the harmonics, and impedance levels.

In the periodic steady state X N/D = W holds exactly at every harmonic, with X = V_th − V_out, W =
Z_th V_out and the continuous Z_bio = N/D (paper, eqs. 7-9),

    N = b₀ + b₁ s,      D = 1 + a₁ s,      R_s = b₁/a₁,   R_p = b₀ − R_s,   C_p = a₁/R_p.

Nothing is discretised. Eqs. (1), (2) become sums over harmonics of |X N_i − W D_i|² with the
weights 1/|D_{i−1}|². Two things are added.

**A trigger delay τ** multiplies V_out by e^{jωτ} = 1 + jωτ + …. It is one more linear unknown with
the coefficient T = −jω V_out (N + Z_th D)_{i−1}. V_out is then corrected by the delay found.

**Noise** of V_out is in X and in W, and biases the sums. They contain the records only in the
products x*x, y*y and x*y. The known variances are subtracted from the first two (bias-compensating
least squares; Söderström 2007, "Errors-in-variables methods in system identification", Automatica
43). The remaining bias comes from the errors of the variances.

Let v = (x − y)* y, and let ⟨ ⟩ be the weighted sum over all harmonics. k and l are coefficients
without −jω and y: that of a₁ is Z_th, and that of τ is N + Z_th D. The normal equations consist of

    ⟨X* X⟩ = ⟨|x − y|²⟩,            ⟨X* k⟩ = ⟨ω Im kv⟩,
    ⟨k* l⟩ = ⟨ω² Re k*l y*y⟩,   ⟨(jωX)* k⟩ = −⟨ω² Re kv⟩,

and ⟨Re Z_th v⟩, ⟨ω Im Z_th v⟩, 0 and −⟨ω Im k*Z_th y*y⟩ on the right. X and jωX are orthogonal.
Therefore b₀ and b₁ are eliminated one by one, and a₁ and τ remain. A pole in the right half-plane
needs no reflection, because |1 + jωa₁| does not depend on the sign of a₁.

The products of the records are summed once, at the knots.
"""

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit, SkinRC, impedance_at
from etid.likelihood.gains import VoltageAndCurrent
from etid.likelihood.load import Load
from etid.precision import array_function, held, in_turn, namespace
from etid.signals.transfer import AnyArray, as_complex, power

RATE = 3e4  # [rad/s] rate of a skin's relaxation; in this unit the coefficients are near 1
STEPS = 5  # iterations of Steiglitz-McBride; more of them spare a fit no steps
LEVELS = (1.0, 0.125, 0.5, 2.0, 8.0)  # impedance levels of the other starts
# Time constants of the starts with a measured current, relative to the typical ones.
TIME_SCALES = np.geomspace(1e-3, 1e5, 17)
ROUGH = 0.01  # relative error of Y/I below which one line says as much as another


@array_function
@held
def starts(load: Load) -> Float[AnyArray, "start *row q"]:
    """Starts of a search, the likeliest first; the others serve where it is far away."""
    if load.gains.source.loaded is None:
        own = _by_current(load, load.records.x, load.records.variance_x)
    elif isinstance(load.gains.outputs, VoltageAndCurrent):
        records = load.records
        own = _by_current(load, records.y[..., 1, :], records.variance_y[..., 1, :])
    else:
        own = _by_harmonics(load)
    xp, z = namespace(own), load.gains.source.mean
    every = xp.concatenate([own, xp.broadcast_to(z, (*own.shape[:-1], z.size))], -1)
    elements = np.arange(every.shape[-1]) < load.gains.elements
    known = namespace(load.width).isfinite(load.width) & elements
    return xp.where(known, load.centre, every)


def _typical(circuit: AbstractCircuit) -> Float[AnyArray, " element"]:
    """Logarithms of the typical values of a circuit."""
    values = circuit.values()
    return namespace(values).log(values)


def _by_harmonics(load: Load) -> Float[AnyArray, "start *row own"]:
    """Starts of the own parameters, the likeliest first."""
    circuit, coefficients = load.gains.circuit, _steiglitz_mcbride(load)
    xp = namespace(coefficients)
    b0, b1, a1 = (coefficients[..., i] for i in range(3))
    r_s = b1 / a1
    skin = xp.stack([r_s, b0 - r_s, a1 / RATE / (b0 - r_s)], -1)
    typical, (level, time) = _typical(circuit), circuit.scaling()
    if isinstance(circuit, SkinRC):
        usable = (skin > 0).all(-1) & xp.isfinite(skin).all(-1)
        usable = usable[..., None]
        logs = xp.where(usable, xp.log(xp.where(usable, skin, 1.0)), typical)
    else:  # its resistance at low frequency and its time constant
        usual = SkinRC()
        scales = xp.stack([b0, a1 / RATE], -1)
        usable = (scales > 0).all(-1) & xp.isfinite(scales).all(-1)
        factors = scales / np.array([usual.r_s + usual.r_p, usual.r_p * usual.c_p])
        found = xp.log(xp.where(usable[..., None], factors, 1.0))
        logs = typical + found[..., :1] * level + found[..., 1:] * time
    late = coefficients[..., 3:] / RATE * load.gains.sample_rate
    rest = xp.zeros((*late.shape[:-1], load.gains.exact - load.gains.elements - 1))
    first = xp.concatenate([logs, late, rest], -1)
    others = [typical + np.log(factor) * level for factor in LEVELS]
    delays = np.zeros(load.gains.exact - load.gains.elements)
    others = [xp.zeros_like(first) + xp.concatenate([one, delays]) for one in others]
    return xp.stack([first, *others[::-1]])


def _by_current(
    load: Load, current: Complex[AnyArray, "*row bin"], variance: Float[AnyArray, "*row bin"]
) -> Float[AnyArray, "start *row own"]:
    """Starts of the own parameters from a measured current, one for each time scale, best first.

    The records show Y/I, so the impedance level of each start is known, the delay if the record is
    of whole periods, and which start comes nearest. The means are over ln f, because the lines of
    a spectrum are denser at high frequencies.
    """
    xp, circuit, every = namespace(current), load.gains.circuit, load.knots
    weight, size, turned = _ratio(load, current, variance)
    f = every.at(load.gains.frequency)
    typical, (by_size, by_time) = _typical(circuit), circuit.scaling()
    own = (len(TIME_SCALES), *size.shape[:-1])
    logs = xp.zeros((*own, 1)) + typical
    logs = logs + xp.asarray(np.log(TIME_SCALES)).reshape(-1, *[1] * size.ndim) * by_time
    z = impedance_at(circuit, logs, f)
    size, phase = size - 0.5 * xp.log(power(z)), xp.angle(turned * xp.conj(z))
    level = (weight * size).sum(-1, keepdims=True) / weight.sum(-1, keepdims=True)
    omega = 2 * np.pi * f
    late = -(weight * omega * phase).sum(-1, keepdims=True)
    late = late / (weight * omega**2).sum(-1, keepdims=True)
    if load.transient is not None:  # states turn phases, too
        late = 0.0 * late
    off = (weight * ((size - level) ** 2 + (phase + omega * late) ** 2)).sum(-1)
    delays = xp.zeros((*own, load.gains.exact - load.gains.elements - 1))
    found = [logs + level * by_size, late * load.gains.sample_rate, delays]
    order = xp.argsort(off, axis=0)[..., None]
    return xp.take_along_axis(xp.concatenate(found, -1), order, 0)


def _ratio(
    load: Load, current: Complex[AnyArray, "*row bin"], variance: Float[AnyArray, "*row bin"]
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Weights of the knots, and there the mean ln|Y/I|, and a mean of the same phase as Y/I."""
    xp, records, every = namespace(current), load.records, load.knots
    y, variance_y = records.y[..., 0, :], records.variance_y[..., 0, :]
    sizes = power(y), power(current)
    seen = records.used[..., 0, :] & (sizes[0] > 0) & (sizes[1] > 0)
    sizes = [xp.where(seen, each, 1.0) for each in sizes]
    noise = variance_y / sizes[0] + variance / sizes[1]
    weight = xp.where(seen, 1 / (noise + ROUGH**2), 0.0) / load.gains.frequency
    turned = as_complex(weight / xp.sqrt(sizes[0] * sizes[1])) * y * xp.conj(current)
    turned = xp.where(seen, turned, 0.0)
    log = 0.5 * xp.log(sizes[0] / sizes[1])
    # Z is smooth, the weights are not.
    sums = every.summed(xp.stack([weight, weight * log, turned.real, turned.imag]))
    return sums[0], sums[1] / xp.where(sums[0] > 0, sums[0], 1.0), sums[2] + 1j * sums[3]


def _steiglitz_mcbride(load: Load) -> Float[AnyArray, "*row coefficient"]:
    """b₀, b₁, a₁ [1/RATE] and τ [1/RATE] of the last iterate."""
    records, every = load.records, load.knots
    source = load.gains.source.at(every.index)
    xp, y = namespace(records.x), records.y[..., 0, :]
    used = records.used[..., 0, :]
    xx = power(records.x) - records.variance_x
    yy = power(y) - records.variance_y[..., 0, :]
    xy = xp.conj(records.x) * y
    parts = xp.stack([xx, yy, xy.real, xy.imag], -2)
    sums = every.summed(xp.where(used[..., None, :], parts, 0.0))
    xx, yy, xy = sums[..., 0, :], sums[..., 1, :], sums[..., 2, :] + 1j * sums[..., 3, :]
    omega = 2 * np.pi / RATE * every.at(load.gains.frequency)
    z_th = source.loaded - as_complex(source.resistance)
    square, zz_th = omega**2, power(z_th)
    typical = SkinRC()
    b0, a1 = typical.r_s + typical.r_p, RATE * typical.r_p * typical.c_p
    start = np.stack([b0, typical.r_s * a1, a1, 0.0]) + xp.zeros((*xx.shape[:-1], 4))

    def step(q: Float[AnyArray, "*row coefficient"], _: AnyArray) -> AnyArray:
        angle = omega * q[..., 3:]
        v = xy * (xp.cos(angle) + 1j * xp.sin(angle)) - yy
        d = 1 + 1j * (q[..., 2:3] * omega)
        k = q[..., :1] + 1j * (q[..., 1:2] * omega) + z_th * d
        zv, kv, zk = z_th * v, k * v, xp.conj(z_th) * k
        both = xx - yy - 2 * v.real  # |x − y|²
        terms = [both, zv.real, omega * zv.imag, omega * kv.imag]
        terms += [square * both, -square * zv.real, -square * kv.real]
        terms += [square * yy * zz_th, square * yy * zk.real, square * yy * power(k)]
        terms += [omega * yy * zk.imag]
        weight = 1 / (1 + (omega * q[..., 2:3]) ** 2)
        sums = (xp.stack(terms, -2) @ weight[..., None])[..., 0]
        p0, h0, z0, k0, p2, z1, k1, zz, kz, kk, hk = (sums[..., i] for i in range(11))
        # Schur complements of b₀ and b₁; their right sides are h0 and z0.
        zz, kz, kk = (
            zz - z0**2 / p0 - z1**2 / p2,
            kz - z0 * k0 / p0 - z1 * k1 / p2,
            kk - k0**2 / p0 - k1**2 / p2,
        )
        hz, hk = -z0 * h0 / p0 - z1 * z0 / p2, hk - k0 * h0 / p0 - k1 * z0 / p2
        determinant = zz * kk - kz**2
        a1, change = (kk * hz - kz * hk) / determinant, (zz * hk - kz * hz) / determinant
        b0, b1 = (h0 - z0 * a1 - k0 * change) / p0, (z0 - z1 * a1 - k1 * change) / p2
        return xp.stack([b0, b1, a1, q[..., 3] + change], -1)

    return in_turn(step, start, [np.arange(STEPS)])
