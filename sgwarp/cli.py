"""The command line: `sgwarp COMMAND ...`.

Exit codes: 0 done, 2 bad input or usage (one line on stderr says what), 130 interrupted; outputs are whole or absent.
"""

from __future__ import annotations

import logging
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from sgwarp.errors import InputError
from sgwarp.version import __version__


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; `argv` defaults to that of the process. Returns the exit code.

    Raises:
        SystemExit: After --help, or with code 2 if the arguments do not fit.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    # torch's threads would go on spinning for a while after each operation, on the cores that kernels then wait for.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if argv == ["--version"]:
        print(__version__)
        return 0
    try:
        import tyro
    except ImportError:
        print("sgwarp: the command line needs tyro; run: pip install 'sgwarp[cli]'", file=sys.stderr)
        return 2
    from sgwarp.commands import COMMANDS

    description = f"Open-vocabulary understanding of 3D Gaussian Splatting scenes, version {__version__}."
    command = tyro.extras.subcommand_cli_from_dict(dict(COMMANDS), prog="sgwarp", description=description, args=argv)
    command.command_line = shlex.join(["sgwarp", *argv])
    try:
        with _notices():
            command.run()
    except InputError as error:
        print(f"sgwarp: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("sgwarp: interrupted", file=sys.stderr)
        return 130
    return 0


@contextmanager
def _notices() -> Iterator[None]:
    """Show on stderr what readers log, such as columns or photographs that they left out."""
    logger, handler = logging.getLogger("sgwarp"), logging.StreamHandler()
    handler.setFormatter(logging.Formatter("sgwarp: %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
