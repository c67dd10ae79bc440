"""What the functions of arrays share: the axis of outputs."""

from collections.abc import Sequence

from jaxtyping import Inexact

from etid.precision import namespace
from etid.signals.transfer import AnyArray


def along_outputs(
    each: Sequence[Inexact[AnyArray, "*row bin"]],
) -> Inexact[AnyArray, "*row output bin"]:
    """Values of each output along an axis of outputs; without a copy if there is one output."""
    return each[0][..., None, :] if len(each) == 1 else namespace(each[0]).stack(each, -2)
