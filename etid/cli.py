"""The command line: `etid COMMAND`.

Exit status: 0 done, 1 something is wrong with the data or no recording could be identified, 2 the
command itself is wrong. What is wrong is one line on stderr, never a traceback.
"""

import argparse
import pathlib
import sys
from collections.abc import Sequence

import jax

import etid
from etid.commands import WRONG_DATA, check, exporting, fit, importing, report, simulate

COMMANDS = {
    "simulate": simulate,
    "import": importing,
    "check": check,
    "fit": fit,
    "report": report,
    "export": exporting,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments; those of the process if not given.

    Returns:
        The exit status.
    """
    parser = _parser()
    arguments = parser.parse_args(argv)
    source = getattr(arguments, "source", None)
    if source is not None and _same_file(source, arguments.target):
        parser.error(f"{arguments.target} would replace the file that is read; name another")
    jax.config.update("jax_enable_x64", True)
    try:
        return arguments.run(arguments)
    except (etid.RecordingError, etid.IdentificationError, ValueError, OSError) as error:
        print(f"etid: error: {' '.join(str(error).split())}", file=sys.stderr)
        return WRONG_DATA


def _same_file(source: pathlib.Path, target: pathlib.Path) -> bool:
    return source.exists() and target.exists() and source.samefile(target)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="etid",
        description="Identify circuits from electro-tactile stimulation recordings.",
        epilog="Exit status: 0 done, 1 something is wrong with the data, 2 wrong usage.",
    )
    parser.add_argument("--version", action="version", version=f"etid {etid.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, module in COMMANDS.items():
        text = (module.__doc__ or "").splitlines()[0]
        summary = text[0].lower() + text[1:].rstrip(".")
        command = commands.add_parser(name, help=summary, description=module.__doc__)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


if __name__ == "__main__":
    sys.exit(main())
