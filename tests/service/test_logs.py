import io
import json
import os
import subprocess
import sys
import threading

import pytest

from neurove_service.log_writer import MAX_BYTES, MAX_LINES, Limiter, LogWriter, Quiet

TELL = "dropped {}".format


@pytest.fixture
def pipe():
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as reader, os.fdopen(writing, "w") as writer:
        yield reader, writer


def logged(program, before="", **kwargs):
    code = f"{before}\nfrom neurove_service import logs\nlogs.configure()\nlog = logs.get('test')\n{program}"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, check=True, timeout=60, **kwargs)
    return [json.loads(line) for line in done.stderr.splitlines()]


def test_a_pipe_that_nobody_reads_costs_lines_and_no_time(pipe):
    reader, stream = pipe
    writer = LogWriter(stream, TELL)
    for number in range(3 * MAX_LINES):
        writer.add(f"{number} {'x' * 1000}")  # returns, or this test does not end
    dropped = writer.dropped
    assert dropped > MAX_LINES
    got, told, ended = [], [], threading.Event()

    def read():
        for line in reader:
            word, _, rest = line.decode().partition(" ")
            if word == "last\n":
                ended.set()
                return
            told.append(int(rest)) if word == "dropped" else got.append(int(word))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    assert writer.flush(20)
    writer.add("last")
    assert ended.wait(60)
    assert got == sorted(got)
    assert len(got) + dropped == 3 * MAX_LINES
    assert sum(told) == dropped


def test_the_queue_is_bounded_in_bytes(pipe):
    _, stream = pipe
    writer = LogWriter(stream, TELL)
    for _ in range(20):
        writer.add("x" * (MAX_BYTES // 10))
    assert writer.dropped >= 9


def test_a_reader_that_left_costs_the_line(pipe):
    reader, stream = pipe
    reader.close()
    writer = LogWriter(stream, TELL)
    writer.add("line")
    assert writer.flush(20)
    assert writer.dropped == 1


def test_a_stream_without_a_descriptor_gets_the_lines():
    stream = io.StringIO()
    writer = LogWriter(stream, TELL)
    writer.add("one"), writer.add("two")
    assert writer.flush(20)
    assert stream.getvalue() == "one\ntwo\n"


def test_one_kind_of_line_is_bounded_and_the_rest_is_told_in_number():
    now = [0.0]
    limiter = Limiter(of_stream=3, of_kind=5, period_s=10, now_s=lambda: now[0])
    assert [limiter.admit("refused", "cam0") for _ in range(5)] == [True] * 3 + [False] * 2
    assert [limiter.admit("refused", f"x{number}") for number in range(5)] == [True] * 2 + [False] * 3
    assert limiter.admit("ready", "")
    assert limiter.ended() == []
    now[0] = 10
    assert limiter.ended() == [Quiet("refused", "cam0", 2), Quiet("refused", "", 3)]
    assert limiter.admit("refused", "cam0")


def test_ten_thousand_lines_of_one_kind_are_ten_lines():
    lines = logged("for i in range(10_000): log.warning('packet refused', stream='cam0', total=i)")
    assert [line["total"] for line in lines] == list(range(10))


def test_the_lines_that_were_left_out_are_one_line_with_fields():
    lines = logged(
        "for i in range(15): log.warning('packet refused', stream='cam0')\nlate.append(20)\nlog.info('next')",
        before="import time\nreal, late = time.monotonic, [0]\ntime.monotonic = lambda: real() + sum(late)",
    )
    told = lines[10]
    assert (told["event"], told["level"], told["kind"], told["stream"], told["lines"]) == (
        "similar log lines left out", "warning", "packet refused", "cam0", 5
    )  # fmt: skip
    assert told["timestamp"]
    assert [line["event"] for line in lines[11:]] == ["next"]


def test_what_comes_from_outside_is_clipped_and_has_no_control_characters():
    (line,) = logged(r"log.warning('stream refused', stream='\x1b[2J' + 'x' * 5000)")
    assert len(line["stream"]) < 400
    assert line["stream"].endswith("(5004 characters)")
    assert "\x1b" not in line["stream"]


def test_an_error_has_its_traceback_and_the_last_line_is_written_before_the_exit():
    program = "try: 1 / 0\nexcept Exception as error: log.error('internal error', exc_info=error)\nlog.info('stopped')"
    failed, stopped = logged(program)
    assert failed["exception"][0]["exc_type"] == "ZeroDivisionError"
    assert stopped["event"] == "stopped"


def test_a_log_with_a_closed_stderr_is_no_error():
    subprocess.run(
        [sys.executable, "-c", "from neurove_service import logs\nlogs.configure()\nlogs.get('x').info('y')"],
        check=True,
        timeout=60,
        preexec_fn=lambda: os.close(2),
    )
