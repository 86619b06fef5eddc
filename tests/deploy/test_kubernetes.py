"""The manifests for Kubernetes: rendered, held against its schemas, and started as they say.

There is no cluster here. What one would do with the manifests is done by hand: a certificate is
made with the fields that cert-manager is told, files are mounted as the volume says, and ``serve``
runs with the container's own arguments.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
import urllib.request
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from tests.deploy.docker import ROOT
from tests.ports import free_port
from tests.processes.faults import COMMAND, PATIENCE_S, Site, document_of, services_in_order

from holdfast.transport.key_ring import make_credentials, revoke_credentials

KUBERNETES = ROOT / "deploy" / "kubernetes"
BASE = KUBERNETES / "base"
OVERLAYS = ("small", "autoscaled", "autoscaled-on-decisions")
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


def check(manifests: list[Manifest]) -> None:
    """Hold manifests against the schemas, and against each other."""
    for each in manifests:
        if each["apiVersion"] == "cert-manager.io/v1":
            continue  # no kind of Kubernetes's own: the package has no schema (see below)
        for version in VERSIONS:
            kubernetes_validate.validate(each, version, strict=True)
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
        assert each["kind"] == "Namespace" or each["metadata"].get("namespace") in (
            None,
            "holdfast",
        )
    for selector in selectors:
        assert selector
        assert selector.items() <= labels.items()
    for name in ("startupProbe", "livenessProbe", "readinessProbe"):
        assert container[name]["httpGet"]["port"] in ports
    check_certificate(manifests)


def check_certificate(manifests: list[Manifest]) -> None:
    """Look at cert-manager's kinds: whether they lead from our authority to the pod's files."""
    issuer = of_kind(manifests, "Issuer", "holdfast-authority")
    spec = of_kind(manifests, "Certificate")["spec"]
    assert issuer["spec"] == {"ca": {"secretName": "holdfast-authority"}}
    assert spec["issuerRef"]["name"] == issuer["metadata"]["name"]
    assert spec.keys() == {
        *("secretName", "issuerRef", "commonName", "dnsNames", "usages", "isCA"),
        *("duration", "renewBefore", "privateKey"),
    }
    assert 0 < len(spec["commonName"]) <= 64
    # Whoever steals it must not be able to ask as well.
    assert spec["usages"] == ["digital signature", "server auth"]
    services = [each["metadata"]["name"] for each in manifests if each["kind"] == "Service"]
    assert {f"{name}.holdfast.svc" for name in services} <= set(spec["dnsNames"])
    (secret,) = (each["secret"] for each in keys_volume(manifests)["sources"] if "secret" in each)
    assert secret["name"] == spec["secretName"]


def keys_volume(manifests: list[Manifest]) -> Manifest:
    (volume,) = (each for each in pod_of(manifests)["volumes"] if each["name"] == "keys")
    projected = volume["projected"]
    assert isinstance(projected, dict)
    return projected


@pytest.mark.parametrize("path", files_of_base(), ids=lambda path: path.name)
def test_a_file_of_the_base_alone(path: Path) -> None:
    manifests = read(path.read_text())
    assert manifests
    for each in manifests:
        if each["apiVersion"] != "cert-manager.io/v1":
            for version in VERSIONS:
                kubernetes_validate.validate(each, version, strict=True)


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
    assert keys_volume(manifests)["defaultMode"] == 0o440
    named = [each for each in manifests if each["kind"] != "Namespace"]
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
    assert kinds(manifests) == sorted([*kinds(base), "HorizontalPodAutoscaler"])
    (metric,) = of_kind(manifests, "HorizontalPodAutoscaler")["spec"]["metrics"]
    if overlay == "autoscaled":
        assert metric["resource"]["name"] == "cpu"
        assert "cpu" in container_of(manifests)["resources"]["requests"]
    else:
        assert metric["pods"]["metric"]["name"] == adapter_rule()["name"]["as"]


def adapter_rule() -> Manifest:
    path = KUBERNETES / "overlays" / "autoscaled-on-decisions" / "prometheus-adapter.yaml"
    (rule,) = yaml.safe_load(path.read_text())["rules"]
    assert isinstance(rule, dict)
    return rule


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


def issued(spec: Manifest, authority: Path, key: Path) -> dict[str, bytes]:
    """Return the Secret that cert-manager makes for a Certificate, with an Issuer's CA."""
    assert spec["privateKey"] == {
        "algorithm": "ECDSA",
        "size": 256,
        "encoding": "PKCS8",
        "rotationPolicy": "Always",
    }
    signed_by = x509.load_pem_x509_certificate(authority.read_bytes())
    signs_with = load_pem_private_key(key.read_bytes(), None)
    assert isinstance(signs_with, ec.EllipticCurvePrivateKey)
    own = ec.generate_private_key(ec.SECP256R1())
    usages = set(spec["usages"])
    extended = {
        "server auth": ExtendedKeyUsageOID.SERVER_AUTH,
        "client auth": ExtendedKeyUsageOID.CLIENT_AUTH,
    }
    assert usages <= {"digital signature", "key encipherment", *extended}
    hours = int(spec["duration"].removesuffix("h"))
    now = datetime.now(UTC)
    others = dict.fromkeys(
        (
            *("content_commitment", "data_encipherment", "key_agreement", "key_cert_sign"),
            *("crl_sign", "encipher_only", "decipher_only"),
        ),
        False,
    )
    usage = x509.KeyUsage(
        digital_signature="digital signature" in usages,
        key_encipherment="key encipherment" in usages,
        **others,
    )
    certificate = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, spec["commonName"])]))
        .issuer_name(signed_by.subject)
        .public_key(own.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now)
        .not_valid_after(now + timedelta(hours=hours))
        .add_extension(x509.BasicConstraints(ca=spec["isCA"], path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([extended[each] for each in sorted(usages & extended.keys())]),
            critical=False,
        )
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signs_with.public_key()),
            critical=False,
        )
        .add_extension(
            x509.SubjectAlternativeName([x509.DNSName(each) for each in spec["dnsNames"]]),
            critical=False,
        )
        .sign(signs_with, hashes.SHA256())
    )
    return {
        "tls.crt": certificate.public_bytes(Encoding.PEM),
        "tls.key": own.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
        "ca.crt": authority.read_bytes(),
    }


