"""What the command line prints as one line, without a traceback."""


class SweepError(ValueError):
    """Something that the user can put right: the message says what and how, in one line."""


class UnreachableError(SweepError):
    """The server of a storage does not answer, which may pass."""
