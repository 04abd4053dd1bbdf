"""The router of a robot: what is of the sensor stays on the robot, and the rest of the fleet sees the robot."""

import contextlib
import json
from pathlib import Path

import pytest

from neurove_service.config import ClientConfig
from neurove_service.fleet import roster
from neurove_service.transport import open_transport
from tests.live.conftest import client, free_endpoint, wait_until
from tests.service.metrics.test_families import reply

pytestmark = pytest.mark.live

FILE = Path(__file__).parents[2] / "deploy" / "zenoh-robot-router.json5"
UPLINK = "ws"  # stands for tls, which needs certificates


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    """Sessions on two robots behind the router of a site, and one of an operator at the site."""
    site = free_endpoint().replace("tcp/", f"{UPLINK}/")
    text = FILE.read_text().replace('"tls"', json.dumps(UPLINK)).replace("tls/site-router:7447", site)
    with contextlib.ExitStack() as stack:
        stack.enter_context(open_transport("router", listen=(site,)))
        sessions = []
        for number in range(2):
            where = free_endpoint()
            config = tmp_path_factory.mktemp(f"robot{number}") / "router.json5"
            config.write_text(text.replace("tcp/127.0.0.1:7447", where))
            stack.enter_context(open_transport("router", config_file=config))
            sessions.append(stack.enter_context(client(where)))
        yield (*sessions, stack.enter_context(client(site)))


def test_sensor_data_stays_on_the_robot_and_estimates_leave_it(robots):
    first, second, operator = robots
    keys, heard = ClientConfig().keys, {"first": [], "second": [], "operator": []}
    for name, session, key in (
        ("first", first, keys.events()),
        ("second", second, keys.events()),
        ("operator", operator, keys.events()),
        ("operator", operator, keys.velocity()),
        ("second", second, keys.velocity()),
    ):
        session.subscribe(key, lambda key, *_, name=name: heard[name].append(key))
    events = first.publisher(keys.events("cam0"), "x")
    velocity = first.publisher(keys.velocity("cam0"), "x")
    wait_until(lambda: events.matching and velocity.matching)

    def both_heard():
        events.put(b"events")
        velocity.put(b"estimate")
        return keys.events("cam0") in heard["first"] and all(heard[name] for name in ("second", "operator"))

    wait_until(both_heard)
    assert set(heard["second"]) == set(heard["operator"]) == {keys.velocity("cam0")}


def test_the_health_of_every_robot_is_heard_at_the_site(robots):
    config = ClientConfig()
    for name, session in zip(("robot1", "robot2"), robots[:2], strict=True):
        session.answer(config.keys.health(name), lambda _, name=name: reply(name).encode())
        session.token(config.keys.alive(name))
    wait_until(lambda: list(roster.ask(robots[2], config, timeout_s=60.0).replies) == ["robot1", "robot2"])
