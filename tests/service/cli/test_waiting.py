"""Clients that start before the service: they wait, say so in one line, and give up in the end."""

import argparse
import threading

import pytest

from neurove_service.cli import waiting
from neurove_service.clients.ask import NoService
from neurove_service.config import ClientConfig

CONFIG = ClientConfig(connect=("tcp/127.0.0.1:9",))


class Service:
    """Answers from the n-th attempt on."""

    def __init__(self, answers_at):
        self.answers_at, self.attempts = answers_at, 0

    def __call__(self):
        self.attempts += 1
        if self.attempts < self.answers_at:
            raise NoService("no service")
        return "here"


def test_a_client_waits_for_a_service_and_says_so_in_one_line(capsys):
    service = Service(3)
    assert waiting.Wait(CONFIG, 30).until(service) == "here"
    assert service.attempts == 3
    assert capsys.readouterr().err == "neurove: waiting up to 30 s (--wait) for a service at tcp/127.0.0.1:9\n"


def test_a_client_whose_service_answers_at_once_says_nothing(capsys):
    assert waiting.Wait(CONFIG, 30).until(Service(1)) == "here"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("wait_s", "stopped"), [(0, False), (0.01, False), (30, True)])
def test_a_client_gives_up_at_the_end_of_the_wait_or_when_it_is_stopped(wait_s, stopped):
    stop = threading.Event()
    if stopped:
        stop.set()
    with pytest.raises(NoService):
        waiting.Wait(CONFIG, wait_s, stop).until(Service(10**6))


def test_without_a_wait_there_is_one_attempt_and_no_line(capsys):
    service = Service(2)
    with pytest.raises(NoService):
        waiting.Wait(CONFIG, 0).until(service)
    assert (service.attempts, capsys.readouterr().err) == (1, "")


@pytest.mark.parametrize("text", ["-1", "nan", "inf", "soon"])
def test_a_wait_that_is_no_number_of_seconds_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="seconds, 0 or more"):
        waiting.wait_seconds(text)
