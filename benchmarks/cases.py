"""All that is measured, in the order of RESULTS.md, with rough durations in seconds."""

from __future__ import annotations

from benchmarks import command, decisions, scale
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
)
