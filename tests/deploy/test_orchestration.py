"""compose.yaml and the manifests of Kubernetes: valid by strict schemas, confined, and true to the service."""

import os
import re
import shutil
import subprocess
import sys
from http import HTTPStatus
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from neurove_service.config import ServiceConfig, load
from neurove_service.metrics.exporter import Exporter
from neurove_service.metrics.families import Fleet
from tests.service.metrics.test_families import reply

DEPLOY = Path(__file__).parents[2] / "deploy"
COMPOSE, MANIFESTS = DEPLOY / "compose.yaml", DEPLOY / "kubernetes" / "neurove.yaml"
IMAGE = (DEPLOY / "Containerfile").read_text()
OBJECTS = {one["kind"]: one for one in YAML(typ="safe").load_all(MANIFESTS.read_text())}
POD = OBJECTS["DaemonSet"]["spec"]["template"]["spec"]
SERVICE = YAML(typ="safe").load(COMPOSE.read_text())["services"]["neurove"]


def checked(tool, *arguments):
    found = shutil.which(tool, path=os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
    if found is None:
        pytest.skip(f"{tool} is not installed (extra dev)")
    return subprocess.run([found, *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False)


def image_environment():
    return dict(re.findall(r"^(?:ENV|   ) (NEUROVE_[A-Z_]+)=(\S*)", IMAGE, re.MULTILINE))


def test_kubernetes_accepts_the_manifests_and_would_name_an_unknown_field(tmp_path):
    ran = checked("kubernetes-validate", "--strict", MANIFESTS)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    misspelt = tmp_path / "neurove.yaml"
    misspelt.write_text(MANIFESTS.read_text().replace("readOnlyRootFilesystem", "readOnlyRootFileSystem"))
    assert checked("kubernetes-validate", "--strict", misspelt).returncode != 0


def test_compose_accepts_its_file_and_would_name_an_unknown_field(tmp_path):
    ran = checked("check-jsonschema", "--builtin-schema", "vendor.compose-spec", COMPOSE)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    misspelt = tmp_path / "compose.yaml"
    misspelt.write_text(COMPOSE.read_text().replace("read_only:", "readonly:"))
    assert checked("check-jsonschema", "--builtin-schema", "vendor.compose-spec", misspelt).returncode != 0


def test_every_container_of_the_pod_is_confined_and_limited():
    assert POD["securityContext"]["runAsNonRoot"]
    assert POD["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert POD["automountServiceAccountToken"] is False
    for container in (*POD["initContainers"], *POD["containers"]):
        context = container["securityContext"]
        assert context["readOnlyRootFilesystem"]
        assert context["allowPrivilegeEscalation"] is False
        assert context["capabilities"] == {"drop": ["ALL"]}
        assert {"cpu", "memory"} <= set(container["resources"]["limits"])
    user = re.search(r"^USER (\d+)$", IMAGE, re.MULTILINE)
    assert user is not None
    assert POD["securityContext"]["runAsUser"] == int(user[1])
    assert SERVICE["user"].startswith(user[1])


def test_the_service_of_compose_is_confined_and_reachable_from_this_machine_only():
    assert SERVICE["read_only"]
    assert SERVICE["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in SERVICE["security_opt"]
    assert all(port.startswith("127.0.0.1:") for port in SERVICE["ports"])


def test_probes_ask_paths_that_the_service_answers_at_the_port_where_it_listens(monkeypatch):
    (container,) = POD["containers"]
    exporter = Exporter(lambda: Fleet([reply()]), str, str)
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    for name in ("startupProbe", "livenessProbe", "readinessProbe"):
        asked = container[name]["httpGet"]
        assert exporter.respond(asked["path"]).status is HTTPStatus.OK
        assert asked["port"] == "metrics"
    assert container["livenessProbe"]["httpGet"]["path"] == "/live"
    given = {one["name"]: one.get("value", "robot-1.local") for one in container["env"]}
    for name, value in {**image_environment(), **given}.items():
        monkeypatch.setenv(name, value)
    config, _ = load(ServiceConfig, {})
    assert config.metrics == f"0.0.0.0:{ports['metrics']}"
    assert config.listen == (f"tcp/0.0.0.0:{ports['zenoh']}",)
    assert config.node == "robot-1.local"
    (port,) = OBJECTS["Service"]["spec"]["ports"]
    assert port["port"] == ports["zenoh"]


def test_the_settings_of_compose_load_on_top_of_those_of_the_image(monkeypatch):
    given = SERVICE["environment"] | {"NEUROVE_NODE": "edge"}
    for name, value in {**image_environment(), **given}.items():
        monkeypatch.setenv(name, value)
    config, _ = load(ServiceConfig, {})
    host, _, port = config.metrics.rpartition(":")
    assert (host, f"127.0.0.1:{port}:{port}" in SERVICE["ports"]) == ("0.0.0.0", True)
    assert f":{port}/live" in SERVICE["healthcheck"]["test"][-1]


def test_what_is_written_at_run_time_lies_on_a_volume():
    (container,) = POD["containers"]
    mounted = {one["mountPath"] for one in container["volumeMounts"]}
    kept = {one.split(":")[1] for one in SERVICE["volumes"]} | {"/tmp"}
    for variable in ("NEUROVE_MODELS_DIR", "NUMBA_CACHE_DIR"):
        folder = re.search(rf"{variable}=(\S+)", IMAGE)
        assert folder is not None
        assert folder[1] in mounted & kept


def test_the_health_check_of_the_image_asks_live_at_the_address_of_its_settings():
    checks = re.search(r"^HEALTHCHECK .*\n\s+CMD (\[.*\])$", IMAGE, re.MULTILINE)
    assert checks is not None
    assert "/live" in checks[1]
    assert "NEUROVE_METRICS" in checks[1]
    assert image_environment()["NEUROVE_METRICS"].startswith("127.0.0.1:")
