"""Endpoints of Zenoh, checked before Zenoh sees them, so that an error says in our words what is wrong."""

import ipaddress
import re
from typing import Final

PROTOCOLS: Final = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream")
"""Protocols of the installed Zenoh; each also in zenoh_config."""

_SYSTEM_ERROR: Final = re.compile(r"([^:\[\]]+) \(os error \d+\)")
_EXAMPLE: Final = "such as tcp/127.0.0.1:7447"
_HOST_PORT: Final = re.compile(r"(?:\[[0-9A-Fa-f:.%\w]+\]|[^\s:/\[\]]+):(\d{1,5})")


def check_endpoint(text: str) -> str:
    """An endpoint such as `tcp/127.0.0.1:7447`, with Zenoh's `?metadata` and `#config` where given.

    Raises:
        ValueError: it has another form; the text says which form is right.

    >>> check_endpoint("tcp/[::1]:7447")
    'tcp/[::1]:7447'
    """
    protocol, slash, rest = text.partition("/")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if not slash or protocol not in PROTOCOLS:
        raise ValueError(_wrong_protocol(text))
    if protocol == "unixsock-stream":
        if not address:
            raise ValueError(f"{text!r} has no path: give unixsock-stream/PATH")
        return text
    _check_host_port(text, address, f"has no HOST:PORT after {protocol}/: give an endpoint {_EXAMPLE}")
    return text


def _check_host_port(text: str, address: str, why_not: str) -> None:
    found = _HOST_PORT.fullmatch(address)
    if not found:
        raise ValueError(f"{text!r} {why_not}")
    if int(found[1]) > 65535:
        raise ValueError(f"{text!r}: port {found[1]}: a port is at most 65535")


def _wrong_protocol(text: str) -> str:
    address = text.partition("://")[2] or text
    if _HOST_PORT.fullmatch(address) and address.partition(":")[0] not in PROTOCOLS:
        protocol = text.partition("://")[0]
        meant = f"{protocol if protocol in PROTOCOLS else 'tcp'}/{address}"
        return f"{text!r} is no endpoint: did you mean {meant!r}?"
    return f"{text!r} is no endpoint: give PROTOCOL/HOST:PORT {_EXAMPLE}; the protocols are {', '.join(PROTOCOLS)}"


LOOPBACK: Final = "127.0.0.1"


def check_address(text: str) -> str:
    """An address to listen on, HOST:PORT; a port without a host means this machine only.

    Raises:
        ValueError: it has another form.

    >>> check_address("9464"), check_address("0.0.0.0:9464"), check_address("[::1]:0")
    ('127.0.0.1:9464', '0.0.0.0:9464', '[::1]:0')
    """
    address = f"{LOOPBACK}:{text.removeprefix(':')}" if text.removeprefix(":").isdecimal() else text
    _check_host_port(text, address, f"is no address: give HOST:PORT, such as {LOOPBACK}:9464")
    return address


def split_address(address: str) -> tuple[str, int]:
    """Host and port of a checked address.

    >>> split_address("[::1]:9464")
    ('::1', 9464)
    """
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a host.

    >>> is_loopback("localhost"), is_loopback("::1"), is_loopback("0.0.0.0")
    (True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # another name
        return False


def where(listen: tuple[str, ...], connect: tuple[str, ...]) -> str:
    """The endpoints of a session, for an error."""
    parts = [f"listen={', '.join(listen)}"] * bool(listen) + [f"connect={', '.join(connect)}"] * bool(connect)
    return " ".join(parts) or "no endpoints"


def unreached(connect: tuple[str, ...]) -> str:
    """Why there is no connection; Zenoh reports a closed port and a refused certificate in the same way."""
    secured = any(endpoint.startswith(("tls/", "quic/")) for endpoint in connect)
    refused = ", or one side refuses the other's certificate (zenoh_config)" if secured else ""
    return f"no process listens at {', '.join(connect)}{refused}"


def reason(error: Exception) -> str:
    """The error of the operating system in one of Zenoh if there is one, or its text without source locations."""
    system = _SYSTEM_ERROR.search(str(error))
    return system[1].strip() if system else str(error).split(" at /", maxsplit=1)[0].removesuffix(".")
