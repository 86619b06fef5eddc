"""The first ten minutes of docs/deploy.md, typed as they stand there."""

import re
import shutil
import subprocess
import uuid
from pathlib import Path

from tests.deploy.docker import ROOT, TARGETS, Engine, Images
from tests.ports import free_port

PAGE = (ROOT / "docs/deploy.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)

PRELUDE = """\
set -euo pipefail
docker compose version >/dev/null 2>&1 || docker() {
    if [ "$1" = compose ]; then shift; command docker-compose "$@"; else command docker "$@"; fi
}
command -v sudo >/dev/null || sudo() { "$@"; }
"""

AFTER_A_WHILE = """\
for role in cloud robot; do
    until docker inspect --format '{{.State.Health.Status}}' "$(docker compose ps -q $role)" \\
        | grep -qx healthy; do sleep 0.2; done
done
"""
"""What a person who types takes for granted."""

LOOKED_AT = """\
until docker compose logs robot | grep -q 'local_recovery -> keep_alive'; do sleep 0.2; done
"""
"""And what this person looks at before the robot is killed, too."""


def test_ten_minutes(engine: Engine, images: Images, tmp_path: Path) -> None:
    assert len(BLOCKS) == 5
    typed = [block.replace("num_trials: 20", "num_trials: 5") for block in BLOCKS]
    assert typed != BLOCKS
    typed = [block.replace("up -d\n", f"up -d\n{AFTER_A_WHILE}") for block in typed]
    typed = [block.replace("start cloud\n", f"start cloud\n{LOOKED_AT}") for block in typed]
    tracked = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    clone = tmp_path / "clone"
    for name in filter(None, tracked.stdout.split("\0")):
        if (ROOT / name).is_file():
            (clone / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, clone / name)
    project = f"holdfast-test-{uuid.uuid4().hex[:8]}"
    variables = {
        "COMPOSE_PROJECT_NAME": project,
        "HOLDFAST_PORT": str(free_port()),
        **{f"HOLDFAST_{role.upper()}_IMAGE": f"{project}-{role}" for role in TARGETS},
        **{f"HOLDFAST_{role.upper()}_HEALTH_PORT": str(free_port()) for role in TARGETS},
    }
    try:
        done = engine.run(
            *("bash", "-c", PRELUDE + "".join(typed)), variables=variables, cwd=clone, timeout=600
        )
        assert done.returncode == 0, done.stdout + done.stderr
    finally:
        files = [word for role in TARGETS for word in ("-f", clone / f"deploy/compose/{role}.yaml")]
        engine.compose(project, *files, "down", "--volumes", variables=variables)
        for role in TARGETS:
            engine.run("docker", "rmi", f"{project}-{role}")
    said = done.stdout
    for happened in ("local_recovery -> keep_alive", "resumed trial", "bit for bit"):
        assert happened in said, said
    assert not re.search(r"^  \w[\w ]*  (fails|-) ", said, re.MULTILINE), said
