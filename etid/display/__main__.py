"""The program `etid-live`, which is also `python -m etid.display`."""

import argparse
import sys

from etid.__main__ import started

PROGRAM = "etid-live"


def main() -> int:
    """Run the program with the arguments of this process.

    Returns:
        Exit status.
    """
    return started(PROGRAM, parser)


def parser() -> argparse.ArgumentParser:
    """Its parser; `etid.cli.run` runs it."""
    from etid.cli import add_command, program

    parser = program(PROGRAM)
    add_command(parser, "etid.display.command")
    parser.set_defaults(command=PROGRAM)
    return parser


if __name__ == "__main__":
    sys.exit(main())
