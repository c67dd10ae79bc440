"""The program `etid`, which is also `python -m etid`."""

import argparse
import atexit
import gc
import io
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import NoReturn


def main() -> int:
    """Run the command of this process; see `etid.cli`.

    Returns:
        Exit status.
    """

    def parser() -> argparse.ArgumentParser:
        from etid.cli import parser_for  # `from etid import cli` would import all layers

        return parser_for(sys.argv[1:])

    return started("etid", parser)


def started(program: str, parser: Callable[[], argparse.ArgumentParser]) -> int:
    """Run a program of etid with the arguments of this process.

    The imports take a second. A KeyboardInterrupt during them may be lost, because JAX is called
    by the garbage collector, which ignores exceptions. Nothing has begun yet, so the process ends.

    Args:
        program: Its name.
        parser: Makes its parser, after all imports that it needs.

    Returns:
        Exit status.
    """
    # All memory goes with the process. To search it for garbage first takes a quarter of a second;
    # nothing of this program needs it, but a file that a user's program leaves open may.
    atexit.register(gc.freeze)
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:  # a program in the background ignores the signal

        def end(number: int, frame: FrameType | None) -> NoReturn:
            del number, frame
            os.write(2, f"{program}: interrupted: nothing was changed\n".encode())
            os._exit(_INTERRUPTED)

        signal.signal(signal.SIGINT, end)
    _open_streams()
    commands = parser()
    from etid.cli import run

    try:
        signal.signal(signal.SIGINT, usual)
        return run(commands, sys.argv[1:])
    except KeyboardInterrupt:  # before or after the command itself
        print(f"{program}: interrupted", file=sys.stderr)
        return _INTERRUPTED


def _open_streams() -> None:
    """Let every text be printed: in any encoding, and where the stream is closed, to nowhere."""
    if sys.stderr is None:  # print() would choose stdout
        sys.stderr = open(os.devnull, "w")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


_INTERRUPTED = 128 + signal.SIGINT  # as shells report it


if __name__ == "__main__":
    sys.exit(main())
