"""The command line: `etid COMMAND`.

Exit status: 0 done, 1 something is wrong with the data or no recording could be identified, 2 the
command itself is wrong, 130 Ctrl-C. What is wrong is one line on stderr, never a traceback. With
`--json` a command prints one JSON object on stdout, whether it ends with 0 or 1; its keys
`command`, `status` and, if something is wrong with the data, `error` are the same for all. JSON has
no infinity and no NaN: such numbers are null.
"""

import argparse
import json
import math
import os
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import etid
from etid.commands import (
    INTERRUPTED,
    WRONG_DATA,
    Outcome,
    check,
    exporting,
    fit,
    importing,
    report,
    simulate,
)

COMMANDS = {
    "simulate": simulate,
    "import": importing,
    "check": check,
    "fit": fit,
    "report": report,
    "export": exporting,
}
SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")  # those that shtab writes for


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments; those of the process if not given.

    Returns:
        The exit status.
    """
    jax.config.update("jax_enable_x64", True)
    _keep_programs()
    commands = parser()
    arguments = commands.parse_args(argv)
    source = getattr(arguments, "source", None)
    if source is not None and _same_file(source, arguments.target):
        commands.error(f"{arguments.target} would replace the file that is read; name another")
    try:
        outcome = arguments.run(arguments)
    except (etid.RecordingError, etid.IdentificationError, ValueError, OSError) as error:
        text = " ".join(str(error).split())
        print(f"etid: error: {text}", file=sys.stderr)
        outcome = Outcome(data={"error": text}, status=WRONG_DATA)
    except KeyboardInterrupt:
        print(f"etid: interrupted: {_after_interrupt(arguments)}", file=sys.stderr)
        return INTERRUPTED
    text = outcome.text
    if arguments.json:
        data = {"command": arguments.command, "status": outcome.status, **outcome.data}
        text = json.dumps(_plain(data), ensure_ascii=False, allow_nan=False)
    _print(text)
    return outcome.status


def _after_interrupt(arguments: argparse.Namespace) -> str:
    """What is left of a command, and how to go on: results are written whole or not at all."""
    if arguments.run is fit.run:
        return fit.after_interrupt(arguments)
    target = getattr(arguments, "target", getattr(arguments, "page", None))
    return "nothing was changed" if target is None else f"{target} was not written"


def parser() -> argparse.ArgumentParser:
    """The arguments of all commands, from which their reference and completion are made."""
    parser = argparse.ArgumentParser(
        prog="etid",
        description="Identify circuits from electro-tactile stimulation recordings.",
        epilog="Exit status: 0 done, 1 something is wrong with the data, 2 wrong usage, "
        "130 interrupted.",
    )
    parser.add_argument("--version", action=_Version, help="versions, backend and precision")
    parser.add_argument(
        "--completion",
        action=_Completion,
        choices=SHELLS,
        help="print what completes commands in this shell (etid[completion])",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for name, module in COMMANDS.items():
        text = (module.__doc__ or "").splitlines()[0]
        summary = text[0].lower() + text[1:].rstrip(".")
        command = commands.add_parser(name, help=summary, description=module.__doc__)
        module.add_arguments(command)
        command.add_argument(
            "--json", action="store_true", help="print one JSON object instead of text"
        )
        command.set_defaults(run=module.run)
    return parser


class _Version(argparse.Action):
    """Print what a report of a fault should say, and end."""

    def __init__(self, **options: Any):
        super().__init__(nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        backend, precision = jax.default_backend(), jnp.zeros(()).dtype
        print(f"etid {etid.__version__}, JAX {jax.__version__}, {backend}, {precision}")
        parser.exit()


class _Completion(argparse.Action):
    """Print a shell's completion, and end."""

    def __call__(self, parser: argparse.ArgumentParser, _: Any, shell: Any, *__: Any) -> None:
        try:
            import shtab
        except ImportError:
            parser.error("--completion needs shtab: pip install 'etid[completion]'")
        _complete_paths(parser, shtab.FILE)
        print(shtab.complete(parser, shell))
        parser.exit()


def _complete_paths(parser: argparse.ArgumentParser, how: Any) -> None:
    """Have every argument that is a path completed as one, in subcommands too."""
    for action in parser._actions:
        if action.type is pathlib.Path:
            vars(action)["complete"] = how  # where shtab looks for it
        elif isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_paths(command, how)


def _print(text: str) -> None:
    """Print, if there is something; a reader that has gone, such as `head`, is no error."""
    try:
        if text:
            print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes


def _keep_programs() -> None:
    """Have JAX keep what it compiles, so that only the first fit of all waits for it.

    Where the user has named a folder (`JAX_COMPILATION_CACHE_DIR`) there, else in the one that
    programs of this user have for such things.
    """
    config: Any = jax.config  # its attributes come into being at run time
    if config.jax_compilation_cache_dir is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    folder = pathlib.Path(home, "etid")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return  # compiled anew each time
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _same_file(source: pathlib.Path, target: pathlib.Path) -> bool:
    return source.exists() and target.exists() and source.samefile(target)


def _plain(value: Any) -> Any:
    """What JSON can hold of a value."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, pathlib.Path) else value


if __name__ == "__main__":
    sys.exit(main())
