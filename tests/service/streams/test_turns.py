import threading

from neurove_service.streams.turns import Turns
from tests.live.conftest import wait_until


def test_turns_are_given_in_the_order_in_which_they_were_asked_for():
    turns, order = Turns(1), []
    threads = []

    def work(name):
        with turns.turn():
            order.append(name)

    with turns.turn():
        for name in range(5):
            threads.append(threading.Thread(target=work, args=(name,)))
            threads[-1].start()
            wait_until(lambda: turns.waiting == len(threads))
        assert order == []
    for thread in threads:
        thread.join(60)
    assert order == list(range(5))


def test_no_more_workers_than_allowed_have_their_turn_at_once():
    turns, lock, counts = Turns(2), threading.Lock(), {"now": 0, "most": 0}

    def work():
        for _ in range(200):
            with turns.turn():
                with lock:
                    counts["now"] += 1
                    counts["most"] = max(counts.values())
                with lock:
                    counts["now"] -= 1

    threads = [threading.Thread(target=work) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert counts["now"] == 0
    assert 1 <= counts["most"] <= 2


def test_an_error_gives_the_turn_back():
    turns = Turns(1)
    try:
        with turns.turn():
            raise RuntimeError("planted")
    except RuntimeError:
        pass
    with turns.turn():
        pass


def test_a_worker_that_asks_for_the_last_turn_lets_those_that_came_later_go_first():
    turns, order, threads = Turns(1), [], []

    def follow():
        while "follows" not in order:
            with turns.turn(last=True) as begun:
                if begun:
                    order.append("follows")

    def answer():
        with turns.turn():
            order.append("answers")

    with turns.turn():
        threads.append(threading.Thread(target=follow))
        threads[-1].start()
        wait_until(lambda: turns.waiting == 1)
        for number in (1, 2):
            threads.append(threading.Thread(target=answer))
            threads[-1].start()
            wait_until(lambda: turns.waiting == 1 + number)  # noqa: B023
    for thread in threads:
        thread.join(60)
    assert order == ["answers", "answers", "follows"]


def test_a_worker_that_lets_others_go_first_does_not_wait_for_ever():
    turns = Turns(1)
    with turns.turn(), turns.turn(last=True) as begun:
        assert not begun
        assert turns.waiting == 0
    with turns.turn(last=True) as begun:
        assert begun
    with turns.turn() as begun:
        assert begun
