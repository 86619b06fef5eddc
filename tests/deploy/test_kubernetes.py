"""The manifests for Kubernetes: rendered, held against its schemas, and started as they say.

There is no cluster here. What one would do with the manifests is done by hand: files are mounted as
the volume says, and ``serve`` and ``run`` have the containers' own arguments. ``custom_kinds.json``
has the schemas of kinds that are not Kubernetes's own, strict, of the package
cloudcoil-models-prometheus-operator 0.80.
"""

import json
import os
import re
import shutil
import subprocess
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import yaml
from tests.deploy.docker import ROOT
from tests.deploy.test_prometheus import adapter_rule
from tests.ports import free_port
from tests.processes.faults import COMMAND, PATIENCE_S, Site, document_of, services_in_order

from holdfast.transport.key_ring import make_credentials, revoke_credentials

KUBERNETES = ROOT / "deploy" / "kubernetes"
BASE = KUBERNETES / "base"
OVERLAYS = ("small", "outside", "autoscaled", "autoscaled-on-decisions")
CUSTOM = json.loads(Path(__file__).with_name("custom_kinds.json").read_text())
VERSIONS = ("1.30", kubernetes_validate.latest_version())
"""The oldest that has ``preStop.sleep``, and the newest whose schemas there are."""

CLOSING_S = 1.4
"""What ending takes beside the drain; ``holdfast.service.process`` bounds it."""

Manifest = dict[str, Any]


def read(text: str) -> list[Manifest]:
    return [each for each in yaml.safe_load_all(text) if each]


def files_of_base() -> list[Path]:
    return [
        BASE / name
        for name in yaml.safe_load((BASE / "kustomization.yaml").read_text())["resources"]
    ]


def base() -> list[Manifest]:
    return [each for path in files_of_base() for each in read(path.read_text())]


