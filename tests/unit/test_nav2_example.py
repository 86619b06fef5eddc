"""The example for Nav2 without ROS: recorded particles, and chosen looks against spinning."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def navigate(*words: str) -> str:
    command = [sys.executable, "examples/nav2/navigate.py", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_recorded_particles_are_told_apart() -> None:
    said = navigate("--particles", "examples/nav2/particles.csv").splitlines()
    assert said[0].startswith("49% of the particles agree on the drive")
    entropies = [float(line.split("deg")[1].split()[0]) for line in said[1:]]
    (best,) = (index for index, line in enumerate(said[1:]) if line.endswith("<- tells most"))
    assert entropies[best] == min(entropies)
    assert len(entropies) == 8


def test_chosen_looks_are_fewer_and_know_the_way() -> None:
    """In 40 trials: 100 chosen ones came to 1.03 looks and 100 right, spinning to 2.29 and 91."""
    said = navigate("--simulate", "40").splitlines()
    found = [re.findall(r"[\d.]+", line) for line in said]
    (looks, right, _), (spun, right_spun, _) = ([float(each) for each in row] for row in found)
    assert looks < 1.5 < spun
    assert right == 40 >= right_spun
