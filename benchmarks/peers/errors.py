"""What goes wrong through nobody's fault but the command's."""


class PeersError(Exception):
    """One line that says what to do."""
