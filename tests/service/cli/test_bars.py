"""Progress of a long command, on a terminal and in a log."""

import sys

from neurove_service.cli.bars import progress


def test_a_terminal_shows_a_bar_for_each_task(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress() as show:
        show("simulated", 1, 4, "street")
        show("trained", 0, 10, "")
        show("trained", 10, 10, "0.5 m/s")
    shown = capsys.readouterr().err
    for word in ("simulated", "street", "trained", "0.5 m/s"):
        assert word in shown


def test_a_log_gets_a_line_for_every_sequence_and_for_every_hundredth_training_step(capsys):
    with progress() as show:
        show("simulated", 7, 10, "street")
        for step in range(4, 1011, 4):
            show("trained", step, 1010, "0.5 m/s")
        show("trained", 1010, 1010, "0.4 m/s")
    lines = capsys.readouterr().err.splitlines()
    assert (lines[0], lines[-1]) == ("simulated 7/10: street", "trained 1010/1010: 0.4 m/s")
    assert len(lines) == 1 + 10 + 1