def rendered(directory: Path) -> list[Manifest]:
    if shutil.which("kubectl") is None:
        pytest.skip("there is no kubectl, which renders overlays; Debian's is too old for them")
    done = subprocess.run(
        ["kubectl", "kustomize", directory], text=True, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return read(done.stdout)


def of_kind(manifests: list[Manifest], kind: str, name: str = "holdfast") -> Manifest:
    (found,) = (
        each for each in manifests if each["kind"] == kind and each["metadata"]["name"] == name
    )
    return found


def kinds(manifests: list[Manifest]) -> list[str]:
    return sorted(each["kind"] for each in manifests)


def pod_of(manifests: list[Manifest]) -> Manifest:
    pod = of_kind(manifests, "Deployment")["spec"]["template"]["spec"]
    assert isinstance(pod, dict)
    return pod


def container_of(manifests: list[Manifest]) -> Manifest:
    (container,) = pod_of(manifests)["containers"]
    assert isinstance(container, dict)
    return container


def check_schemas(manifests: list[Manifest]) -> None:
    assert manifests
    for each in manifests:
        if each["apiVersion"] == "monitoring.coreos.com/v1":
            jsonschema.validate(each, CUSTOM[each["kind"]])
        else:
            for version in VERSIONS:
                kubernetes_validate.validate(each, version, strict=True)


def check(manifests: list[Manifest]) -> None:
    """Hold manifests against the schemas, and against each other."""
    check_schemas(manifests)
    deployment = of_kind(manifests, "Deployment")
    template = deployment["spec"]["template"]
    labels = template["metadata"]["labels"]
    selectors = [deployment["spec"]["selector"]["matchLabels"]]
    selectors += [
        each["labelSelector"]["matchLabels"]
        for each in template["spec"].get("topologySpreadConstraints", ())
    ]
    container = container_of(manifests)
    ports = {each["name"]: each for each in container["ports"]}
    for each in manifests:
        spec = each.get("spec", {})
        match each["kind"]:
            case "Service":
                selectors.append(spec["selector"])
                for port in spec["ports"]:
                    target = ports[port["targetPort"]]
                    assert (target["containerPort"], target["protocol"]) == (
                        port["port"],
                        port["protocol"],
                    )
            case "PodDisruptionBudget":
                selectors.append(spec["selector"]["matchLabels"])
            case "NetworkPolicy":
                selectors.append(spec["podSelector"]["matchLabels"])
                let_in = {
                    (port["port"], port["protocol"])
                    for rule in spec["ingress"]
                    for port in rule["ports"]
                }
                assert let_in == {
                    (port["containerPort"], port["protocol"]) for port in ports.values()
                }
            case "HorizontalPodAutoscaler":
                target = spec["scaleTargetRef"]
                assert [target["apiVersion"], target["kind"], target["name"]] == [
                    deployment["apiVersion"],
                    "Deployment",
                    deployment["metadata"]["name"],
                ]
                assert "replicas" not in deployment["spec"]
        assert each["metadata"].get("namespace") in (None, "holdfast")
    for selector in selectors:
        assert selector
        assert selector.items() <= labels.items()
    for name in ("startupProbe", "livenessProbe", "readinessProbe"):
        assert container[name]["httpGet"]["port"] in ports
    names = {(each["kind"], each["metadata"]["name"]) for each in manifests}
    pod = template["spec"]
    assert ("ServiceAccount", pod["serviceAccountName"]) in names
    assert ("PriorityClass", pod["priorityClassName"]) in names
    assert not pod["automountServiceAccountToken"]


def secret_of(pod: Manifest, name: str) -> Manifest:
    """Return the Secret that a volume of a pod shows."""
    (volume,) = (each for each in pod["volumes"] if each["name"] == name)
    secret = volume["secret"]
    assert isinstance(secret, dict)
    return secret


@pytest.mark.parametrize("path", files_of_base(), ids=lambda path: path.name)
def test_a_file_of_the_base_alone(path: Path) -> None:
    check_schemas(read(path.read_text()))


def test_the_base_as_it_is_written() -> None:
    check(base())


def test_what_is_wrong_is_found() -> None:
    wrong = base()
    container_of(wrong)["livenessProbes"] = {}
    with pytest.raises(kubernetes_validate.ValidationError):
        check(wrong)
    wrong = base()
    of_kind(wrong, "Service")["spec"]["selector"] = {"app": "holdfast"}
    with pytest.raises(AssertionError):
        check(wrong)


def test_the_base_rendered() -> None:
    manifests = rendered(BASE)
    check(manifests)
    assert kinds(manifests) == kinds(base())
    assert secret_of(pod_of(manifests), "keys")["defaultMode"] == 0o440
    named = [each for each in manifests if each["kind"] not in ("Namespace", "PriorityClass")]
    assert {each["metadata"]["namespace"] for each in named} == {"holdfast"}


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_an_overlay(overlay: str) -> None:
    manifests = rendered(KUBERNETES / "overlays" / overlay)
    check(manifests)
    base = rendered(BASE)
    if overlay == "small":
        assert kinds(base) == sorted([*kinds(manifests), "PodDisruptionBudget"])
        assert of_kind(manifests, "Deployment")["spec"]["replicas"] == 1
        assert "topologySpreadConstraints" not in pod_of(manifests)
        args = [*container_of(base)["args"], "--max-decision-mb=64"]
        assert container_of(manifests)["args"] == args
        assert "cpu" not in container_of(manifests)["resources"]["limits"]
        return
    if overlay == "outside":
        service = of_kind(manifests, "Service")["spec"]
        assert service["type"] == "LoadBalancer"
        assert [each["protocol"] for each in service["ports"]] == ["UDP", "TCP"]
        assert of_kind(manifests, "Deployment")["spec"]["replicas"] == 1
        assert container_of(manifests)["args"][1] == "--listen=udp/0.0.0.0:7447"
        return
    assert kinds(manifests) == sorted([*kinds(base), "HorizontalPodAutoscaler"])
    (metric,) = of_kind(manifests, "HorizontalPodAutoscaler")["spec"]["metrics"]
    if overlay == "autoscaled":
        assert metric["resource"]["name"] == "cpu"
        assert "cpu" in container_of(manifests)["resources"]["requests"]
    else:
        assert metric["pods"]["metric"]["name"] == adapter_rule()["name"]["as"]


def test_an_overlay_of_ones_own_says_where_the_image_is(tmp_path: Path) -> None:
    tree = shutil.copytree(KUBERNETES, tmp_path / "kubernetes")
    overlay = tree / "overlays/mine"
    for base, image in (("../../base", "holdfast-cloud"), ("../../robot", "holdfast-robot")):
        overlay.mkdir(exist_ok=True)
        images = f"images: [{{name: {image}, newName: registry.example.org/x, newTag: 0.1.0}}]"
        (overlay / "kustomization.yaml").write_text(f"resources: [{base}]\n{images}\n")
        (used,) = re.findall(r"image: (.*)", yaml.safe_dump(rendered(overlay)))
        assert used == "registry.example.org/x:0.1.0"


def test_what_the_prometheus_operator_is_given() -> None:
    manifests = rendered(KUBERNETES / "monitoring")
    check_schemas(manifests)
    monitor, rule = of_kind(manifests, "PodMonitor"), of_kind(manifests, "PrometheusRule")
    assert rule["spec"] == yaml.safe_load((ROOT / "deploy/prometheus/rules.yaml").read_text())
    spec = monitor["spec"]
    (names,) = spec["selector"]["matchExpressions"]
    (endpoint,) = spec["podMetricsEndpoints"]
    pods = [of_kind(base(), "Deployment")["spec"]["template"], robot_pod()]
    for pod in pods:
        assert pod["metadata"]["labels"][names["key"]] in names["values"]
        (container,) = pod["spec"]["containers"]
        assert endpoint["port"] in {each["name"] for each in container["ports"]}
        assert "--metrics=0.0.0.0:8080" in container["args"]
    wrong = {**monitor, "spec": {**spec, "podMetricsEndpoint": []}}
    with pytest.raises(jsonschema.ValidationError):
        check_schemas([wrong])


def robot_pod() -> Manifest:
    return of_kind(rendered(KUBERNETES / "robot"), "Pod", "holdfast-robot")


def test_a_robot_is_started_by_a_person_alone() -> None:
    manifests = rendered(KUBERNETES / "robot")
    check_schemas(manifests)
    pod = robot_pod()["spec"]
    assert pod["restartPolicy"] == "Never"
    (container,) = pod["containers"]
    assert {"--restart", "--resume-if-begun"} <= set(container["args"])
    names = {(each["kind"], each["metadata"]["name"]) for each in manifests}
    assert ("ServiceAccount", pod["serviceAccountName"]) in names
    for volume in pod["volumes"]:
        claim, config = volume.get("persistentVolumeClaim"), volume.get("configMap")
        assert claim is None or ("PersistentVolumeClaim", claim["claimName"]) in names
        assert config is None or ("ConfigMap", config["name"]) in names
    assert container["securityContext"] == container_of(base())["securityContext"]
    assert pod["securityContext"] == pod_of(base())["securityContext"]


def test_the_pod_is_given_as_long_as_it_takes_to_end() -> None:
    done = subprocess.run([*COMMAND, "serve", "--help"], text=True, capture_output=True, check=True)
    found = re.search(r"--drain-s.*?default:?\s*([\d.]+)", done.stdout, re.DOTALL)
    assert found, done.stdout
    pod, container = pod_of(base()), container_of(base())
    assert not [each for each in container["args"] if each.startswith("--drain-s")]
    needed_s = container["lifecycle"]["preStop"]["sleep"]["seconds"] + float(found[1]) + CLOSING_S
    assert pod["terminationGracePeriodSeconds"] > needed_s


def test_the_pod_runs_the_image_as_the_image_is_made() -> None:
    recipe = (ROOT / "deploy" / "Containerfile").read_text()
    pod, container = pod_of(base()), container_of(base())
    assert f"--target cloud -t {container['image']} ." in recipe
    user = pod["securityContext"]
    assert f"USER {user['runAsUser']}:{user['runAsGroup']}" in recipe
    (exposed,) = re.findall(r"^EXPOSE (7447.*)$", recipe, re.MULTILINE)
    assert set(exposed.split()) == {
        f"{each['containerPort']}/{each['protocol'].lower()}" for each in container["ports"]
    }
    (words,) = (
        json.loads(found)
        for found in re.findall(r"^CMD (\[.*\])$", recipe, re.MULTILINE)
        if '"serve"' in found
    )
    ours = [word for each in container["args"] for word in each.split("=")]
    assert ours[: len(words)] == words
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }


