"""The HTTP server: what it answers, and clients that are slow, greedy or wrong."""

import contextlib
import socket
import threading
import urllib.error
import urllib.request
from http import HTTPStatus

import pytest

from neurove_service.guard import Guard
from neurove_service.metrics.http import MAX_CONNECTIONS, MAX_REQUEST_BYTES, AddressError, HttpServer, Response

LARGE = b"x" * (16 << 20)
entered, go_on = threading.Event(), threading.Event()


def respond(path):
    if path == "/slow":
        entered.set()
        assert go_on.wait(60)
    if path == "/broken":
        raise ZeroDivisionError
    return {"/live": Response(b"live\n"), "/large": Response(LARGE), "/slow": Response(LARGE)}.get(path)


@pytest.fixture
def guard():
    return Guard()


@pytest.fixture
def server(guard):
    server = HttpServer("127.0.0.1", 0, respond, guard, deadline_s=120)
    yield server
    server.close()


def port_of(server):
    return int(server.url.rpartition(":")[2])


def raw(server, request):
    """The whole answer to these bytes."""
    with socket.create_connection(("127.0.0.1", port_of(server)), timeout=60) as client:
        client.sendall(request)
        parts = []
        with contextlib.suppress(ConnectionResetError):  # an answer before the request was read
            while part := client.recv(65536):
                parts.append(part)
        return b"".join(parts)


def get(server, path="/live"):
    with urllib.request.urlopen(server.url + path, timeout=60) as answer:
        return answer.status, answer.read()


def test_a_known_path_is_answered_with_its_length_and_type(server):
    answer = raw(server, b"GET /live?x=1 HTTP/1.1\r\nHost: a\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200 OK\r\n")
    assert b"Content-Length: 5\r\n" in answer
    assert answer.endswith(b"\r\n\r\nlive\n")
    assert raw(server, b"HEAD /live HTTP/1.0\r\n\r\n").endswith(b"\r\n\r\n")


@pytest.mark.parametrize(
    ("request_bytes", "status"),
    [
        (b"GET /nothing HTTP/1.1\r\n\r\n", HTTPStatus.NOT_FOUND),
        (b"POST /live HTTP/1.1\r\n\r\n", HTTPStatus.METHOD_NOT_ALLOWED),
        (b"DELETE / HTTP/1.1\r\n\r\n", HTTPStatus.METHOD_NOT_ALLOWED),
        (b"\r\n\r\n", HTTPStatus.BAD_REQUEST),
        (b"\x16\x03\x01\xff\n\n", HTTPStatus.BAD_REQUEST),  # a client that speaks TLS
        (b"GET /live\r\n\r\n", HTTPStatus.BAD_REQUEST),
        (b"GET /" + b"a" * MAX_REQUEST_BYTES, HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE),
    ],
)
def test_a_wrong_request_gets_the_status_that_names_it(server, request_bytes, status):
    assert raw(server, request_bytes).startswith(f"HTTP/1.1 {status.value} ".encode())
    assert get(server) == (200, b"live\n")


def test_a_request_may_arrive_in_pieces(server):
    with socket.create_connection(("127.0.0.1", port_of(server)), timeout=60) as client:
        for piece in (b"GET /li", b"ve HTTP/1.1\r\nHost", b": a\r\n\r\n"):
            client.sendall(piece)
            assert get(server)[0] == 200
        assert client.recv(65536).startswith(b"HTTP/1.1 200 OK")


def test_an_error_behind_a_path_is_counted_and_the_server_goes_on(server, guard):
    with pytest.raises(urllib.error.HTTPError) as refused:
        get(server, "/broken")
    assert refused.value.code == 500
    refused.value.close()
    assert guard.counts == {"http answer": 1}
    assert get(server) == (200, b"live\n")


def test_clients_that_send_nothing_do_not_hold_up_the_others(server):
    with contextlib.ExitStack() as idle:
        for _ in range(2 * MAX_CONNECTIONS):
            idle.enter_context(socket.create_connection(("127.0.0.1", port_of(server)), timeout=60))
        assert get(server) == (200, b"live\n")


def test_a_client_that_never_reads_does_not_hold_up_the_others(server):
    with contextlib.ExitStack() as greedy:
        for _ in range(4):
            client = greedy.enter_context(socket.create_connection(("127.0.0.1", port_of(server)), timeout=60))
            client.sendall(b"GET /large HTTP/1.1\r\n\r\n")
        assert get(server) == (200, b"live\n")
    assert get(server, "/large") == (200, LARGE)


def test_a_connection_ends_at_its_deadline(guard):
    server = HttpServer("127.0.0.1", 0, respond, guard, deadline_s=0.1)
    try:
        with socket.create_connection(("127.0.0.1", port_of(server)), timeout=60) as client:
            client.sendall(b"GET /live HTTP/1.1\r\n")
            assert client.recv(1) == b""
    finally:
        server.close()


def test_close_ends_the_thread_and_frees_the_port(guard):
    server = HttpServer("127.0.0.1", 0, respond, guard)
    port = port_of(server)
    with socket.create_connection(("127.0.0.1", port), timeout=60):
        server.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "http"]
    again = HttpServer("127.0.0.1", port, respond, guard)
    assert get(again) == (200, b"live\n")
    again.close()


def test_a_port_in_use_is_named(server, guard):
    with pytest.raises(AddressError, match=rf"cannot listen at 127.0.0.1:{port_of(server)}: Address already in use"):
        HttpServer("127.0.0.1", port_of(server), respond, guard)


def test_an_address_of_another_machine_is_named(guard):
    with pytest.raises(AddressError, match="cannot listen at 192.0.2.1:9464: "):
        HttpServer("192.0.2.1", 9464, respond, guard)


def test_a_connection_that_is_dropped_while_its_request_arrives_is_no_error(server, guard, monkeypatch):
    monkeypatch.setattr("neurove_service.metrics.http.MAX_CONNECTIONS", 2)
    address = ("127.0.0.1", port_of(server))
    entered.clear()
    go_on.clear()
    with socket.create_connection(address, timeout=60) as oldest, socket.create_connection(address, timeout=60) as slow:
        slow.sendall(b"GET /slow HTTP/1.1\r\n\r\n")
        assert entered.wait(60)  # its answer is too long to be sent at once, so it stays open
        with socket.create_connection(address, timeout=60) as newest:
            oldest.sendall(b"GET /live HTTP/1.1\r\n\r\n")
            newest.sendall(b"GET /live HTTP/1.1\r\n\r\n")
            go_on.set()
            assert newest.recv(15) == b"HTTP/1.1 200 OK"
    assert guard.counts == {}
