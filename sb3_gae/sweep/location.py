"""Where a storage is, fit to be shown: without its password."""

import sqlalchemy
from sqlalchemy.exc import SQLAlchemyError

from sb3_gae.sweep.errors import SweepError


def is_url(location: str) -> bool:
    """
    :param location: of a storage
    :return: whether it is a database's URL, else a journal's path
    """
    return "://" in location


def parse_url(url: str) -> sqlalchemy.URL:
    """
    :param url: of a database
    :return: its parts
    :raises SweepError: if it is no URL, or its password is not escaped
    """
    try:
        parsed = sqlalchemy.make_url(url)
    except (ValueError, SQLAlchemyError):
        # What is wrong with it is not quoted: it may be a piece of the password
        raise SweepError(
            f"`storage`: the URL {without_password(url)} is not understood; it is DIALECT+DRIVER://USER@HOST:PORT/DATABASE, "
            "where the port is a number."
        ) from None
    if "@" in (parsed.host or ""):
        raise SweepError(
            f"`storage`: the URL {without_password(url)} has two @; inside a user or a password it is written %40."
        )
    return parsed


def is_server(location: str) -> bool:
    """
    :param location: of a storage
    :return: whether it is a database that a server holds, which may be gone for a while
    """
    return is_url(location) and not location.startswith("sqlite")


def without_password(location: str) -> str:
    """
    :param location: URL or path of a storage
    :return: the same, fit to be shown
    """
    if not is_url(location):
        return location
    try:
        url = sqlalchemy.make_url(location)
    except (ValueError, SQLAlchemyError):
        return location.split("://", 1)[0] + "://..."
    if "@" in (url.host or ""):
        # The rest of a password that holds an @
        url = url.set(host="***@" + str(url.host).rpartition("@")[2])
    secret = {name: "***" for name in url.query if "password" in name}
    return url.update_query_dict(secret).render_as_string(hide_password=True)
