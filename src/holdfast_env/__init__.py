"""holdfast's problems as gymnasium environments, for people who learn what to sense.

Importing this package registers them; gymnasium imports it by itself::

    environment = gymnasium.make("holdfast_env:Problem-v0", problem="peg_in_hole_2d")

:class:`holdfast.robot.problem_env.ProblemEnv` has the arguments, and says what an action, an
observation and a reward are.
"""

from __future__ import annotations

import gymnasium

__all__: list[str] = []

gymnasium.register(id="Problem-v0", entry_point="holdfast.robot.problem_env:ProblemEnv")
