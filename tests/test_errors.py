"""Messages are one line that no terminal acts on."""

import pytest

from sgwarp.errors import InputError, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain äöü 日本 'x'", "plain äöü 日本 'x'"),
        ("a\nsgwarp: forged", r"a\nsgwarp: forged"),
        ("\x1b[2Jcleared", r"\x1b[2Jcleared"),
        ("\x9b2J", r"\x9b2J"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("\udcff.png", r"\udcff.png"),
        ("tab\there\r", r"tab\there\r"),
    ],
)
def test_what_a_terminal_would_act_on_is_written_out(text, shown):
    assert printable(text) == shown
    assert str(InputError(text)) == shown
