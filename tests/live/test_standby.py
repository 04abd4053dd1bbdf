"""Two nodes serve one stream: kill -9, a hanging node and a drain cost no window, double none, and change no number."""

import pytest

from neurove_core.models import bundle
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from tests.live.conftest import client, neurove, wait_until
from tests.live.fellows import Consumer, Driver, check, drain, duty, fellows, follows, small_model
from tests.live.relay import Link

STREAM = "cam0"


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return small_model(folder), small_model(folder, seed=4)


def test_kills_drains_and_a_hanging_node_leave_no_trace_in_the_estimates(router, models):
    model, second_model = models
    folder = ("--models-dir", str(second_model.parent), "--probation-s", "0")
    with client(router) as transport, fellows(("a", "b"), router, model, *folder) as nodes:
        consumer, driver = Consumer(transport), Driver(transport, [STREAM]).start()
        wait_until(lambda: len(consumer.taken.get(STREAM, ())) > 20)
        both = {"a", "b"}

        def other(name):
            (found,) = both - {name}
            return found

        def some_windows_later(windows=20):
            count = len(consumer.taken[STREAM])
            wait_until(lambda: len(consumer.taken[STREAM]) > count + windows)

        def hand_over(by, back):
            """The other node answers after `by`; after `back` there is a follower with equal state again."""
            wait_until(lambda: any(follows(transport, name, STREAM) for name in both))
            first = consumer.leader(STREAM)
            by(first)
            wait_until(lambda: consumer.leader(STREAM) != first)
            back(first)
            wait_until(lambda: follows(transport, other(consumer.leader(STREAM)), STREAM))

        for _ in range(2):
            hand_over(lambda name: nodes[name].kill(), lambda name: nodes[name].start())
        hand_over(lambda name: drain(transport, name), lambda name: drain(transport, name, resume=True))
        for _ in range(2):  # so long that packets are lost; the node that woke answers while the other one hangs

            def hang(name):
                nodes[name].hang()
                some_windows_later(100)

            hand_over(hang, lambda name: nodes[name].wake())
        some_windows_later()
        driver.pause()
        wait_until(lambda: driver.is_answered(consumer.newest(STREAM)))
        assert len({got.estimate.term for got in consumer.taken[STREAM]}) >= 5
        check(consumer, driver, STREAM, model)

        driver.go_on()  # both nodes follow one activation, and become equal again
        some_windows_later()
        for name in both:
            ask.activate(transport, ClientConfig(connect=(router,)), second_model.stem, name)
        digest = bundle.load(second_model).digest
        wait_until(
            lambda: (
                consumer.newest(STREAM).digest == digest
                and follows(transport, other(consumer.leader(STREAM)), STREAM)
                and duty(transport, other(consumer.leader(STREAM)), STREAM).digest == digest
            )
        )

        first = consumer.leader(STREAM)  # an orderly stop
        nodes[first].end()
        wait_until(lambda: consumer.leader(STREAM) != first)
        some_windows_later()
        taken = [got.estimate.start_us for got in consumer.taken[STREAM]]
        assert taken == sorted(set(taken))

        last = consumer.leader(STREAM)  # without a follower, a drain keeps the stream and says so
        done = neurove("drain", "--connect", router, "--node", last)
        assert done.returncode == 1
        assert f"{STREAM}: no other node follows it with equal state" in done.stdout
        some_windows_later()
        driver.stop()
        assert duty(transport, last, STREAM).role == "answers"


def test_after_a_partition_no_window_is_answered_twice_and_the_node_follows_again(router, models):
    model, _ = models
    links = {name: Link(int(router.rpartition(":")[2])) for name in ("a", "b")}
    try:
        with client(router) as transport, fellows(links, router, model, links=links):
            consumer, driver = Consumer(transport), Driver(transport, [STREAM]).start()
            wait_until(lambda: any(follows(transport, name, STREAM) for name in links))
            wait_until(lambda: consumer.taken.get(STREAM))
            first = consumer.leader(STREAM)
            links[first].part()
            wait_until(lambda: consumer.leader(STREAM) != first)
            newest = len(consumer.taken[STREAM])
            wait_until(lambda: len(consumer.taken[STREAM]) > newest + 100)
            links[first].heal()
            wait_until(lambda: follows(transport, first, STREAM))
            driver.pause()
            wait_until(lambda: driver.is_answered(consumer.newest(STREAM)))
            check(consumer, driver, STREAM, model)
            driver.stop()
    finally:
        for link in links.values():
            link.close()
