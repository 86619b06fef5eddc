"""The problems on which ways of sensing are compared, with their settings."""

from __future__ import annotations

from typing import Any

import msgspec

from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from studies.trial_batches import TrialSeries


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """A problem as it is posed in an experiment."""

    name: str
    problem: str
    model: dict[str, Any] = msgspec.field(default_factory=dict)
    num_particles: int = 100
    max_steps: int = 500
    share: float = 1.0
    """Share of a study's trials that is run: a problem that takes ten times as long has fewer."""
    state_resolution: float | None = None
    """Standard deviation of the noise by which states are blurred for the entropy of a mixture,
    where the problem's motion noise has not as many coordinates as its states."""

    def series(
        self,
        selector: SelectorSettings,
        sensing_interval: int,
        *,
        seed: int,
        num_trials: int,
        active_sensing: ActiveSensingSettings | None = None,
        particle_filter: ParticleFilterSettings | None = None,
    ) -> TrialSeries:
        """Return the trials of one way of sensing, with this case's number of particles.

        ``num_trials`` is that of a problem whose share is 1.
        """
        if (
            self.state_resolution is not None
            and selector.method == "state_entropy"
            and (selector.estimator or "").startswith("gaussian_mixture")
        ):
            selector = msgspec.structs.replace(selector, resolution=self.state_resolution)
        filtering = particle_filter or ParticleFilterSettings()
        sensing = active_sensing or ActiveSensingSettings()
        return TrialSeries(
            problem=self.problem,
            model=self.model,
            planning=PlanningSettings(
                particle_filter=msgspec.structs.replace(
                    filtering, num_particles=self.num_particles
                ),
                active_sensing=msgspec.structs.replace(sensing, num_cores=1),
                selector=selector,
                sensing_interval=sensing_interval,
            ),
            max_steps=self.max_steps,
            seed=seed,
            num_trials=max(2, round(self.share * num_trials)),
        )


CASES = (
    Case(name="peg in hole", problem="peg_in_hole_2d"),
    Case(name="tight hole", problem="peg_in_hole_2d", model={"hole_tolerance": 0.05}),
    Case(name="three plates", problem="multitier_peg_in_hole_2d", max_steps=1500, share=0.5),
    Case(name="capsule robot", problem="capsule_robot", max_steps=3000),
    Case(
        name="peg in space",
        problem="peg_in_hole_3d",
        num_particles=200,
        max_steps=700,
        share=0.5,
    ),
    Case(
        name="light and dark",
        problem="studies.light_dark:LightDark",
        num_particles=500,
        share=0.5,
    ),
    Case(
        name="busy room",
        problem="studies.busy_room:BusyRoom",
        num_particles=200,
        state_resolution=0.1,
    ),
    Case(name="passer-by", problem="studies.passer_by:PasserBy"),
)
"""In the order in which they are shown."""