def mount(
    volume: Manifest, directory: Path, objects: dict[str, dict[str, bytes]], group: int
) -> None:
    """Write what a projected volume shows, in place of what it showed, as the kubelet does."""
    directory.mkdir(exist_ok=True)
    new = directory / f"..{len(list(directory.iterdir()))}"
    new.mkdir()
    for source in volume["sources"]:
        ((kind, told),) = source.items()
        if told["name"] not in objects:
            assert told.get("optional"), f"no {kind} {told['name']}: the pod would not start"
            continue
        for item in told["items"]:
            file = new / item["path"]
            file.write_bytes(objects[told["name"]][item["key"]])
            file.chmod(volume["defaultMode"])
            os.chown(file, 0, group)
            if not (directory / item["path"]).is_symlink():
                (directory / item["path"]).symlink_to(Path("..data") / item["path"])
    (directory / "..new").symlink_to(new.name)
    (directory / "..new").rename(directory / "..data")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
def test_a_robot_decides_through_what_the_manifests_start(site: Site) -> None:
    manifests = base()
    pod, container = pod_of(manifests), container_of(manifests)
    user = pod["securityContext"]
    home, keys = site.directory / "home", site.directory / "keys"
    make_credentials(home, robots=["robot", "berta"])
    spec = of_kind(manifests, "Certificate")["spec"]
    authority, key = home / "authority" / "authority.pem", home / "authority" / "authority.key"
    objects = {spec["secretName"]: issued(spec, authority, key)}
    mount(keys_volume(manifests), keys, objects, group=user["fsGroup"])

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
    hosts.write_text(f"127.0.0.1 localhost {' '.join(spec['dnsNames'])}\n")
    own_hosts = (
        "unshare",
        "--mount",
        "sh",
        "-c",
        f'mount --bind "{hosts}" /etc/hosts && exec "$@"',
    )
    file = site.configure(document_of("peg_in_hole_2d", max_steps=20))
    options = ("--tls", home / "robot", "--rate", "10000", "--recovery", "never")
    endpoint = f"tls/{spec['dnsNames'][1]}:{ports[0]}"
    robot = site.run(file, *options, services=[endpoint], command=(*own_hosts, "sh", *COMMAND))
    robot.finish()
    assert services_in_order(robot) == [endpoint]

    # cert-manager renews, and somebody makes the list of what is revoked: the service notices.
    revoke_credentials(home, names=["berta"])
    objects[spec["secretName"]] = issued(spec, authority, key)
    objects["holdfast-revoked"] = {"revoked.pem": (home / "authority" / "revoked.pem").read_bytes()}
    mount(keys_volume(manifests), keys, objects, group=user["fsGroup"])
    cloud.wait_for("credentials_reloaded", num_revoked=1)
