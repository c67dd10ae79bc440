"""The commands of `etid`, a module each.

A command is a module with `add_arguments(parser)` and `run(arguments)`, which returns the exit
status; the first line of its docstring is its help.
"""

DONE, WRONG_DATA = 0, 1  # argparse exits with 2 by itself
