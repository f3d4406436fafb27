"""Which hosts the page answers to."""

import http.client
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

host_guard = pytest.importorskip("sb3_gae.lab.page.host_guard", reason="NiceGUI is needed: pip install -e '.[lab]'")
HostGuard, Headers = host_guard.HostGuard, host_guard.Headers
UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip


def complaint(bound: str, host: str, origin: str | None = None, names: tuple[str, ...] = ()) -> str:
    headers = {"host": host} if origin is None else {"host": host, "origin": origin}
    return HostGuard(None, bound, names).complaint(Headers(headers))


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost", "LOCALHOST:1", "127.0.0.2", "[::1]:8080"])
@pytest.mark.parametrize("bound", ["127.0.0.1", "::1", "0.0.0.0"])
def test_this_machine_is_answered(bound: str, host: str) -> None:
    assert complaint(bound, host) == ""


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8080", "localhost.evil.example", "127.0.0.1.evil.example", "10.0.0.1", "", "[::1", "a b"],
)
def test_a_foreign_host_is_refused_where_only_this_machine_is_served(host: str) -> None:
    assert "does not answer to the host" in complaint("127.0.0.1", host)


def test_elsewhere_addresses_and_known_names_are_answered() -> None:
    for host in ("10.0.0.1:8080", "[fe80::1]", f"{socket.gethostname()}:8080", "lab.example"):
        assert complaint("0.0.0.0", host, names=("Lab.example",)) == ""
    assert "--allow-host" in complaint("0.0.0.0", "evil.example", names=("lab.example",))


def test_a_page_from_elsewhere_is_refused() -> None:
    assert complaint("127.0.0.1", "localhost:8080", "http://localhost:8080") == ""
    for origin in ("http://evil.example", "http://localhost:9090", "null"):
        assert "no business" in complaint("127.0.0.1", "localhost:8080", origin)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    command = [sys.executable, "-m", "sb3_gae.gridworld", "--port", "0", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent) as server:
        assert server.stdout is not None
        found = re.search(r":(\d+)/", server.stdout.readline())
        assert found is not None
        yield int(found[1])
        server.kill()


def answer(port: int, path: str, headers: dict[str, str]) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    # A websocket that is accepted has no end
    body = "" if response.status == 101 else response.read().decode()
    connection.close()
    return response.status, body


def test_the_server_refuses_foreign_hosts(port: int) -> None:
    assert answer(port, "/", {"Host": f"localhost:{port}"})[0] == 200
    status, body = answer(port, "/", {"Host": f"evil.example:{port}"})
    assert status == 403 and "does not answer to the host 'evil.example" in body


def test_the_server_refuses_foreign_websockets(port: int) -> None:
    path = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    own = f"127.0.0.1:{port}"
    assert answer(port, path, {"Host": own, "Origin": f"http://{own}", **UPGRADE})[0] == 101
    assert answer(port, path, {"Host": own, "Origin": "http://evil.example", **UPGRADE})[0] == 403
    assert answer(port, path, {"Host": f"evil.example:{port}", **UPGRADE})[0] == 403
