"""What robots and clouds run, piece by piece: a bill of materials in CycloneDX's format.

An environment is made as in the images, of the wheel and of ``requirements.txt``, and what is
installed in it is written down, with the licence that each package states. What the wheel has
linked into its native module it says itself (``kernel.cdx.json``, which CMake writes); that is
added. The packages of the base image are not in it: scan the image for those. ::

    python deploy/sbom.py dist

reads the wheel in ``dist`` and writes ``dist/holdfast-sensing-VERSION.cdx.json``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

__all__ = ["complete", "licences", "main"]

ROOT = Path(__file__).parents[1]
NAME = "holdfast-sensing"


def main(directory: Path) -> None:
    """Write the list of what the wheel in a directory needs beside it, and print the licences."""
    (wheel,) = directory.glob("*.whl")
    with tempfile.TemporaryDirectory(prefix="holdfast-sbom-") as name:
        python = Path(name) / "bin/python"
        _run("-m", "venv", "--without-pip", name)
        install = ("-m", "pip", "--python", str(python), "install", "-q")
        _run(*install, "--require-hashes", "-r", str(ROOT / "deploy/requirements.txt"))
        # By a name, which is looked for in the directory alone: the list has no path of ours.
        _run(*install, "--no-deps", "--no-index", "--find-links", str(directory), NAME)
        _run(*install[:4], "check")
        scan = ("-m", "cyclonedx_py", "environment", "--output-reproducible")
        bom = json.loads(_run(*scan, "--pyproject", str(ROOT / "pyproject.toml"), str(python)))
        for native in Path(name).glob("lib/*/site-packages/holdfast_sensing-*/sboms/*.json"):
            complete(bom, json.loads(native.read_text(encoding="utf-8")))
    text = json.dumps(bom, indent=2, sort_keys=True) + "\n"
    if error := JsonStrictValidator(SchemaVersion.V1_6).validate_str(text):
        sys.exit(f"what was written is no CycloneDX 1.6: {error}")
    stated = licences(bom)
    for component, licence in stated.items():
        print(f"{component:32} {licence}")
    if silent := [component for component, licence in stated.items() if not licence]:
        sys.exit(f"these state no licence: {', '.join(silent)}; find it out before you release")
    file = directory / f"{NAME}-{bom['metadata']['component']['version']}.cdx.json"
    file.write_text(text, encoding="utf-8")
    print(f"{file}: {len(stated)} components of {wheel.name} and its environment")


def complete(bom: dict[str, Any], part: dict[str, Any]) -> None:
    """Add what a wheel says of a native module as parts of the package."""
    module = part["metadata"]["component"]
    bom["components"] += [module, *part["components"]]
    root = bom["metadata"]["component"]["bom-ref"]
    dependencies = {entry["ref"]: entry for entry in bom["dependencies"] + part["dependencies"]}
    entry = dependencies.setdefault(root, {"ref": root})
    entry["dependsOn"] = sorted({*entry.get("dependsOn", ()), module["bom-ref"]})
    bom["dependencies"] = list(dependencies.values())


def licences(bom: dict[str, Any]) -> dict[str, str]:
    """Return what each component states, empty if nothing, by name and version."""
    return {
        f"{component['name']} {component['version']}": "; ".join(
            entry.get("expression") or entry["license"].get("id") or entry["license"]["name"]
            for entry in component.get("licenses", ())
        )
        for component in bom["components"]
    }


def _run(*words: str) -> str:
    done = subprocess.run([sys.executable, *words], stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout


if __name__ == "__main__":
    main(Path(sys.argv[1]))
