"""What the command line prints as one line, without a traceback."""

import contextlib
from collections.abc import Iterator


class SweepError(ValueError):
    """Something that the user can put right: the message says what and how, in one line."""


class UnreachableError(SweepError):
    """The server of a storage does not answer, which may pass."""


@contextlib.contextmanager
def checks() -> Iterator[None]:
    """
    A context for the package's checks of arguments, see ``sb3_gae.checks``.

    :raises SweepError: in place of a ``ValueError``, with its message
    """
    try:
        yield
    except ValueError as error:
        raise SweepError(str(error)) from None


def in_one_line(error: BaseException, longest: int | None = 200) -> str:
    """
    :param error: of which one line is to be said
    :param longest: number of characters; None for all
    :return: its message
    """
    return " ".join(str(error).split())[:longest]
