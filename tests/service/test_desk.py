import threading

from neurove_service.desk import Desk
from neurove_service.node.snapshot import FRESH_S, Snapshot


def test_a_desk_hands_out_in_order_and_refuses_what_it_has_no_place_for():
    desk = Desk(most=3, per_second=1e9)
    assert [desk.offer(number) for number in range(5)] == [True, True, True, False, False]
    requests = iter(desk)
    assert [next(requests) for _ in range(3)] == [0, 1, 2]
    assert desk.offer(5)
    assert next(requests) == 5


def test_a_desk_keeps_its_rate_after_the_first_burst():
    now, waited = [0.0], []

    def pause(seconds):
        waited.append(seconds)
        now[0] += seconds

    desk = Desk(most=10, per_second=100, now_s=lambda: now[0], pause=pause)
    requests = iter(desk)
    for number in range(110):
        desk.offer(number)
        next(requests)
    assert 0.9 < sum(waited) < 1.1
    assert now[0] == sum(waited)


def test_a_closed_desk_ends_its_thread_and_takes_nothing():
    desk, served = Desk(), []
    thread = threading.Thread(target=lambda: served.extend(desk))
    thread.start()
    desk.close()
    thread.join(60)
    assert not thread.is_alive()
    assert not desk.offer(1)
    assert served == []


def test_a_snapshot_answers_equal_requests_of_a_moment_once():
    now, state, made = [0.0], ["a"], []

    def handle(request):
        made.append(request)
        return request + b"%d" % len(made)

    snapshot = Snapshot(handle, lambda: state[0], lambda: now[0])
    assert [snapshot(b"x") for _ in range(1000)] == [b"x1"] * 1000
    assert snapshot(b"y") == b"y2"
    state[0] = "b"
    assert snapshot(b"y") == b"y3"
    now[0] = FRESH_S
    assert snapshot(b"y") == b"y4"
