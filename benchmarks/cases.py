"""All that is measured, in the order of RESULTS.md, with rough durations in seconds."""

from __future__ import annotations

from benchmarks import (
    command,
    decisions,
    far,
    faults,
    horizon,
    neighbours,
    path_entropy,
    scale,
    service,
    simulator,
)
from benchmarks.common import Case

__all__ = ["CASES"]

CASES = (
    Case("decision", "One sensing decision", decisions.decision, 60.0, 6.0),
    Case("ratio", "Against the literal algorithm", decisions.ratio, 60.0, 4.0),
    Case("large", "100,000 particles", scale.large, 40.0, 8.0),
    Case("growth", "How the cost grows", scale.growth, 60.0, 4.0),
    Case("trials", "A thousand trials", command.trials, 40.0, 3.0),
    Case("floor", "Distance from the floor", decisions.floor, 10.0, 1.0),
    Case("simd", "Instruction sets", decisions.instruction_sets, 25.0, 3.0),
    Case("busy", "On a busy machine", decisions.busy_machine, 30.0, 8.0),
    Case("startup", "Start-up", command.startup, 20.0, 3.0),
    Case("estimators", "Estimators and methods", decisions.estimators, 20.0, 1.0),
    Case("path", "Along the path", path_entropy.path_entropy, 60.0, 10.0),
    Case("horizon", "Steps ahead", horizon.horizon, 60.0, 6.0),
    Case("offload", "A question to a service", service.offload, 5.0, 2.0),
    Case("robot", "A robot's loop, with and without a service", service.robot_loop, 20.0, 4.0),
    Case("paced", "A robot at its own pace", service.paced, 60.0, 7.0),
    Case("wire", "Bytes on the wire", service.wire, 20.0, 4.0),
    Case("kills", "A killed cloud, and a new one", faults.kills, 90.0, 12.0),
    Case("far", "A cloud far away", far.far, 600.0, 90.0),
    Case("neighbours", "Bad neighbours", neighbours.neighbours, 150.0, 30.0),
    Case("capacity", "Many robots", service.capacity, 290.0, 60.0),
    Case("serve", "The service's process", service.serve, 50.0, 14.0),
    Case("simulated", "Simulated runs", simulator.simulated, 15.0, 5.0),
)
