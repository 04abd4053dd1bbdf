"""Two nodes that cannot keep up: one goes on to answer, late and with flags, and the other one follows no more."""

import dataclasses
import itertools

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.models import bundle
from neurove_core.networks import kinds
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from tests.live.conftest import client, wait_until
from tests.live.fellows import Consumer, Driver, duty, fellows

STREAM, WINDOW_US, PACKET_US = "cam0", 8_000, 40_000
BOTH = {"a", "b"}


def costly_model(folder):
    """A bundle with several times more windows in a second than one core computes.

    Its norms are not set with random windows of this size, which would take half a minute.
    """
    config = ModelConfig(
        window=WindowConfig(duration_us=WINDOW_US, bins=64),
        canonical=CanonicalConfig(width=40, height=30),
        network=NetworkConfig(channels=(32, 32), features=32, hidden=32),
    )
    small = bundle.untrained(3, config, "costly")
    large = config.model_copy(update={"canonical": CanonicalConfig(width=320, height=240)})
    path = folder / "costly.safetensors"
    bundle.save(dataclasses.replace(small, config=large, network=kinds.make(large).eval()).with_digest(), path)
    return path


def test_nodes_that_are_late_do_not_take_over_from_each_other(router, tmp_path):
    late = ("--queue-s", "1")
    with client(router) as transport, fellows(BOTH, router, costly_model(tmp_path), *late) as nodes:
        consumer, driver = Consumer(transport), Driver(transport, [STREAM], step_us=PACKET_US).start()

        def role(name):
            reply = duty(transport, name, STREAM)
            return reply and reply.role

        def one_is_left():
            return {role(name) for name in BOTH} == {"answers", "absent"}

        try:
            wait_until(one_is_left)
            leader = consumer.leader(STREAM)
            (other,) = BOTH - {leader}
            (health,) = ask.health(transport, ClientConfig(connect=(router,)), other)
            assert not health.ok
            assert f"cannot keep up and follows 1 stream no more, so it has one standby less: {STREAM}" in health.why
            wait_until(lambda: "overload" in consumer.newest(STREAM).flags)
            answered_by = [one.estimate.node for one in consumer.taken[STREAM]]
            changes = sum(before != after for before, after in itertools.pairwise(answered_by))
            assert changes <= 1, answered_by  # at the begin both nodes may answer first
            nodes[leader].kill()
            wait_until(lambda: consumer.leader(STREAM) == other)
        finally:
            driver.stop()
