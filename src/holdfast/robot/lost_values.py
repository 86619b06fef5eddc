"""Values that a belief has lost, though they were the true ones: of a bit, a colour, a drawer.

Resampling copies particles. Where a sharp observation of one coordinate leaves few, their copies
have few values of what no noise refreshes, and soon one: the belief is certain by chance and not by
evidence, and nothing that it observes later brings the true value back. Evidence alone rarely does
that. With n particles and k values, equally likely at first, the posterior share of the true one
ever falls to 1/n in at most k of n trials (Ville's inequality).

Which value is the true one only a simulated world knows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import PlanningState
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.trial import TrialObserver

REMEDY = (
    "Resampling loses such a value by chance where observations leave few particles: take more "
    "(particle_filter.num_particles), or resample less often "
    "(particle_filter.resampling_threshold: 0.5)"
)


class LostValues(TrialObserver):
    """Observes trials, and keeps of the last one which ``coordinates`` have lost the true value.

    These are coordinates that have a few values: the true one and others were among those of the
    particles at first, nothing else is at the end, and then no particle has the true one.
    """

    coordinates: tuple[int, ...] = ()

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Keep the values of the coordinates of which some particles have the true one."""
        self.world = environment if isinstance(environment, SimulatedEnvironment) else None
        self.coordinates, self._values = (), {}
        if self.world is not None:
            states = state.belief.states
            several = (states == self.world.state).any(axis=0) & (states != states[0]).any(axis=0)
            self._values = {int(at): np.unique(states[:, at]) for at in np.flatnonzero(several)}

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Look which values are left."""
        del result
        if self.world is not None:
            left, true = state.belief.states[state.belief.weights > 0.0], self.world.state
            self.coordinates = tuple(
                at
                for at, values in self._values.items()
                if true[at] in values
                and (left[:, at] != true[at]).all()
                and np.isin(left[:, at], values).all()
            )


def are_many(lost: int, trials: int) -> bool:
    """Return whether more of the trials have lost a value than evidence may have misled."""
    return lost > max(1.0, 0.05 * trials)


def remark_on_lost_values(trials: Sequence[Sequence[str]]) -> str:
    """Return in how many trials which coordinates have lost the true value; empty if in few."""
    lost = [names for names in trials if names]
    if not are_many(len(lost), len(trials)):
        return ""
    names = ", ".join(dict.fromkeys(name for names in lost for name in names))
    return (
        f"{len(lost)} of {len(trials)} trials ended sure of a wrong value: no particle had the "
        f"true one of {names}"
    )
