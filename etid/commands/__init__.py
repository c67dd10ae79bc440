"""The commands of `etid`, one module per command.

The module of a command has the functions `add_arguments(parser)` and `run(arguments)`. `run`
returns an `Outcome` and prints nothing on stdout. A command that writes files also has the function
`outputs(arguments)`, which returns each with the endings that its name may have; the files are
checked before the work begins. The docstring of the module is the help of the command.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

DONE, WRONG_DATA = 0, 1  # argparse itself exits with 2
INTERRUPTED = 130  # as shells report a command that Ctrl-C ended: 128 + SIGINT


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a command.

    Attributes:
        text: Text for people; if it is empty, nothing is printed.
        data: Data for scripts, printed with `--json`: names, numbers in SI units, lists, mappings.
        status: Exit status, `DONE` or `WRONG_DATA`.
    """

    text: str = ""
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    status: int = DONE
