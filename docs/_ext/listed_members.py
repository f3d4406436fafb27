"""A warning for each member that the reference lists and autodoc leaves out, which it does without a word."""

import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

_CLASS_WITH_LIST = re.compile(r"^\.\. autoclass:: (\S+)\n   :members: (.+)$", re.MULTILINE)


def check(app: Sphinx, env: BuildEnvironment) -> None:
    """
    :param app: that builds the book
    :param env: with all that has been documented
    """
    documented = env.domains.python_domain.objects
    for name, members in _CLASS_WITH_LIST.findall(Path(app.srcdir, "api.md").read_text()):
        for member in members.split(", "):
            if f"{name}.{member}" not in documented:
                logging.getLogger(__name__).warning("%s.%s is listed and not documented", name, member, location="api")


def setup(app: Sphinx) -> dict[str, bool]:
    """
    :param app: to be listened to
    :return: what Sphinx asks of extensions
    """
    app.connect("env-check-consistency", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
