"""The commands of `etid`, a module each.

A command is a module with `add_arguments(parser)` and `run(arguments)`, which returns an `Outcome`
and prints nothing on stdout; the first line of its docstring is its help.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

DONE, WRONG_DATA = 0, 1  # argparse exits with 2 by itself
INTERRUPTED = 130  # what shells give a command that Ctrl-C has ended: 128 + SIGINT


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a command came to.

    Attributes:
        text: For people; nothing is printed if it is empty.
        data: For scripts, what `--json` prints: names, numbers in SI units, lists, mappings.
        status: Exit status, `DONE` or `WRONG_DATA`.
    """

    text: str = ""
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    status: int = DONE
