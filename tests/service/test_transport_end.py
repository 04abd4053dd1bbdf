import subprocess
import sys

import pytest

PROGRAM = """
from neurove_service.transport import open_transport
transport = open_transport("peer", listen=("tcp/127.0.0.1:0",))
transport.subscribe("a/b", lambda key, payload, received_ns: None)
transport.answer("a/c", lambda request: request)
publisher = transport.publisher("a/d", "x")
publisher.put(b"x")
print("end")
"""


@pytest.mark.live
@pytest.mark.parametrize("end", ["", "transport.close(); transport.close()", "raise SystemExit(3)"])
def test_a_program_that_leaves_its_session_open_ends(end):
    ran = subprocess.run([sys.executable, "-c", PROGRAM + end], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout, ran.stderr) == (3 if "3" in end else 0, "end\n", "")
