import pytest

from neurove_core.models.bounds import UNCERTAIN_M_S, UNCERTAIN_RAD_S
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


def test_the_help_of_the_bounds_of_sigma_gives_the_values_that_hold_without_them():
    for field, bound in (("uncertain_m_s", UNCERTAIN_M_S), ("uncertain_rad_s", UNCERTAIN_RAD_S)):
        assert f"or {bound} [" in str(ServiceConfig.model_fields[field].description)


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


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("localhost:7447", "did you mean 'tcp/localhost:7447'?"),
        ("tcp://localhost:7447", "did you mean 'tcp/localhost:7447'?"),
        ("tls://box:7447", "did you mean 'tls/box:7447'?"),
        ("tcp:7447", "give PROTOCOL/HOST:PORT"),
        ("http/localhost:80", "the protocols are tcp, udp"),
        ("tcp/localhost", "no HOST:PORT after tcp/"),
        ("tcp/localhost:70000", "a port is at most 65535"),
        ("tcp/two words:1", "no HOST:PORT"),
        ("unixsock-stream/", "give unixsock-stream/PATH"),
    ],
)
@pytest.mark.parametrize("field", ["connect", "listen"])
def test_a_wrong_endpoint_is_explained_without_the_words_of_zenoh(field, endpoint, words):
    with pytest.raises(ConfigError) as raised:
        load(ServiceConfig, {field: f"tcp/127.0.0.1:1,{endpoint}"})
    assert f"{field}={endpoint!r} (from flag)" in raised.value.message
    assert words in raised.value.message


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/[::1]:7447", "quic/robot-7.local:0", "tcp/127.0.0.1:1?prio=1-3#iface=lo", "unixsock-stream//run/n.sock"],
)
def test_right_endpoints_stay(endpoint):
    assert load(ServiceConfig, {"connect": endpoint})[0].connect == (endpoint,)


def test_an_empty_variable_counts_as_unset(monkeypatch):
    for name in ("MODELS_DIR", "STATE_DIR", "ZENOH_CONFIG", "TRUSTED_KEYS", "LISTEN", "QUEUE_S", "NODE", "PORT"):
        monkeypatch.setenv(f"NEUROVE_{name}", " " if name == "NODE" else "")
    config, origin = load(ServiceConfig, {})
    assert config == ServiceConfig()
    assert set(origin.values()) == {"default"}


@pytest.mark.parametrize(
    ("given", "address"),
    [("9464", "127.0.0.1:9464"), (":9464", "127.0.0.1:9464"), ("[::1]:0", "[::1]:0"), ("0.0.0.0:80", "0.0.0.0:80")],
)
def test_metrics_are_for_this_machine_unless_a_host_is_given(given, address):
    assert load(ServiceConfig, {"metrics": given})[0].metrics == address


@pytest.mark.parametrize("given", ["", "localhost", "a:b", "127.0.0.1:70000", "http://localhost:9464", "tcp/a:1"])
def test_a_wrong_address_of_metrics_is_explained(given):
    with pytest.raises(ConfigError, match="metrics=.*(HOST:PORT|at most 65535)"):
        load(ServiceConfig, {"metrics": given})


def test_labels_are_a_table_of_the_file_or_the_text_of_a_flag(tmp_path):
    file = tmp_path / "neurove.toml"
    file.write_text('labels = {site = "hall-2", robot = "spot"}\n')
    assert load(ServiceConfig, {}, file)[0].labels == {"site": "hall-2", "robot": "spot"}
    assert load(ServiceConfig, {"labels": "site=hall-3, robot=spot"}, file)[0].labels["site"] == "hall-3"
    assert load(ServiceConfig, {})[0].labels == {}


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ("site", "'site' has no value"),
        ("a=1,a=2", "a name occurs twice"),
        ("model=x", "label 'model': this name is reserved"),
        ("site=hall 2", "its value 'hall 2' is not valid: 1 to 64 characters"),
        ("a/b=c", "its name 'a/b' is not valid"),
        (",".join(f"l{i}=x" for i in range(17)), "17 labels, at most 16"),
        ({"site": 3}, "valid string"),
    ],
)
def test_a_wrong_label_is_explained(labels, words):
    with pytest.raises(ConfigError, match="labels.*from flag") as raised:
        load(ServiceConfig, {"labels": labels})
    assert words in raised.value.message


@pytest.mark.parametrize("field", ["models_dir", "state_dir", "zenoh_config", "trusted_keys"])
def test_an_empty_path_is_refused_not_the_current_folder(field, tmp_path):
    with pytest.raises(ConfigError, match=f"{field}='' .from flag.: .*must not be empty"):
        load(ServiceConfig, {field: ""})
    file = tmp_path / "neurove.toml"
    empty = '[""]' if field == "trusted_keys" else '""'
    file.write_text(f"{field} = {empty}\n")
    with pytest.raises(ConfigError, match="must not be empty"):
        load(ServiceConfig, {}, file)


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_node_that_neither_listens_nor_connects_is_refused_unless_a_zenoh_configuration_has_endpoints(mode, tmp_path):
    with pytest.raises(ConfigError, match=f"{mode} mode needs an endpoint to listen on or to connect to"):
        load(ServiceConfig, {"mode": mode, "listen": ""})
    assert load(ServiceConfig, {"mode": mode, "listen": "", "connect": "tcp/127.0.0.1:1"})[0].listen == ()
    assert load(ServiceConfig, {"mode": mode, "listen": "", "zenoh_config": str(tmp_path)})[0].listen == ()


def test_variables_of_kubernetes_are_ignored_with_one_warning(monkeypatch, caplog):
    of_kubernetes = {
        "NEUROVE_SERVICE_HOST": "10.96.0.7",
        "NEUROVE_SERVICE_PORT": "7447",
        "NEUROVE_SERVICE_PORT_ZENOH": "7447",
        "NEUROVE_PORT": "tcp://10.96.0.7:7447",
        "NEUROVE_PORT_7447_TCP": "tcp://10.96.0.7:7447",
        "NEUROVE_PORT_7447_TCP_ADDR": "10.96.0.7",
        "NEUROVE_EDGE_SERVICE_HOST": "10.96.0.8",
    }
    for name, value in of_kubernetes.items():
        monkeypatch.setenv(name, value)
    config, _ = load(ServiceConfig, {})
    assert config == ServiceConfig()
    assert len(caplog.records) == 1
    assert "set by Kubernetes" in caplog.text
    assert all(name in caplog.text for name in of_kubernetes)


def test_a_byte_order_mark_in_a_file_is_no_content(tmp_path):
    file = tmp_path / "neurove.toml"
    file.write_bytes('\ufeffnode = "x"\n'.encode())
    assert load(ServiceConfig, {}, file)[0].node == "x"


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


def test_the_variables_of_the_engine_are_no_unknown_settings(monkeypatch):
    monkeypatch.setenv("NEUROVE_FORM", "sparse")
    monkeypatch.setenv("NEUROVE_AHEAD", "off")
    load(ServiceConfig, {})
