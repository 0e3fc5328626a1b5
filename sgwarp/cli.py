"""The command line: `sgwarp COMMAND ...`.

Exit codes: 0 done, 1 some of many scenes failed, 2 bad input or usage (one line on stderr says what), 130 interrupted;
outputs are whole or absent.
"""

from __future__ import annotations

import io
import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from sgwarp.errors import InputError, printable
from sgwarp.runs.interrupt import termination_as_interrupt, was_terminated
from sgwarp.version import __version__

OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")  # in messages of torch


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; `argv` defaults to that of the process. Returns the exit code.

    Raises:
        SystemExit: After --help, or with code 2 if the arguments do not fit.
    """
    _open_closed_streams()
    _write_any_text()
    try:
        with termination_as_interrupt():
            code = _run(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except SystemExit:
        _flush_quietly()
        raise
    except InputError as error:
        return _fail(str(error), 2)
    except KeyboardInterrupt:
        return _fail("terminated", 143) if was_terminated() else _fail("interrupted", 130)
    except BrokenPipeError:  # nobody reads any more: `sgwarp encoders | head -1`
        _close_stdout()
        return 141
    except OSError as error:
        _close_stdout()
        what = f"{error.filename}: " if error.filename else "output "
        return _fail(f"{what}cannot be read or written ({error.strerror or error})", 2)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not any(text in str(error) for text in OUT_OF_MEMORY):
            raise
        line = (str(error).strip().splitlines() or ["MemoryError"])[0]
        return _fail(f"there is not enough memory ({line}); use fewer views, pixels or channels", 2)
    return code


def _run(argv: list[str]) -> int:
    # torch's threads would go on spinning for a while after each operation, on the cores that kernels then wait for.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if argv == ["--version"]:
        print(__version__)
        return 0
    try:
        import tyro
    except ImportError:
        return _fail("the command line needs tyro; run: pip install 'sgwarp[cli]'", 2)
    from sgwarp.commands import COMMANDS
    from sgwarp.commands.effects import say_without_effect
    from sgwarp.commands.inputs_kept import guarded

    description = f"Open-vocabulary understanding of 3D Gaussian Splatting scenes, version {__version__}."
    command = tyro.extras.subcommand_cli_from_dict(dict(COMMANDS), prog="sgwarp", description=description, args=argv)
    _refuse_second_lists(command, argv)
    command.command_line = shlex.join(["sgwarp", *argv])
    with _notices():
        try:
            with guarded(command):
                say_without_effect(command)
                code = command.run()
        except InputError as error:
            raise InputError(_as_option(str(error), vars(command))) from error
    return code or 0


def _refuse_second_lists(command: Any, argv: list[str]) -> None:
    """Refuse an option with a list of values that is given twice: only the values after the last one would count.

    Raises:
        InputError: There is one.
    """
    given = [word.partition("=")[0].replace("_", "-") for word in argv if word.startswith("--")]
    for one in fields(command):
        option = f"--{one.name.replace('_', '-')}"
        if "..." in str(one.type) and given.count(option) > 1:
            raise InputError(f"{option}: is given {given.count(option)} times; write all values after one {option}")


def _as_option(message: str, given: dict[str, Any]) -> str:
    """The message with the argument that it begins with as the option that was given; names of files stay."""
    name = message.partition(":")[0]
    paths = [str(value) for value in given.values() if isinstance(value, Path)]
    if name not in given or isinstance(given[name], Path) or name in paths:
        return message
    return f"--{name.replace('_', '-')}{message[len(name) :]}"


def _fail(message: str, code: int) -> int:
    with suppress(OSError):
        print(f"sgwarp: {printable(message)}", file=sys.stderr, flush=True)
    return code


def _open_closed_streams() -> None:
    """`sgwarp ... >&-`: the next file that is opened would get the number of the closed stream, and its output."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            stream = open(number, "w" if number else "r", encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)


def _write_any_text() -> None:
    """Characters that the terminal's encoding lacks are written as escapes, instead of ending the run."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _flush_quietly() -> None:
    try:
        sys.stdout.flush()
    except OSError:
        _close_stdout()


def _close_stdout() -> None:
    """Send what is still buffered nowhere; the interpreter would try to write it when it ends."""
    with suppress(OSError, ValueError):
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, sys.stdout.fileno())
        os.close(sink)


class _Plain(logging.Formatter):
    """Names of files in a notice come from others, as those in an error do."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


@contextmanager
def _notices() -> Iterator[None]:
    """Show on stderr what readers log, such as columns or photographs that they left out."""
    logger, handler = logging.getLogger("sgwarp"), logging.StreamHandler()
    handler.setFormatter(_Plain("sgwarp: %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
