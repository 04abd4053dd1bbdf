"""Nodes share streams: each stream is answered by one of them, and moves with its state when a node joins or leaves."""

from tests.live.conftest import client, wait_until
from tests.live.fellows import KEYS, Consumer, Driver, Fellow, check, duty, small_model

STREAMS = [f"cam{number}" for number in range(6)]
OF_B = {"cam1", "cam2"}  # that `sharing.drawn` gives to b


def test_streams_move_with_their_state_when_a_node_joins_and_are_answered_when_it_is_killed(router, tmp_path):
    model = small_model(tmp_path, 100_000)
    share = ("--copies", "1", "--streams", "cam*")
    nodes = {name: Fellow(name, router, model, *share) for name in ("a", "b")}
    with client(router) as transport:
        try:
            nodes["a"].start()
            wait_until(lambda: transport.tokens(KEYS.alive("a"), 1.0), 240)
            consumer, driver = (
                Consumer(transport),
                Driver(transport, [*STREAMS, "other"], distinct=50, step_us=25_000).start(),
            )
            wait_until(lambda: all(len(consumer.taken.get(one, ())) > 5 for one in STREAMS))
            assert {consumer.leader(one) for one in STREAMS} == {"a"}
            nodes["b"].start()
            wait_until(lambda: {one for one in STREAMS if consumer.leader(one) == "b"} == OF_B, 240)
            wait_until(lambda: all(duty(transport, "a", one).role == "absent" for one in OF_B))
            driver.pause()
            wait_until(lambda: all(driver.is_answered(consumer.newest(one)) for one in STREAMS))
            for one in STREAMS:
                check(consumer, driver, one, model)
            driver.go_on()
            nodes["b"].kill()
            wait_until(lambda: {consumer.leader(one) for one in STREAMS} == {"a"})
            driver.stop()
            for one in STREAMS:
                starts = [got.estimate.start_us for got in consumer.taken[one]]
                assert starts == sorted(set(starts)), one
            assert "other" not in consumer.taken
        finally:
            for node in nodes.values():
                if node.process is not None and node.process.child.poll() is None:
                    node.end()
