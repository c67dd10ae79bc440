"""etid computes in float64, and says so instead of switching a global on import."""

import jax


def require_float64() -> None:
    """Raise unless JAX runs in float64.

    Raises:
        RuntimeError: JAX would silently compute in float32, in which the filters lose 4 to 9
            digits.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "etid needs float64, and JAX is running in float32. Before making JAX arrays, call\n"
            '    jax.config.update("jax_enable_x64", True)\n'
            "or set the environment variable JAX_ENABLE_X64=1."
        )
