"""How long a sensing decision takes over ROS 2's wire, beside the same call in process.

usage: python -m benchmarks.ros2_wire
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

from holdfast.config.loader import load
from holdfast.ros.active_sensing import ActiveSensing, DecisionAnswer, DecisionRequest, RequestKind
from holdfast.ros.messages import decode_request, encode_request
from holdfast.ros.ros2_client import Ros2Service

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "peg_in_hole_2d.yaml"
PORT = 17_450
ROUTER_PORT = 17_451


def median_ms(call: Callable[[], object], repeats: int = 200) -> float:
    """Return the median time of a call."""
    times = []
    for _ in range(repeats):
        begun = perf_counter()
        call()
        times.append(1e3 * (perf_counter() - begun))
    return statistics.median(times)


def measure(num_particles: int) -> None:
    """Print one line for this many particles."""
    configuration = load(EXAMPLE, overrides={"particle_filter.num_particles": num_particles})
    here = ActiveSensing(configuration)
    state = here.answer(DecisionRequest(RequestKind.INITIALIZE, seed=1)).state
    request = DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state)
    data = encode_request(request)
    columns = [
        f"{num_particles:9d}",
        f"{len(data):7d}",
        f"{median_ms(lambda: decode_request(encode_request(request))):10.3f}",
        f"{median_ms(lambda: here.answer(request)):10.3f}",
    ]
    text = EXAMPLE.read_text()
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "plan.yaml"
        path.write_text(text.replace("num_particles: 100", f"num_particles: {num_particles}"))
        for way, port in (("listen", PORT), ("router", ROUTER_PORT)):
            with subprocess.Popen(
                [sys.executable, str(ROOT / "tests" / "ros" / "zenoh_router.py"), str(ROUTER_PORT)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            ) as router:
                assert router.stdout is not None and router.stdin is not None
                router.stdout.readline()
                columns.append(f"{over_the_wire_ms(path, way, port, request):10.3f}")
                router.stdin.close()
    print(" ".join(columns))


def over_the_wire_ms(path: Path, way: str, port: int, request: DecisionRequest) -> float:
    """Return the median time of asking a service that is another process."""
    endpoint = f"tcp/127.0.0.1:{port}"
    # fmt: off
    command = [
        sys.executable, "-m", "holdfast", "serve", "--ros2-domain", "0", f"--ros2-{way}", endpoint,
        "--configuration", str(path), "--until-stdin-closes",
    ]
    # fmt: on
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as service:
        assert service.stdout is not None and service.stdin is not None
        service.stdout.readline()
        way_there = Ros2Service("cloud_active_sensing", 0, endpoint)

        def ask() -> DecisionAnswer:
            answer = way_there.ask(request, 10.0)
            assert not answer.error, answer.message
            return answer

        try:
            # Until the service has found the router, nobody offers it.
            for _ in range(100):
                try:
                    ask()
                    break
                except Exception:  # noqa: BLE001
                    service.poll()
            return median_ms(ask)
        finally:
            way_there.close()
            service.stdin.close()


def main() -> None:
    """Print the table."""
    print("particles   bytes serialise in process   directly via router   (medians, ms)")
    for num_particles in (100, 1000):
        measure(num_particles)


if __name__ == "__main__":
    main()
