"""The one error type that bad input raises; the command line turns it into exit code 2."""

LONGEST = 4000  # characters of a message


class InputError(ValueError):
    """Something a user handed in cannot be used.

    The message names what was wrong (file, field, index) and the remedy, on one line. It may hold names out of files of
    others, so whatever a terminal would act on is written out, and the middle of a long one is left out.
    """

    def __init__(self, message: object = "") -> None:
        text = str(message)
        if len(text) > LONGEST:
            text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 4 :]}"
        super().__init__(printable(text))


def printable(text: str) -> str:
    r"""The text on one line, with control characters, line breaks and direction marks written as \x1b, \n, \u202e."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
