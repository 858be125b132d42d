"""The one exception for a user's mistake."""


class InputError(ValueError):
    """Something the user gave is wrong: the message says what, where (drive, row), and how to mend it.

    Commands print it as one line and exit with code 2.
    """
