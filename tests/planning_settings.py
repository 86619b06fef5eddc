"""Settings and a trial, small enough to be planned in every test of planning."""

from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
)

SEED, TRIAL = 2**40 + 3, 6


def planning_settings(
    num_particles: int = 40, sensing_interval: int = 3, resampling_threshold: float = 1.0
) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(
            num_particles=num_particles, resampling_threshold=resampling_threshold
        ),
        active_sensing=ActiveSensingSettings(num_observation_samples=3, num_cores=1),
        sensing_interval=sensing_interval,
    )
