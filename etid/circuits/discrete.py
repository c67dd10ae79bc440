"""Discrete-time filters as objects: the paper's driver (eq. 4) and skin (eq. 7) are two of them.

Whoever gives arrays of JAX, or lets JAX trace, gets arrays of JAX and derivatives by coefficients,
input and state. Arrays of NumPy are not traced, and nothing is compiled.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.impedance import divider
from etid.circuits.lookup import circuit
from etid.precision import Module, array_function, in_float64, is_traced, namespace, unmasked
from etid.printing import Overview, Overviewed, rounded, significant
from etid.signals.filtering import StateSpace, companion, simulate
from etid.signals.transfer import AnyArray, as_complex, delay_variable


@runtime_checkable
class _HasStates(Protocol):
    """An impedance in continuous time."""

    def state_space(self) -> StateSpace: ...


class Filter(Overviewed, Module):
    """A discrete-time filter with one input and one output.

        x[n+1] = A x[n] + B u[n],      y[n] = C x[n] + D u[n]

    `Filter.of` makes one from the coefficients of `scipy.signal.lfilter`, and `Filter.bilinear`
    from a circuit. An impedance is a filter from current [A] to voltage [V].

    Attributes:
        A: State matrix.
        B: Input vector.
        C: Output vector.
        D: What passes at once.
        sample_rate: Samples per second [Hz]; with the default 1, frequencies are in cycles a
            sample.
    """

    A: Float[AnyArray, "state state"]
    B: Float[AnyArray, " state"]
    C: Float[AnyArray, " state"]
    D: Float[AnyArray, ""]
    sample_rate: float | Float[AnyArray, ""] = 1.0

    @classmethod
    @in_float64
    def of(
        cls,
        b: Float[AnyArray, " b"],
        a: Float[AnyArray, " a"],
        sample_rate: float | Float[AnyArray, ""] = 1.0,
    ) -> "Filter":
        """The filter (b₀ + b₁ z⁻¹ + …) / (a₀ + a₁ z⁻¹ + …), a₀ ≠ 0.

        Its state is that of SciPy's `zi` (transposed direct form II). The discrete Z_th of a driver
        by the paper's method is `Filter.of(driver.b, driver.a, driver.sample_rate)`.

        Args:
            b: Numerator, in powers of z⁻¹.
            a: Denominator.
            sample_rate: Samples per second [Hz].

        Raises:
            ValueError: a₀ is 0.
        """
        xp = namespace(b, a)
        b, a = xp.asarray(b, float), xp.asarray(a, float)
        if xp is np and a[0] == 0:
            raise ValueError("a[0] is 0; the output at a sample would need later ones")
        return cls._of(companion(b, a), sample_rate)

    @classmethod
    @in_float64
    @array_function
    def bilinear(
        cls,
        impedance: "AbstractCircuit | _HasStates | str",
        sample_rate: float | Float[AnyArray, ""],
        samples: int = 10_000,
    ) -> "Filter":
        """An impedance under the bilinear map s = 2 f_s (z − 1)/(z + 1) (eqs. 7, 10).

        The map warps frequencies: C_p of dry skin that is fitted through it at 200 kHz is 9 % off.
        `etid.predict` has no such error.

        Args:
            impedance: A circuit or a circuit string, or the Z_th of a driver by maximum likelihood,
                `driver.source`.
            sample_rate: Samples per second [Hz].
            samples: Length of the records, for ladders that stand for constant phases.

        Raises:
            ValueError: The impedance grows without bound, or its response in time is not known.
        """
        if isinstance(impedance, str):
            impedance = circuit(impedance)
        if isinstance(impedance, AbstractCircuit):
            of = impedance.impedance().state_space(sample_rate, samples)
        else:
            of = impedance.state_space()
        xp, step = namespace(of.A, of.B, of.C, of.D, sample_rate), 0.5 / sample_rate
        one, half = xp.eye(of.C.shape[0]), of.A * step
        left = xp.linalg.inv(one - half)
        b = left @ of.B / sample_rate
        direct = of.D + 0.5 * of.C @ b
        return cls._of(StateSpace(left @ (one + half), b, of.C @ left, direct), sample_rate)

    @classmethod
    def _of(cls, of: StateSpace, sample_rate: float | Float[AnyArray, ""]) -> "Filter":
        return cls(of.A, of.B[:, 0], of.C, of.D[0], sample_rate)

    @property
    def _states(self) -> StateSpace:
        return StateSpace(self.A, self.B[:, None], self.C, namespace(self.D).asarray(self.D)[None])

    @property
    def b(self) -> Float[AnyArray, " order1"]:
        """Numerator in powers of z⁻¹, for a₀ = 1."""
        return self._polynomials()[0]

    @property
    def a(self) -> Float[AnyArray, " order1"]:
        """Denominator in powers of z⁻¹; its first coefficient is 1."""
        return self._polynomials()[1]

    def _overview(self) -> Overview:
        b, a = self._polynomials()
        size = np.sort(np.abs(np.linalg.eigvals(self.A)))[::-1]
        rows = [
            (name, "  ".join(significant(float(value), 6) for value in of))
            for name, of in (("b", b), ("a", a), ("size of the poles", size))
        ]
        rate = float(self.sample_rate)
        at = "" if rate == 1 else f" at {rounded(rate / 1e3, 6)} kHz"
        stable = "" if (size < 1).all() else ", not stable"
        return Overview(f"Filter of order {len(size)}{at}{stable}", rows)

    @in_float64
    @array_function
    def _polynomials(self) -> tuple[Float[AnyArray, " order1"], Float[AnyArray, " order1"]]:
        """B and A by the recursion of Faddeev and LeVerrier, which has derivatives.

        det(z − A) = Σ a_k z^(n−k) and adj(z − A) = Σ M_k z^(n−1−k), with M_0 = 1 and

            a_k = −tr(A M_{k−1}) / k,      M_k = A M_{k−1} + a_k.
        """
        xp, order = namespace(self.A, self.B, self.C, self.D), self.C.shape[0]
        one = xp.eye(order, dtype=self.A.dtype)
        matrix, b, a = one, [self.D], [xp.ones_like(self.D)]
        for k in range(1, order + 1):
            product = self.A @ matrix
            a.append(-xp.trace(product) / k)
            b.append(self.D * a[-1] + self.C @ matrix @ self.B)
            matrix = product + a[-1] * one
        return xp.stack(b), xp.stack(a)

    @in_float64
    @array_function
    def response(self, frequency: Float[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Frequency response C (z − A)⁻¹ B + D at z = e^(j2πf/f_s).

        Args:
            frequency: Real frequencies [Hz].

        Returns:
            The gain at each.
        """
        xp = namespace(self.A, self.B, self.C, self.D, self.sample_rate, frequency)
        early = as_complex(delay_variable(xp.asarray(frequency, float), self.sample_rate))
        if self.C.shape[0] == 0:
            return self.D * xp.ones_like(early)
        # z⁻¹ is of size 1, as A is: no number is large or small.
        one, early = xp.eye(self.C.shape[0]), early[..., None, None]
        states = xp.linalg.solve(one - early * self.A, early * self.B[:, None])
        return (self.C * states[..., 0]).sum(-1) + self.D

    @in_float64
    @array_function
    def simulate(
        self,
        u: Float[AnyArray, "*input_row time"],
        x0: Float[AnyArray, "*state_row state"] | None = None,
    ) -> tuple[Float[AnyArray, "*row time"], Float[AnyArray, "*row state"]]:
        """Output, and the state after the last sample, as `scipy.signal.lfilter` with `zi`.

        Args:
            u: Input; leading axes are records of their own.
            x0: State before the first sample; 0 if not given.

        Returns:
            The output, of the shape of `u`, and the last state.
        """
        xp = namespace(self.A, self.B, self.C, self.D, u, x0 if x0 is not None else 0.0)
        u = xp.asarray(unmasked(u), float)
        states = self.C.shape[0]
        if states == 0:
            return self.D * u, xp.zeros((*u.shape[:-1], 0))
        x0 = xp.zeros(states) if x0 is None else xp.asarray(x0, float)
        return simulate(self._states, u[..., None], x0)

    @in_float64
    @array_function
    def divider(self, source: "Filter") -> "Filter":
        """The filter from V_th to V_out = V_th · Z / (Z + Z_th), if this impedance is a load Z.

        Nothing is a ratio of polynomials, so that no digits are lost.

        Args:
            source: Source impedance Z_th, at the same sample rate.

        Raises:
            ValueError: The sample rates differ.
        """
        rates = self.sample_rate, source.sample_rate
        if not is_traced(rates) and float(rates[0]) != float(rates[1]):
            raise ValueError(
                f"the load has a sample rate of {float(rates[0]):g} Hz and the source of "
                f"{float(rates[1]):g} Hz; make both filters for one rate"
            )
        return Filter._of(divider(source._states, self._states), self.sample_rate)
