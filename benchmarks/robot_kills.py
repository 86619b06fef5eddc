"""A robot that is killed while it writes its journal: ``python -m benchmarks.robot_kills 10000``.

A child process performs the trials of a run and is killed with SIGKILL after a random time; the
next one goes on. After each kill the journal is read: no finished trial and no record of an
unfinished one may be gone or have changed. When a run is finished, each of its trials must have the
digest that an undisturbed trial has. The next run begins then, until there were so many kills.

The children are forked from a process that has everything imported, so most kills hit a robot that
computes, writes or opens its journal, and few one that starts.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, TypeAlias

import holdfast as hf
from holdfast.config.loader import Configuration
from holdfast.journal.journal_reader import JournalReader
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.recomputing import resume_run_if_begun
from holdfast.robot.robot_run import perform_trials

TRIALS = 12
KILL_AFTER_S = (0.002, 0.12)
"""From the fork; longer each time that nothing was written, for a machine may be busy."""
SEED = 20261126
Seen: TypeAlias = tuple[dict[int, str], tuple[int, list[Any]] | None]
CONFIGURATION = {
    "problem": "peg_in_hole_2d",
    "particle_filter": {"num_particles": 60},
    "simulator": {"num_trials": TRIALS, "max_steps": 60, "seed": 7},
}


def robot(run: Path, configuration: Configuration) -> None:
    """Perform what is missing of a run."""
    with resume_run_if_begun(run, configuration) as directory:
        maker = load_environment(configuration)
        perform_trials(configuration, directory, maker, directory.add, rate_hz=None, sinks=())


def child(run: Path, configuration: Configuration) -> int:
    """Fork a robot and return its process id."""
    process = os.fork()
    if process:
        return process
    status = 1
    try:
        robot(run, configuration)
        status = 0
    except BaseException as error:  # noqa: BLE001 - a forked process must not go on here
        print(f"robot: {error!r}", file=sys.stderr, flush=True)
    os._exit(status)


def seen(run: Path) -> Seen:
    """Return the digests of the finished trials, and the records of the unfinished one."""
    if not (run / "journal.bin").exists():
        return {}, None
    with JournalReader.read(run / "journal.bin") as journal:
        begun = journal.unfinished()
        finished = {result.trial: result.digest for result in journal.results()}
    return finished, None if begun is None else (begun.trial, begun.records)


def require_kept(before: Seen, after: Seen) -> None:
    """Raise AssertionError if something that a journal had is gone or different."""
    finished, begun = before
    for trial, digest in finished.items():
        assert after[0].get(trial) == digest, f"trial {trial} is lost"
    if begun is not None and begun[0] not in after[0]:
        assert after[1] is not None, f"the records of trial {begun[0]} are lost"
        trial, records = after[1]
        assert trial == begun[0] and records[: len(begun[1])] == begun[1], "records have changed"


def main() -> None:
    """Kill as often as the first argument says."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    draw = random.Random(SEED)
    done = runs = torn = 0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "peg.yaml")
        file.write_text(json.dumps(CONFIGURATION))
        configuration = hf.load_configuration(file)
        expected = undisturbed(configuration)
        while done < kills:
            run, is_over, fruitless = Path(folder, f"run-{runs}"), False, 0
            before: Seen = {}, None
            while not is_over and done < kills:
                process = child(run, configuration)
                least, most = KILL_AFTER_S
                time.sleep(draw.uniform(least, most * 1.3**fruitless))
                os.kill(process, signal.SIGKILL)
                _, status = os.waitpid(process, 0)
                is_over = os.WIFEXITED(status)
                assert not is_over or os.WEXITSTATUS(status) == 0, "the robot failed"
                done += not is_over
                after = seen(run)
                require_kept(before, after)
                torn += after != before and not is_over
                fruitless = 0 if after != before else fruitless + 1
                before = after
                if done % 500 == 0 and not is_over:
                    print(f"{done:,} kills, {runs} runs finished", flush=True)
            if is_over:
                assert before[0] == expected, "a decision is different"
                runs += 1
    print(f"{done:,} kills of a robot, {torn:,} after it had written more; {runs} runs finished, ")
    print(f"{runs * TRIALS:,} trials with the digests of undisturbed ones; nothing lost")


def undisturbed(configuration: Configuration) -> dict[int, str]:
    """Return the digests of trials that nobody kills."""
    planner = hf.Planner(configuration.problem, configuration.planning)
    simulator = configuration.simulator
    return {
        trial: hf.run_trial(planner, simulator.seed, trial, max_steps=simulator.max_steps).digest
        for trial in range(TRIALS)
    }


if __name__ == "__main__":
    main()
