"""The options in the text of a method, such as `output_error(bounds=(('r_s', 100.0, 2e3),))`."""

import ast
import math
from collections.abc import Mapping
from typing import Any

from etid.printing import quantity


def options_of(method: str) -> tuple[str, dict[str, Any]]:
    """The name of a method and its options.

    Raises:
        ValueError: The text is not that of a method.
    """
    name, _, options = method.partition("(")
    if not options:
        return name, {}
    try:
        call = ast.parse(f"dict({options}", mode="eval").body
        keywords = call.keywords if isinstance(call, ast.Call) else []
        return name, {
            str(one.arg): ast.literal_eval(_Infinite().visit(one.value)) for one in keywords
        }
    except (SyntaxError, RecursionError) as error:
        raise ValueError(f"{method!r} is not the text of a method") from error


class _Infinite(ast.NodeTransformer):
    """Reads `inf`, which is no literal of Python, as a number."""

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """The number for the name `inf`; other names are left."""
        return ast.Constant(math.inf) if node.id == "inf" else node


def fixed(method: str) -> list[str]:
    """Names of the elements that a method holds; empty if it is not the text of one method."""
    try:
        known = options_of(method)[1].get("known_elements", ())
    except ValueError:
        return []
    return [name for name, _, error in known if error == 0]


def without_known(method: str, units: Mapping[str, str]) -> tuple[str, str]:
    """A method without what was told of elements, and a sentence that says it; empty if nothing.

    Args:
        method: Text of a method.
        units: SI units of the elements by name.
    """
    try:
        name, options = options_of(method)
    except ValueError:  # several methods of a batch, or one of a newer etid
        return method, ""
    told = []
    for element, mean, error in options.get("known_elements", ()):
        size = quantity(mean, units.get(element, "1"), error or math.nan)
        told.append(f"{element} = {size.strip()} ({'prior' if error else 'fixed'})")
    for element, low, high in options.get("bounds", ()):
        ends = [(low, "above"), (high, "below")]
        said = [
            f"{word} {quantity(end, units.get(element, '1')).strip()}"
            for end, word in ends
            if 0 < end < math.inf
        ]
        told.append(f"{element} {' and '.join(said)} (bounds)")
    words = "known_elements", "bounds"
    rest = [f"{key}={value!r}" for key, value in options.items() if key not in words]
    plain = f"{name}({', '.join(rest)})" if rest else name
    return plain, f"Told before the fit: {', '.join(told)}." if told else ""
