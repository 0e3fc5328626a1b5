"""The one error type that bad input raises; the command line turns it into exit code 2."""


class InputError(ValueError):
    """Something a user handed in cannot be used.

    The message names what was wrong (file, field, index) and the remedy, on one line. It may hold names out of files of
    others, so whatever a terminal would act on is written out.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(str(message)))


def printable(text: str) -> str:
    r"""The text on one line, with control characters, line breaks and direction marks written as \x1b, \n, \u202e."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
