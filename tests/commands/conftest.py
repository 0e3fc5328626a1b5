"""A command that runs up to the call of what does its work."""

from types import SimpleNamespace

import pytest

from sgwarp.cli import main
from sgwarp.errors import InputError


@pytest.fixture
def stopped(monkeypatch, capsys):
    """`stopped(target, *arguments)` runs a command up to the call of `target`; its arguments, and its keywords."""

    def called(target: str, *arguments):
        seen = []

        def stop(*positional, **keywords):
            seen.append((positional, keywords))
            raise InputError("stopped here")

        with monkeypatch.context() as patch:
            patch.setattr(target, stop)
            assert main([str(argument) for argument in arguments]) == 2
        assert capsys.readouterr().err.strip().splitlines()[-1] == "sgwarp: stopped here"
        (call,) = seen
        return SimpleNamespace(positional=call[0], **call[1])

    return called
