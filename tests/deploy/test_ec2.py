"""EC2 by Terraform: what is written is what the provider takes. No cloud and no provider is here.

``aws_schema.json`` has the arguments that the provider hashicorp/aws 6.25 takes, of the package
cdktf-cdktf-provider-aws 21.22; ``terraform validate`` would have to fetch the provider.
"""

import copy
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import hcl2
import pytest
from tests.deploy.docker import ROOT

EC2 = ROOT / "deploy/ec2"
TEXT = (EC2 / "main.tf").read_text(encoding="utf-8")
SCHEMA = json.loads(Path(__file__).with_name("aws_schema.json").read_text())
OF_TERRAFORM = {"for_each", "lifecycle"}


def blocks(document: Any, kind: str) -> dict[tuple[str, ...], Any]:
    """Return the bodies of all blocks of a kind, by their labels."""
    labels = {"resource": 2, "data": 2}.get(kind, 1)
    found = {}
    for each in document[kind]:
        names: tuple[str, ...] = ()
        for _ in range(labels):
            ((name, each),) = ((k, v) for k, v in each.items() if not k.startswith("__"))
            names = (*names, name.strip('"'))
        found[names] = each
    return found


def check(document: Any) -> None:
    for kind in ("resource", "data"):
        for (resource, _), body in blocks(document, kind).items():
            check_body(body, SCHEMA[resource], resource)


def check_body(body: dict[str, Any], schema: dict[str, Any], place: str) -> None:
    given = {name for name in body if not name.startswith("__")} - OF_TERRAFORM
    assert given <= {*schema["required"], *schema["optional"]}, place
    assert given >= set(schema["required"]), place
    for name, of_block in schema.get("blocks", {}).items():
        for block in body.get(name, ()):
            check_body(block, of_block, f"{place}.{name}")


def test_each_argument_is_one_that_the_provider_takes() -> None:
    document = hcl2.loads(TEXT)
    check(document)
    wrong = copy.deepcopy(document)
    blocks(wrong, "resource")["aws_instance", "holdfast"]["image"] = "x"
    with pytest.raises(AssertionError, match="aws_instance"):
        check(wrong)


def test_each_reference_leads_to_something() -> None:
    document = hcl2.loads(TEXT)
    there = {f"var.{name}" for (name,) in blocks(document, "variable")}
    there |= {".".join(names) for names in blocks(document, "resource")}
    there |= {f"data.{'.'.join(names)}" for names in blocks(document, "data")}
    used = set(re.findall(r"\b(var\.\w+|data\.aws_\w+\.\w+|(?<!data\.)aws_\w+\.\w+)", TEXT))
    assert used <= there
    assert {f"var.{name}" for (name,) in blocks(document, "variable")} <= used
    (user_data,) = re.findall(r'file\("\$\{path.module\}/(.*?)"\)', TEXT)
    assert (EC2 / user_data).is_file()


def test_it_is_written_as_terraform_writes_it() -> None:
    if (terraform := shutil.which("terraform") or shutil.which("tofu")) is None:
        pytest.skip("there is neither terraform nor tofu")
    done = subprocess.run([terraform, "fmt", "-check", EC2], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_ports_are_those_of_the_machines_own_firewall() -> None:
    rules = blocks(hcl2.loads(TEXT), "resource").items()
    opened = {(body["from_port"], body["to_port"]) for (_, _), body in rules if "to_port" in body}
    firewall = (ROOT / "deploy/cloud-init/user-data.yaml").read_text()
    (ports,) = re.findall(r"tcp dport \{ (.*) \} accept", firewall)
    assert opened == {(int(port), int(port)) for port in ports.split(",")}
