"""Values that a belief has lost, though they were the true ones: of a bit, a colour, a drawer.

Resampling copies particles. Where a sharp observation of one coordinate leaves few, their copies
have few values of what no noise refreshes, and soon one: the belief is certain by chance and not by
evidence, and no observation brings the true value back. Evidence alone rarely misleads so: of n
particles and k values, equally likely at first, the true one's posterior share ever falls to 1/n in
at most k of n trials (Ville's inequality). Which value is true only a simulated world knows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import PlanningState
from holdfast.problems.attributes import coordinate_name
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.trial import TrialObserver

FEW_LEFT = 3.0
"""Effective particles below which chance decides what an observation leaves."""

ADVICE = (
    "take more particles (particle_filter.num_particles), or declare the sharpest sensors less "
    "sharp than they are"
)
REMEDY = f"Resampling loses such a value by chance where observations leave few particles: {ADVICE}"


class LostValues(TrialObserver):
    """Observes trials, and keeps which coordinates have ``lost`` the true value in the last one.

    These are coordinates that have a few values: the true one and others were among those of the
    particles at first, nothing else is at the end, and then no particle has the true one.
    """

    lost: tuple[str, ...] = ()

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Keep the values of the coordinates of which some particles have the true one."""
        self.world = environment if isinstance(environment, SimulatedEnvironment) else None
        self.lost, self._values = (), {}
        if self.world is not None:
            states = state.belief.states
            several = (states == self.world.state).any(axis=0) & (states != states[0]).any(axis=0)
            self._values = {int(at): set(states[:, at].tolist()) for at in np.flatnonzero(several)}

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Look which values are left."""
        del result
        if self.world is not None:
            left, true = state.belief.states[state.belief.weights > 0.0], self.world.state
            self.lost = tuple(
                coordinate_name(self.world.problem, at)
                for at, values in self._values.items()
                if true[at] in values
                and (left[:, at] != true[at]).all()
                and values.issuperset(left[:, at].tolist())
            )


def remark_on_lost_values(
    trials: Sequence[Sequence[str]], reached: Sequence[bool] = (), which: str = "trials"
) -> str:
    """Return how many trials lost which values, and if these ``reached``; empty if few did."""
    count = sum(map(bool, trials))
    if count <= max(1.0, 0.05 * len(trials)):
        return ""
    names = ", ".join(sorted({name for lost in trials for name in lost}))
    ended = f"{count} of {len(trials)} {which} ended sure of a wrong value"
    if reached:
        missed = sum(bool(lost) and not won for lost, won in zip(trials, reached, strict=True))
        ended += f" ({missed} of these did not reach the goal)"
    return f"{ended}: no particle had the true one of {names}"
