import pytest

from neurove_service.config import ClientConfig, ConfigError, ServiceConfig, load


def test_each_layer_overrides_the_previous_one_and_is_named_as_the_source(tmp_path, monkeypatch):
    file = tmp_path / "neurove.toml"
    file.write_text('node = "of-file"\nqueue_s = 2.0\nmax_streams = 3\n')
    monkeypatch.setenv("NEUROVE_QUEUE_S", "4.0")
    monkeypatch.setenv("NEUROVE_MAX_STREAMS", "5")
    config, origin = load(ServiceConfig, {"max_streams": "7", "model": None}, file)
    assert (config.node, config.queue_s, config.max_streams, config.model) == ("of-file", 4.0, 7, "default")
    assert origin["node"] == f"file {file}"
    assert (origin["queue_s"], origin["max_streams"], origin["model"]) == ("environment", "flag", "default")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"queue_s": "0"}, ["queue_s='0'", "flag", "greater than 0"]),
        ({"queue_mib": "99999"}, ["queue_mib", "4096"]),
        ({"node": "a/b"}, ["node='a/b'", "characters"]),
        ({"prefix": "neurove/*"}, ["prefix", "chunks"]),
        ({"mode": "bridge"}, ["mode='bridge'", "client"]),
        ({"mode": "client"}, ["connect", "client mode needs an endpoint"]),
        ({"log_level": "loud"}, ["log_level", "debug"]),
    ],
)
def test_an_error_names_the_field_the_value_the_bound_and_the_source(flags, words):
    with pytest.raises(ConfigError) as raised:
        load(ServiceConfig, flags)
    for word in words:
        assert word in raised.value.message


def test_an_unknown_key_of_a_file_or_the_environment_is_an_error(tmp_path, monkeypatch):
    file = tmp_path / "neurove.toml"
    file.write_text("que_s = 2.0\n")
    with pytest.raises(ConfigError, match=r"que_s=2.0 \(from file .*unknown setting; known settings: .*queue_s"):
        load(ServiceConfig, {}, file)
    monkeypatch.setenv("NEUROVE_NOED", "x")
    with pytest.raises(ConfigError, match=r"noed='x' \(from environment\): unknown setting"):
        load(ClientConfig, {})


def test_a_client_ignores_settings_of_the_service_in_the_environment(monkeypatch):
    monkeypatch.setenv("NEUROVE_QUEUE_S", "4.0")
    monkeypatch.setenv("NEUROVE_CONNECT", "tcp/127.0.0.1:1, tcp/127.0.0.1:2")
    config, _ = load(ClientConfig, {})
    assert config.connect == ("tcp/127.0.0.1:1", "tcp/127.0.0.1:2")


@pytest.mark.parametrize("text", ["node = ", "\xff\xfe", None])
def test_an_unreadable_file_is_named(tmp_path, text):
    file = tmp_path / "neurove.toml"
    if text is not None:
        file.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match="config file .*neurove.toml: "):
        load(ServiceConfig, {}, file)


def test_in_client_mode_the_service_listens_only_if_configured():
    config, _ = load(ServiceConfig, {"mode": "client", "connect": "tcp/127.0.0.1:7447"})
    assert config.listen == ()
    explicit, _ = load(ServiceConfig, {"mode": "client", "connect": "tcp/127.0.0.1:7447", "listen": "tcp/127.0.0.1:9"})
    assert explicit.listen == ("tcp/127.0.0.1:9",)
