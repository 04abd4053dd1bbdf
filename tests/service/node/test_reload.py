import logging
import os
import signal
import threading

import pytest
from structlog.testing import capture_logs

from neurove_service.config import ConfigError, ServiceConfig
from neurove_service.lifecycle import stop_on_signals
from neurove_service.models.library import Available
from neurove_service.node.folders import check_folders
from neurove_service.node.reload import Reload


@pytest.fixture
def level_as_before():
    root = logging.getLogger()
    level = root.level
    yield root
    root.setLevel(level)


def reload_with(new):
    """What is logged when settings are reloaded."""

    def read():
        if isinstance(new, Exception):
            raise new
        return new

    with capture_logs() as lines:
        Reload(ServiceConfig(), read, lambda: Available((), {"models": "Permission denied"}))()
    return lines


def test_a_reload_sets_the_log_level_lists_the_models_and_names_what_needs_a_restart(level_as_before):
    [line] = reload_with(ServiceConfig(log_level="error", max_streams=3, node="b"))
    assert line["event"] == "settings reloaded"
    assert line["logs_from"] == "error"
    assert line["needs_restart"] == ["node", "max_streams"]
    assert line["unreadable"] == {"models": "Permission denied"}
    assert level_as_before.level == logging.ERROR


def test_wrong_settings_change_nothing(level_as_before):
    before = level_as_before.level
    [line] = reload_with(ConfigError("config: queue_s='inf'"))
    assert (line["event"], line["why"]) == ("settings not reloaded", "config: queue_s='inf'")
    assert level_as_before.level == before


def test_a_hangup_calls_what_is_given_and_does_not_stop(signals_as_before):
    called = threading.Event()
    stop = stop_on_signals(on_hangup=called.set)
    os.kill(os.getpid(), signal.SIGHUP)
    assert called.wait(60)
    assert not stop.is_set()


def test_without_a_reload_a_hangup_stops(signals_as_before):
    stop = stop_on_signals()
    os.kill(os.getpid(), signal.SIGHUP)
    assert stop.wait(60)


@pytest.mark.parametrize("field", ["models_dir", "state_dir"])
def test_a_folder_that_is_a_file_is_refused_at_the_start_and_a_missing_one_is_not(field, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=f"config: {field}='.*file': Not a directory"):
        check_folders(ServiceConfig(**{field: tmp_path / "file"}))
    check_folders(ServiceConfig(**{field: tmp_path / "none"}))
    check_folders(ServiceConfig(**{field: tmp_path}))
