"""A user's mistake, and the end that a signal asks for."""


class InputError(ValueError):
    """Something the user gave is wrong: the message says what, where (drive, row), and how to mend it.

    Commands print it as one line and exit with code 2.
    """


class Terminated(KeyboardInterrupt):
    """SIGTERM: the command ends as after Ctrl-C, with exit code 143."""
