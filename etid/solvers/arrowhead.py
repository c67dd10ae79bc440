"""Normal equations of many problems that share a few parameters, and their solution.

The `common` parameters enter the terms of every problem. The `own` parameters of a problem enter
only the terms of this problem. JᵀJ is then an arrowhead matrix. Elimination of the own parameters
leaves a matrix S of the size of `common`:

    [ C    B₁ᵀ …  B_Tᵀ ]
    [ B₁   A₁          ]              S = C − Σ_i B_iᵀ A_i⁻¹ B_i.
    [ …       …        ]
    [ B_T          A_T ]

Memory and time are linear in the number of problems. One full matrix would take memory
proportional to its square and time proportional to its cube. All parameters form one vector: the
common parameters, then the own parameters of each problem.
"""

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from etid.solvers.levenberg_marquardt import AbstractNormalEquations


class Arrowhead(lx.AbstractLinearOperator):
    """A symmetric arrowhead matrix."""

    common: Float[Array, "common common"]
    coupling: Float[Array, "problem own common"]
    own: Float[Array, "problem own own"]

    def split(
        self, vector: Float[Array, " parameter"]
    ) -> tuple[Float[Array, " common"], Float[Array, "problem own"]]:
        """The common part of a vector, and the part of each problem."""
        return split(vector, self.coupling.shape[0], self.coupling.shape[1])

    def mv(self, vector: Float[Array, " parameter"]) -> Float[Array, " parameter"]:
        """Product with a vector."""
        common, own = self.split(vector)
        top = self.common @ common + jnp.einsum("ipc,ip->c", self.coupling, own)
        below = jnp.einsum("ipc,c->ip", self.coupling, common)
        return join(top, below + jnp.einsum("ipq,iq->ip", self.own, own))

    def diagonal(self) -> Float[Array, " parameter"]:
        """The diagonal."""
        return join(jnp.diagonal(self.common), jnp.diagonal(self.own, axis1=1, axis2=2))

    def scaled(self, by: Float[Array, " parameter"]) -> "Arrowhead":
        """D⁻¹ M D⁻¹ with the diagonal matrix D of `by`."""
        common, own = self.split(by)
        return Arrowhead(
            self.common / common[:, None] / common[None, :],
            self.coupling / own[:, :, None] / common[None, None, :],
            self.own / own[:, :, None] / own[:, None, :],
        )

    def solve(
        self, vector: Float[Array, " parameter"], damping: Float[Array, ""]
    ) -> Float[Array, " parameter"]:
        """Solve (M + damping · I) z = vector by elimination of the own parameters."""
        right, below = self.split(vector)
        own = self.own + damping * jnp.eye(self.own.shape[-1])[None]
        both = jnp.concatenate([self.coupling, below[:, :, None]], axis=2)
        both = jax.vmap(_solve)(own, both)
        slope, alone = both[:, :, :-1], both[:, :, -1]
        rest = self.common + damping * jnp.eye(self.common.shape[-1])
        rest = rest - jnp.einsum("ipc,ipd->cd", self.coupling, slope)
        right = right - jnp.einsum("ipc,ip->c", self.coupling, alone)
        common = _solve(rest, right[:, None])[:, 0]
        return join(common, alone - jnp.einsum("ipc,c->ip", slope, common))

    def as_matrix(self) -> Float[Array, "parameter parameter"]:
        """The whole matrix."""
        return jax.vmap(self.mv, out_axes=1)(jnp.eye(self.diagonal().size))

    def transpose(self) -> "Arrowhead":
        """Itself: it is symmetric."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and type of a vector."""
        return jax.eval_shape(self.diagonal)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and type of a product."""
        return self.in_structure()


def _solve(
    matrix: Float[Array, "n n"], right: Float[Array, "n column"]
) -> Float[Array, "n column"]:
    """Solve with a positive definite matrix; NaN if the matrix is not positive definite."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)


@lx.is_symmetric.register(Arrowhead)
def _(operator: Arrowhead) -> bool:
    del operator
    return True


def split(
    vector: Float[Array, " parameter"], problems: int, own: int
) -> tuple[Float[Array, " common"], Float[Array, "problem own"]]:
    """The common part of a vector of parameters, and the own part of each problem."""
    common = vector.size - problems * own
    return vector[:common], vector[common:].reshape(problems, own)


def join(
    common: Float[Array, " common"], own: Float[Array, "problem own"]
) -> Float[Array, " parameter"]:
    """One vector of both parts."""
    return jnp.concatenate([common, own.ravel()])


class ArrowheadEquations(AbstractNormalEquations):
    """Normal equations whose JᵀJ is an arrowhead."""

    objective: Float[Array, ""]
    gradient: Float[Array, " parameter"]
    matrix: Arrowhead

    def diagonal(self) -> Float[Array, " parameter"]:
        """Diagonal of JᵀJ."""
        return self.matrix.diagonal()

    def scaled(self, by: Float[Array, " parameter"]) -> "ArrowheadEquations":
        """The normal equations in the parameters z = `by` · y."""
        return ArrowheadEquations(self.objective, self.gradient / by, self.matrix.scaled(by))

    def step(self, damping: Float[Array, ""]) -> Float[Array, " parameter"]:
        """−(JᵀJ + damping · I)⁻¹ Jᵀr."""
        return -self.matrix.solve(self.gradient, damping)

    def hessian(self) -> Arrowhead:
        """JᵀJ as an operator."""
        return self.matrix
