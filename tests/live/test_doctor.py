"""neurove doctor with a real service and a real driver."""

import json

import pytest

from tests.live.conftest import Heard, free_endpoint, running, service, start_router, wait_until

pytestmark = pytest.mark.live


def checks_of(out):
    return {check["what"]: check for check in json.loads(out)["checks"]}


def test_a_service_and_its_streams_are_checked(run):
    endpoint = free_endpoint()
    with service(endpoint) as (_, transport, config):
        code, out, err = run("doctor", "--connect", endpoint, "--json")
        assert (code, err) == (0, "")
        node = checks_of(out)["node n1"]
        assert (node["level"], "model default" in node["state"]) == ("ok", True)
        heard = Heard(transport, config)
        with running("drive", "pattern://", "--connect", endpoint, "--wait", "90"):
            wait_until(lambda: heard.of("cam0"))
            code, out, _ = run("doctor", "--connect", endpoint, "--json")
            checks = checks_of(out)
            assert checks["stream cam0: clock"]["level"] == "ok"
            expected = {
                "stream cam0: calibration": "bad" if "uncalibrated" in heard.of("cam0")[-1].flags else "ok",
                "stream cam0: height": "bad" if "unscaled" in heard.of("cam0")[-1].flags else "ok",
            }
            assert {name: checks[name]["level"] for name in expected} == expected
            assert code == (1 if "bad" in expected.values() else 0)
        with running("drive", "sim://wall?seed=1", "--stream", "cam1", "--connect", endpoint, "--wait", "90"):
            wait_until(lambda: heard.of("cam1"))
            known = checks_of(run("doctor", "--connect", endpoint, "--json").out)["stream cam1: height"]
            assert (known["state"], known["level"]) == ("known", "ok")


def test_a_router_without_a_service_is_named(run):
    endpoint = free_endpoint()
    router = start_router(endpoint)
    try:
        wait_until(lambda: "router answers" in run("doctor", "--connect", endpoint, "--json").out)
    finally:
        router.kill()
        router.wait()
