"""deploy/prometheus and deploy/grafana: promtool accepts them, alerts fire, and they name only metrics that exist."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from neurove_service.metrics.families import Fleet, exposition
from tests.protocol.messages import STATUS
from tests.service.metrics.test_families import reply, status

DEPLOY = Path(__file__).parents[2] / "deploy"
PROMETHEUS = DEPLOY / "prometheus"
ALERTS = (PROMETHEUS / "neurove-alerts.yml").read_text()
DASHBOARD = (DEPLOY / "grafana" / "neurove.json").read_text()


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed (Debian: prometheus)")
@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("check", "config"), "prometheus.yml"),
        (("check", "rules"), "neurove-alerts.yml"),
        (("test", "rules"), "neurove-alerts-test.yml"),
    ],
)
def test_promtool_accepts(words, file):
    ran = subprocess.run(
        ["promtool", *words, file], cwd=PROMETHEUS, capture_output=True, text=True, check=False, timeout=120
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "SUCCESS" in ran.stdout


def test_every_alert_fires_in_the_tests_of_the_rules():
    alerts = set(re.findall(r"- alert: (\w+)", ALERTS))
    tested = set(re.findall(r'alertname="(\w+)"', (PROMETHEUS / "neurove-alerts-test.yml").read_text()))
    assert alerts == tested


@pytest.mark.parametrize("text", [ALERTS, DASHBOARD], ids=["alerts", "dashboard"])
def test_only_metrics_that_a_node_has_are_named(text):
    fleet = Fleet([reply(streams=[status()], internal_errors={"packet": 1})])
    known = set(re.findall(r"^(neurove_\w+)", exposition(fleet).decode(), re.MULTILINE))
    expressions = re.findall(r'expr"?: (.*)', text) + re.findall(r'"definition": (.*)', text)
    named = {name for one in expressions for name in re.findall(r"neurove_\w+", one)}
    assert len(named) > 8
    assert named - known == set()


def test_the_dashboard_has_a_description_for_every_panel_and_no_two_overlap():
    dashboard = json.loads(DASHBOARD)
    taken = set()
    for panel in dashboard["panels"]:
        assert panel["description"].endswith(".")
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken
        assert place["x"] + place["w"] <= 24
        taken |= cells
    assert {"node", "stream"} <= {one["name"] for one in dashboard["templating"]["list"]}
    assert STATUS["stream"] not in DASHBOARD  # no stream and no node is hard-wired
