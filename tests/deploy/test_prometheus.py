"""The alerts for Prometheus: each is set off, and watches what a service really tells."""

import re
import shutil
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.deploy.docker import ROOT, missing
from tests.ports import free_port
from tests.processes.faults import PATIENCE_S, Site

from holdfast.transport.key_ring import make_credentials

RULES = ROOT / "deploy" / "prometheus" / "rules.yaml"
PLAYED = Path(__file__).with_name("prometheus_rules.yaml")
ADAPTER = ROOT / "deploy/kubernetes/overlays/autoscaled-on-decisions/prometheus-adapter.yaml"
SCRAPES = {
    "job": {},
    "pods by annotation": dict.fromkeys(("holdfast", "holdfast-robots"), "kubernetes-pods"),
    "PodMonitor": {"holdfast": "holdfast", "holdfast-robots": "holdfast-robot"},
}
"""What a scrape calls the jobs; of pods it tells the name and namespace, too."""

METRIC = re.compile(r"\b(?:holdfast|process)_\w+")


def promtool(*words: str | Path) -> subprocess.CompletedProcess[str]:
    if shutil.which("promtool") is None:
        missing("there is no command promtool (Debian: prometheus)")
    return subprocess.run(["promtool", *words], text=True, capture_output=True, check=False)


def played(text: str, directory: Path, scrape: str = "job", rules: Path = RULES) -> Path:
    """Return a file for promtool: what is played, with the labels of a scrape."""
    text = text.replace("../../deploy/prometheus/rules.yaml", str(rules))
    if scrape != "job":
        jobs = SCRAPES[scrape]
        for job, name in (("holdfast", "holdfast"), ("holdfast-robots", "holdfast-robot")):
            its = jobs.get(job, job)
            pod = rf'job="{its}",namespace="{name}",instance="10.0.0.7:8080",pod="\1"'
            text = re.sub(rf'job="{job}",instance="(\w)"', pod, text)
            pod = rf'job: {its}, namespace: {name}, instance: "10.0.0.7:8080", pod: \1'
            text = re.sub(rf"job: {job}, instance: (\w)", pod, text)
            text = text.replace(f"job: {job}}}", f"job: {its}, namespace: {name}}}")
            text = text.replace(f"'{job}: no service", f"'{its}: no service")
    (directory / "played.yaml").write_text(text)
    return directory / "played.yaml"


def alerts() -> dict[str, dict[str, Any]]:
    groups = yaml.safe_load(RULES.read_text())["groups"]
    return {rule["alert"]: rule for group in groups for rule in group["rules"]}


def adapter_rule() -> dict[str, Any]:
    (rule,) = yaml.safe_load(ADAPTER.read_text())["rules"]
    assert isinstance(rule, dict)
    return rule


def test_the_rules_are_in_order() -> None:
    done = promtool("check", "rules", RULES)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("scrape", SCRAPES)
def test_each_alert_is_set_off_by_what_it_is_for(scrape: str, tmp_path: Path) -> None:
    """Whatever scrapes: a job of one's own, pods by their annotations, or a PodMonitor."""
    done = promtool("test", "rules", played(PLAYED.read_text(), tmp_path, scrape))
    assert done.returncode == 0, done.stdout + done.stderr
    tests = yaml.safe_load(PLAYED.read_text())["tests"]
    cases = [each for test in tests for each in test["alert_rule_test"]]
    assert {each["alertname"] for each in cases if each["exp_alerts"]} == alerts().keys()
    assert {each["alertname"] for each in cases if not each["exp_alerts"]} == alerts().keys()


def test_a_rule_that_watches_for_nothing_is_found(tmp_path: Path) -> None:
    text, rules = RULES.read_text(), tmp_path / "rules.yaml"
    for alert in alerts().values():
        rules.write_text(text.replace(alert["alert"], f"{alert['alert']}Not"))
        file = played(PLAYED.read_text(), tmp_path, rules=rules)
        assert promtool("test", "rules", file).returncode != 0, alert["alert"]


def test_the_adapter_counts_decisions_in_progress(tmp_path: Path) -> None:
    """Half of each second is spent on computing and a quarter on waiting: 0.75 in the mean."""
    query = adapter_rule()["metricsQuery"].replace("<<.GroupBy>>", "pod")
    query = query.replace("<<.LabelMatchers>>", 'namespace="holdfast"')
    of = 'namespace="holdfast",pod="a"'
    (tmp_path / "played.yaml").write_text(
        yaml.safe_dump(
            {
                "rule_files": [str(RULES)],
                "tests": [
                    {
                        "interval": "15s",
                        "input_series": [
                            {"series": f"{name}{{{of}{kind}}}", "values": values}
                            for name, kind, values in (
                                ("holdfast_decision_seconds_sum", ',kind="task"', "0+3x40"),
                                ("holdfast_decision_seconds_sum", ',kind="sensing"', "0+4.5x40"),
                                ("holdfast_wait_seconds_sum", "", "0+3.75x40"),
                            )
                        ],
                        "promql_expr_test": [
                            {
                                "expr": query,
                                "eval_time": "5m",
                                "exp_samples": [{"labels": '{pod="a"}', "value": 0.75}],
                            }
                        ],
                    }
                ],
            }
        )
    )
    done = promtool("test", "rules", tmp_path / "played.yaml")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("processes", [1, 2])
def test_a_service_tells_all_that_is_watched(processes: int, site: Site) -> None:
    made = make_credentials(site.directory / "keys", services=["cloud"]).made[0]
    cloud = site.service(
        *("--tls", str(made.directory), "--metrics", "127.0.0.1:0", "--processes", str(processes)),
        endpoint=f"tls/127.0.0.1:{free_port()}",
    ).start()
    (ready,) = cloud.process.matching("ready")
    with urllib.request.urlopen(f"http://{ready['metrics']}/metrics", timeout=PATIENCE_S) as page:
        lines = page.read().decode().splitlines()
    told = {
        re.split(r"[{ ]", line)[0]: float(line.rpartition(" ")[2])
        for line in lines
        if line[:1] != "#"
    }
    rule = adapter_rule()
    watched = {
        name
        for text in (*(each["expr"] for each in alerts().values()), *map(str, rule.values()))
        for name in METRIC.findall(text)
        if not name.startswith("holdfast_robot_")  # tests/unit/test_robot_metrics.py
    } - {rule["name"]["as"]}
    assert watched
    assert watched <= told.keys()
    assert told["holdfast_ready"] == 1
    expires = told["holdfast_certificate_expiry_timestamp_seconds"]
    assert expires == int(made.expires.timestamp())