# As a cluster would do it


@pytest.fixture
def site() -> Iterator[Site]:
    # Not below pytest's own directories, which no other user may enter.
    with tempfile.TemporaryDirectory() as name, Site(Path(name)) as site:
        site.directory.chmod(0o755)
        yield site


def mount(secret: Manifest, keys: Path, directory: Path, group: int) -> None:
    """Write what a Secret of these keys shows, in place of what it showed, as the kubelet does."""
    directory.mkdir(exist_ok=True)
    new = directory / f"..{len(list(directory.iterdir()))}"
    new.mkdir()
    for path in keys.iterdir():
        file = new / path.name
        file.write_bytes(path.read_bytes())
        file.chmod(secret["defaultMode"])
        os.chown(file, 0, group)
        if not (directory / path.name).is_symlink():
            (directory / path.name).symlink_to(Path("..data") / path.name)
    (directory / "..new").symlink_to(new.name)
    (directory / "..new").rename(directory / "..data")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
def test_a_robot_decides_through_what_the_manifests_start(site: Site) -> None:
    manifests = base()
    pod, container = pod_of(manifests), container_of(manifests)
    user = pod["securityContext"]
    home, keys = site.directory / "home", site.directory / "keys"
    robot_spec = robot_pod()["spec"]
    configuration = yaml.safe_load((KUBERNETES / "robot/configuration.yaml").read_text())
    (endpoint,) = configuration["offload"]["services"]
    host = endpoint.removeprefix("tls/").removesuffix(":7447")
    services = {each["metadata"]["name"] for each in manifests if each["kind"] == "Service"}
    assert host in {f"{each}.holdfast.svc" for each in services}
    make_credentials(home, robots=["robot", "berta"], services=["service"], hosts=[host])
    secret = secret_of(pod, "keys")
    assert secret["secretName"] != secret_of(robot_spec, "keys")["secretName"]
    mount(secret, home / "service", keys, group=user["fsGroup"])

    ports = [free_port(), free_port()]
    words = " ".join(container["args"]).replace("/keys", str(keys))
    for port, named in zip(ports, ("robots", "health"), strict=True):
        (inside,) = (each["containerPort"] for each in container["ports"] if each["name"] == named)
        assert f"0.0.0.0:{inside}" in words
        words = words.replace(f"0.0.0.0:{inside}", f"127.0.0.1:{port}")
    as_user = (f"--reuid={user['runAsUser']}", f"--regid={user['runAsGroup']}", "--clear-groups")
    cloud = site.process("setpriv", *as_user, *COMMAND, *words.split())
    cloud.wait_for("ready")
    assert cloud.matching("credentials") == []
    for name in ("startupProbe", "livenessProbe", "readinessProbe"):
        place = f"http://127.0.0.1:{ports[1]}{container[name]['httpGet']['path']}"
        with urllib.request.urlopen(place, timeout=PATIENCE_S) as answer:
            assert answer.status == 200

    # The robot calls it as in the cluster; the names are its own, and nobody else sees them.
    hosts = site.directory / "hosts"
    hosts.write_text(f"127.0.0.1 localhost {host}\n")
    script = f'mount --bind "{hosts}" /etc/hosts && exec "$@"'
    own_hosts = ("unshare", "--mount", "sh", "-c", script)
    file = site.configure(document_of("peg_in_hole_2d", max_steps=20))
    options = ("--tls", home / "robot", "--rate", "10000", "--recovery", "never")
    endpoint = f"tls/{host}:{ports[0]}"
    robot = site.run(file, *options, services=[endpoint], command=(*own_hosts, "sh", *COMMAND))
    robot.finish()
    assert services_in_order(robot) == [endpoint]

    # It is renewed, and a robot revoked: the Secret is made again, and the service notices.
    revoke_credentials(home, names=["berta"])
    mount(secret, home / "service", keys, group=user["fsGroup"])
    cloud.wait_for("credentials_reloaded", num_revoked=1)
