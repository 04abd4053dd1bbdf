"""The driver and the consumer of protocol/README.md run as they stand there, against a real service."""

import contextlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import neurove_protocol
from tests.live.conftest import free_endpoint, service, wait_until

PAGE = Path(neurove_protocol.__file__).with_name("README.md").read_text(encoding="utf-8")
DRIVER, CONSUMER = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
DOCUMENTED = "tcp/127.0.0.1:7447"


@pytest.mark.live
def test_the_driver_and_the_consumer_of_the_page_exchange_estimates_with_a_service(tmp_path):
    endpoint = free_endpoint()
    assert DOCUMENTED in DRIVER
    assert DOCUMENTED in CONSUMER
    heard = tmp_path / "heard.txt"
    with service(endpoint) as (_, transport, config), heard.open("w") as out:
        consumer = subprocess.Popen(
            [sys.executable, "-u", "-c", CONSUMER.replace(DOCUMENTED, endpoint)], stdout=out, stderr=subprocess.STDOUT
        )
        try:
            publisher = transport.publisher(config.keys.velocity("probe"), "application/msgpack")
            wait_until(lambda: publisher.matching)  # the consumer has subscribed
            driver = [sys.executable, "-c", DRIVER.replace(DOCUMENTED, endpoint)]
            subprocess.run(driver, check=True, timeout=60)
            wait_until(lambda: len(heard.read_text().splitlines()) >= 15)
        finally:
            consumer.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                consumer.wait(60)
    lines = [line for line in heard.read_text().splitlines() if line.startswith("cam0 ")]
    assert [int(line.split()[1]) for line in lines[:15]] == list(range(15))
    assert all("Twist(vx=" in line for line in lines)
    assert "unscaled" in lines[-1]
