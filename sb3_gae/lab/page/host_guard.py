"""
Which names the page answers to.

A page from elsewhere may make a browser believe that a name of its own is this machine (DNS rebinding), and then read
the dial as if it were its own. The browser still says the name in the header Host, so a foreign one is refused; and so is a
websocket that a page from elsewhere opens, which is in the header Origin.
"""

import ipaddress
import socket
from collections.abc import Collection
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send


class HostGuard:
    """
    :param app: to guard
    :param host: address that it listens at
    :param names: that it answers to besides localhost, addresses and, if it can be reached from elsewhere, this machine's name
    :raises ValueError: if ``host`` is no address
    """

    def __init__(self, app: ASGIApp, host: str, names: Collection[str] = ()):
        self._app = app
        self._is_local = ipaddress.ip_address(host).is_loopback
        self._names = {name.lower() for name in names} | {"localhost"}
        if not self._is_local:
            self._names.add(socket.gethostname().lower())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """
        Pass on what is meant for this page, and refuse the rest.

        :param scope: of the connection, as ASGI has it
        :param receive: to be awaited for the next message
        :param send: takes the messages of the answer
        """
        if scope["type"] in ("http", "websocket"):
            reason = self.complaint(Headers(scope=scope))
            if reason:
                await _refuse(reason, scope, receive, send)
                return
        await self._app(scope, receive, send)

    def complaint(self, headers: Headers) -> str:
        """
        :param headers: of a request
        :return: why it is refused, or nothing
        """
        host = headers.get("host", "")
        if not self._is_ours(host):
            return f"This page does not answer to the host {host[:100]!r}. Start it with --allow-host NAME to allow a name."
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return f"A page from {origin[:100]!r} has no business here."
        return ""

    def _is_ours(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        # No name server has a say in an address
        return address.is_loopback or not self._is_local


async def _refuse(reason: str, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        # Before it is accepted, which the server answers with status 403
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": reason[:100]})
        return
    await PlainTextResponse(reason + "\n", status_code=403)(scope, receive, send)
