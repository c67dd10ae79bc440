"""The check that JAX runs in float64: importing etid never changes this global setting."""

import jax


def require_float64() -> None:
    """Raise unless JAX runs in float64.

    Raises:
        RuntimeError: JAX runs in float32. The filters would lose 4 to 9 digits without a warning.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "etid needs float64, and JAX is running in float32. Before making JAX arrays, call\n"
            '    jax.config.update("jax_enable_x64", True)\n'
            "or set the environment variable JAX_ENABLE_X64=1."
        )
