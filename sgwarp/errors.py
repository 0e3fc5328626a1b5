"""The one error type that bad input raises; the command line turns it into exit code 2."""


class InputError(ValueError):
    """Something a user handed in cannot be used.

    The message names what was wrong (file, field, index) and the remedy, on one line.
    """
