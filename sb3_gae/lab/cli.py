"""Command line of ``python -m sb3_gae.gridworld``."""

import argparse
import importlib.util
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_gae.diagnostics.rollout_file import load_rollout
from sb3_gae.lab.rollout_view import SHIPPED_ROLLOUT, RolloutViewer

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: as typed, None for those of the process
    :return: exit status
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_gae.gridworld", description="Open the λ dial in a browser.")
    parser.add_argument("--host", default=DEFAULT_HOST, help="address to listen at (default: %(default)s, this machine only)")
    parser.add_argument(
        "--port", type=int, default=DEFAULT_PORT, help="port to listen at (default: %(default)s, 0 for a free one)"
    )
    parser.add_argument("--no-browser", action="store_true", help="only serve the page, open nothing")
    parser.add_argument(
        "--allow-host", action="append", default=[], metavar="NAME",
        help="name in the address line that the page answers to, besides localhost and, if others can reach it, its addresses "
        "and this machine's name; may be given several times",
    )  # fmt: skip
    parser.add_argument("--rollout", type=Path, default=SHIPPED_ROLLOUT, help="rollout saved by SaveRolloutCallback")
    options = parser.parse_args(arguments)
    if importlib.util.find_spec("nicegui") is None:
        return _refuse("The page needs NiceGUI: pip install 'sb3-gae[lab]'")
    try:
        viewer = RolloutViewer(load_rollout(options.rollout))
    except (OSError, ValueError) as error:
        return _refuse(f"{options.rollout}: {error}")
    try:
        listening = _listen(options.host, options.port)
    except (OSError, OverflowError) as error:
        return _refuse(
            f"Cannot listen at {options.host}:{options.port}: {error}. Choose another port with --port (0 for a free one)."
        )
    return _run(listening, viewer, options)


def _run(listening: socket.socket, viewer: RolloutViewer, options: argparse.Namespace) -> int:
    from sb3_gae.lab.page.app import serve

    host, port = listening.getsockname()[:2]
    address = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
    who = "only this machine can reach it"
    if not _is_local(host):
        names = ", ".join([socket.gethostname(), *options.allow_host])
        who = f"others on the network may reach it, by any of its addresses or as {names}"
    print(f"The λ dial is at {address}; {who}. Ctrl-C ends it.", flush=True)
    serve(listening, viewer, None if options.no_browser else address, options.allow_host)
    return 0


def _listen(host: str, port: int) -> socket.socket:
    """Bind before anything else starts, so that a port in use is found out at once."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    listening = socket.socket(family, kind, protocol)
    try:
        # Not on Windows, where this would let two servers share a port
        if sys.platform != "win32":
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen()
    except BaseException:
        listening.close()
        raise
    return listening


def _is_local(host: str) -> bool:
    return host == "::1" or host.startswith("127.")


def _refuse(message: str) -> int:
    print(message, file=sys.stderr)
    return 2
