import subprocess
import sys

from neurove_protocol.events import SCHEMA
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from tests.live.conftest import client, free_endpoint, is_alive, wait_until

PIPE_BYTES = 4096


def test_a_service_whose_log_has_no_reader_answers_and_ends():
    endpoint = free_endpoint()
    config = ClientConfig(connect=(endpoint,))
    command = [sys.executable, "-m", "neurove_service.cli", "serve", "--listen", endpoint, "--node", "n1"]
    child = subprocess.Popen([*command, "--max-streams", "1"], stderr=subprocess.PIPE, pipesize=PIPE_BYTES)
    try:
        with client(endpoint, patience_s=60) as transport:
            wait_until(lambda: is_alive(transport, config), 60)
            for number in range(200):
                transport.put(config.keys.events(f"{'x' * 50}{number}"), b"garbage", SCHEMA)
            wait_until(lambda: ask.health(transport, config)[0].refused_streams == 199)
            assert ask.health(transport, config)[0].ready
        child.terminate()
        assert child.wait(60) == 0
    finally:
        child.kill()
        child.wait()
        unread = len(child.stderr.read())
        child.stderr.close()
    assert unread >= PIPE_BYTES - 512  # the pipe was full
