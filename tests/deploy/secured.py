"""A deployment with certificates and an access list, made by the shipped scripts, and sessions of its participants."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import zenoh

from neurove_service.transport import open_transport
from tests.live.conftest import START_S, free_endpoint

TLS = Path(__file__).resolve().parents[2] / "deploy" / "tls"


def free_tls():
    return free_endpoint().replace("tcp/", "tls/")


def make_ca(folder, *names):
    """Run the script; skips where there is no openssl."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed: no certificate can be made")
    command = ["sh", str(TLS / "make-ca.sh"), *([str(folder)] if folder else []), *names]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def make_configs(folder, *flags):
    command = [sys.executable, str(TLS / "make-configs.py"), str(folder), *flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def deployment(folder, endpoint, *names):
    """Certificates and configurations of these participants."""
    for made in (make_ca(folder, *names), make_configs(folder, "--listen", endpoint)):
        assert made.returncode == 0, made.stderr
    return folder


def access_list(config):
    return json.loads(zenoh.Config.from_file(str(config)).get_json("access_control"))


def joined(endpoint, config):
    """Our own session, with the certificate of this configuration."""
    return open_transport("client", connect=(endpoint,), config_file=config, patience_s=START_S)


def bare(endpoint, config=None, **settings):
    """A Zenoh session that does what our own would not."""
    made = zenoh.Config.from_file(str(config)) if config else zenoh.Config()
    common = {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}
    for key, value in (common | {"transport/shared_memory/enabled": False} | settings).items():
        made.insert_json5(key, json.dumps(value))
    return zenoh.open(made)


def asked(session, key, payload=b"", timeout_s=5.0):
    """The payloads of all replies to a query, refusals too."""
    replies = session.get(key, zenoh.handlers.FifoChannel(64), payload=payload, timeout=timeout_s)
    return [(reply.ok or reply.err).payload.to_bytes() for reply in replies]
