"""The command line: `etid COMMAND`.

Exit status:

- 0: done.
- 1: the data are faulty, or no recording could be identified.
- 2: the command itself is wrong.
- 130: Ctrl-C.

An error is one line on stderr, never a traceback. With `--json` a command prints one JSON object on
stdout, for status 0 and 1. Every object has the keys `command` and `status`, and `error` if the
whole file is faulty. JSON has no infinity and no NaN: such a number is null.
"""

import argparse
import contextlib
import importlib
import importlib.metadata
import json
import logging
import math
import os
import pathlib
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import etid
from etid.commands import DONE, INTERRUPTED, WRONG_DATA, Outcome

# Names of the commands, their modules and what they do. The modules import JAX, which takes most of
# a second: only that of the command which is asked for is imported.
COMMANDS = {
    "import": ("importing", "convert laboratory files, or a folder of them, to an etid file"),
    "calibrate": ("calibrate", "identify a driver, and say what it is worth"),
    "check": ("check", "list the faults of a file of recordings, field by field"),
    "fit": ("fit", "identify the drivers and the loads of a file of recordings"),
    "report": ("report", "write a report about a file of fits: one HTML page"),
    "export": ("exporting", "convert fits into files for other programs"),
    "merge": (
        "merging",
        "write the recordings of several files into one file, each in a group of its own",
    ),
    "simulate": ("simulate", "simulate recordings of an experiment"),
}
SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")  # the shells that shtab supports


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments; default: the arguments of the process.

    Returns:
        Exit status.
    """
    words = sys.argv[1:] if argv is None else argv
    return run(parser_for(words), words)


def parser_for(words: Sequence[str]) -> argparse.ArgumentParser:
    """Parser of these arguments, after all imports and settings that their command needs."""
    if "--completion" in " ".join(words):
        return parser()
    command = next((word for word in words if not word.startswith("-")), "")
    return parser([command] if command in COMMANDS else [])


def run(commands: argparse.ArgumentParser, words: Sequence[str]) -> int:
    """Run one command.

    Args:
        commands: `parser_for(words)`.
        words: Arguments.

    Returns:
        Exit status.
    """
    arguments = commands.parse_args(words)
    from etid.recordings.errors import RecordingError, in_one_line
    from etid.results.fit import IdentificationError

    try:
        _check_names(_files(arguments))
        if "force" in arguments:
            outputs = arguments.module.outputs(arguments)
            for path in _named_twice(_files(arguments), outputs):
                commands.error(f"{path} is already a file of this command; name another to write")
            _check_outputs(outputs, force=arguments.force)
        with _logged() if arguments.verbose else contextlib.nullcontext():
            outcome = arguments.module.run(arguments)
    except (RecordingError, IdentificationError, ValueError, OSError) as error:
        text = in_one_line(error)
        print(f"{commands.prog}: error: {text}", file=sys.stderr)
        outcome = Outcome(data={"error": text}, status=WRONG_DATA)
    except KeyboardInterrupt as error:
        text = in_one_line(error) or _after_interrupt(arguments)
        print(f"{commands.prog}: interrupted: {text}", file=sys.stderr)
        return INTERRUPTED
    text = outcome.text
    if arguments.json:
        data = {"command": arguments.command, "status": outcome.status, **outcome.data}
        text = json.dumps(_plain(data), ensure_ascii=False, allow_nan=False)
    return max(outcome.status, _print(text, commands.prog))


def _files(arguments: argparse.Namespace) -> list[pathlib.Path]:
    """All files that the arguments name, to read or to write."""
    values = (one if isinstance(one, list) else [one] for one in vars(arguments).values())
    return [path for paths in values for path in paths if isinstance(path, pathlib.Path)]


def _check_names(files: Iterable[pathlib.Path]) -> None:
    """Raise an error if a name cannot be written into a file or a message."""
    for path in files:
        try:
            str(path).encode()
        except UnicodeEncodeError:
            raise ValueError(f"{str(path)!r}: this name is not UTF-8; rename the file") from None


def _named_twice(
    files: Sequence[pathlib.Path], outputs: Iterable[pathlib.Path]
) -> Iterator[pathlib.Path]:
    """Files to write that the command also reads, or writes as another one."""
    for path in outputs:
        # A command may write a file that no argument names, such as the page beside the fits.
        others = [one for one in files if one is not path]
        if any(_same(path, one) for one in others):
            yield path


def _same(one: pathlib.Path, other: pathlib.Path) -> bool:
    """Whether two paths lead to one file, which need not exist."""
    try:
        return one.samefile(other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def _check_outputs(outputs: Mapping[pathlib.Path, tuple[str, ...]], *, force: bool) -> None:
    """Raise an error if a file cannot be written, or would be overwritten.

    Args:
        outputs: The endings that the name of each file may have. A name without the ending of a
            known format is always right.
        force: Whether existing files may be replaced.
    """
    from etid.recordings.replacing import check_ending, unwritable

    for path, endings in outputs.items():
        try:
            _check_place(path)
            exists = path.exists()
        except OSError as error:  # of a folder that the user may not enter, or a name too long
            raise unwritable(path, error) from error
        check_ending(path, endings)
        if exists and not force:
            raise ValueError(f"{path}: this file exists; add --force to replace it")


def _check_place(path: pathlib.Path) -> None:
    """Raise an error if a file cannot be at a path."""
    if path.is_dir():
        raise ValueError(f"{path}: this is a folder; name a file")
    if path.exists() and not path.is_file():  # it would be replaced
        raise ValueError(f"{path}: this is a device or a pipe; name a file")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"{path}: the folder of this file does not exist")


@contextlib.contextmanager
def _logged() -> Iterator[None]:
    """Show what the logger `etid` says, on stderr."""
    logger, handler = logging.getLogger("etid"), logging.StreamHandler()
    before = logger.level
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _after_interrupt(arguments: argparse.Namespace) -> str:
    """Message after Ctrl-C; a result is written completely or not at all."""
    if hasattr(arguments.module, "after_interrupt"):
        return arguments.module.after_interrupt(arguments)
    target = getattr(arguments, "target", getattr(arguments, "page", None))
    return "nothing was changed" if target is None else f"{target} was not written"


def parser(wanted: Iterable[str] = COMMANDS) -> argparse.ArgumentParser:
    """Parser of all commands; the reference in the docs and the shell completion also use it.

    Args:
        wanted: Commands whose arguments it knows; of the others it knows the names only.
    """
    parser = program("etid", "Identify circuits from electro-tactile stimulation recordings.")
    parser.epilog = f"{parser.epilog} The program etid-live shows a running display."
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for name, (module_name, summary) in COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        if name in wanted:
            add_command(command, f"etid.commands.{module_name}")
    return parser


def program(name: str, description: str = "") -> argparse.ArgumentParser:
    """Parser of a program, with the options that all have."""
    parser = argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog="Exit status: 0 done, 1 faulty data, 2 wrong usage, 130 interrupted.",
    )
    parser.add_argument(
        "--verbose", action="store_true", help="say on stderr what is done to each recording"
    )
    parser.add_argument("--version", action=_Version, help="print versions")
    parser.add_argument(
        "--completion",
        action=_Completion,
        choices=SHELLS,
        help="print the completion script of this shell (etid[completion])",
    )
    return parser


def add_command(parser: argparse.ArgumentParser, name: str) -> None:
    """Give a parser the arguments of a module of a command, and set up the process for it."""
    import jax

    jax.config.update("jax_enable_x64", True)
    _keep_programs(jax.config)
    module = importlib.import_module(name)
    parser.description = module.__doc__
    module.add_arguments(parser)
    if hasattr(module, "outputs"):
        parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    parser.set_defaults(module=module)


class _Version(argparse.Action):
    """Print the versions for a bug report, and exit."""

    def __init__(self, **options: Any) -> None:
        super().__init__(nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        of = importlib.metadata.version  # it searches folders, so not at every start
        versions = f"etid {etid.__version__}, JAX {of('jax')}, NumPy {np.__version__}"
        versions = f"{versions}, Python {platform.python_version()}, {platform.machine()}"
        parser.exit(_print(versions, parser.prog))


class _Completion(argparse.Action):
    """Print the completion script of a shell, and exit."""

    def __call__(self, parser: argparse.ArgumentParser, _: Any, shell: Any, *__: Any) -> None:
        try:
            import shtab
        except ImportError:
            from etid.recordings.errors import install

            parser.error(f"--completion needs shtab: {install('completion')}")
        _complete_paths(parser, shtab.FILE)
        parser.exit(_print(shtab.complete(parser, shell), parser.prog))


def _complete_paths(parser: argparse.ArgumentParser, how: Any) -> None:
    """Declare every argument of type Path as a path for shtab, also in subcommands."""
    for action in parser._actions:
        if action.type is pathlib.Path:
            vars(action)["complete"] = how  # shtab reads this attribute
        elif isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_paths(command, how)


def _print(text: str, program: str) -> int:
    """Print a text unless it is empty; a closed pipe, as after `| head`, is no error.

    Args:
        text: The text.
        program: Name of the program, for the message that it cannot be written.

    Returns:
        Exit status.
    """
    try:
        if text:
            print(text, flush=True)
    except OSError as error:
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # Python flushes stdout at exit
        if not isinstance(error, BrokenPipeError):
            print(f"{program}: error: the output cannot be written ({error})", file=sys.stderr)
            return WRONG_DATA
    return DONE


def _keep_programs(config: Any) -> None:
    """Let JAX keep compiled programs on disk, so that only the first fit waits for compilation.

    The folder is `JAX_COMPILATION_CACHE_DIR` if the user has set it, else `etid` in the user's
    cache folder.
    """
    if config.jax_compilation_cache_dir is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    folder = pathlib.Path(home, "etid")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return  # without a folder, each process compiles again
    if os.access(folder, os.W_OK):
        config.update("jax_compilation_cache_dir", str(folder))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _plain(value: Any) -> Any:
    """A value in types that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "__array__"):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, pathlib.Path) else value
