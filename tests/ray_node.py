"""A node of Ray on this machine, which is a cluster by itself."""

import contextlib
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep

import pytest

from holdfast.runtime.parent_death import parent_death_prefix
from holdfast_lab.testbed.processes import free_port

PATIENCE_S = 360.0


@contextlib.contextmanager
def ray_node(cores: int) -> Iterator[tuple[str, str]]:
    """Start a node; yield its address, and that of its client server.

    Whoever wants to join it does so within the context, which sets the environment.
    """
    port, client_port = free_port(), free_port()
    # The paths of its sockets have little room.
    directory = Path(tempfile.mkdtemp(prefix="hf-ray-"))
    command = [*parent_death_prefix(), sys.executable, "-m", "ray.scripts.scripts", "start"]
    command += ["--head", "--block", "--num-cpus", str(cores), "--include-dashboard=false"]
    command += ["--port", str(port), "--ray-client-server-port", str(client_port)]
    command += ["--node-ip-address", "127.0.0.1"]
    command += ["--min-worker-port", "0", "--max-worker-port", "0"]
    command += ["--object-store-memory", "80000000", "--temp-dir", str(directory / "r")]
    with pytest.MonkeyPatch.context() as patch:
        # Whoever reaches a cluster can run code on it, and its ports are open to the network.
        patch.setenv("RAY_AUTH_MODE", "token")
        patch.setenv("RAY_AUTH_TOKEN", secrets.token_hex())
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_raylet_start_wait_time_s", "300")
        patch.setenv("GRPC_ENABLE_FORK_SUPPORT", "0")  # its server forks between gRPC's threads
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
        log = directory / "log"
        with log.open("wb") as output:
            node = subprocess.Popen(command, stdout=output, stderr=output, start_new_session=True)
        try:
            began = monotonic()
            while b"runtime started" not in log.read_bytes():
                assert node.poll() is None and monotonic() < began + PATIENCE_S, log.read_text()
                sleep(0.1)
            yield f"127.0.0.1:{port}", f"ray://127.0.0.1:{client_port}"
        finally:
            node.terminate()
            node.wait(PATIENCE_S)
            shutil.rmtree(directory, ignore_errors=True)
