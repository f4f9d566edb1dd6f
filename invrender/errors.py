"""The one exception that a user's input can cause."""


class InputError(ValueError):
    """Bad input. The message is one sentence: what is wrong and what to do about it.

    The command line prints it and exits with code 2.
    """
