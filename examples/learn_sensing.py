"""Learn what to sense: an agent of a few numbers, for a problem as an environment of gymnasium.

The agent sees the belief in numbers from -1 to 1. For each sensing action it adds them up with
weights of its own, and the greatest sum is chosen. The cross-entropy method finds the weights:
draw many agents, let each have some episodes, and draw the next ones around the best. No gradient,
no library of learning; about a minute. It ends with 100 episodes that the agent has never seen,
against random sensing and holdfast's own method in the same worlds::

    python examples/learn_sensing.py
"""

import gymnasium
import numpy as np


def linear_agent(environment, weights):
    """Return an agent: a function from what it sees to what it senses."""
    choices, size = environment.action_space.n, environment.observation_space.shape[0]
    matrix = weights.reshape(choices, size + 1)
    return lambda seen: int(np.argmax(matrix[:, :-1] @ seen + matrix[:, -1]))


def total_reward(environment, agent, seed, trial):
    """Return the sum of the rewards of an episode."""
    seen, _ = environment.reset(seed=seed, options={"trial": trial})
    total, over = 0.0, False
    while not over:
        seen, reward, terminated, truncated, _ = environment.step(agent(seen))
        total += reward
        over = terminated or truncated
    return total


def learn(environment, generations=10, population=20, best=5, episodes=5, seed=1):
    """Return the weights that the cross-entropy method finds, and print how it goes."""
    random = np.random.default_rng(seed)
    size = environment.action_space.n * (environment.observation_space.shape[0] + 1)
    mean, spread = np.zeros(size), np.ones(size)
    for generation in range(generations):
        trials = range(generation * episodes, (generation + 1) * episodes)  # the same for all
        agents = mean + spread * random.normal(size=(population, size))
        rewards = [
            np.mean([total_reward(environment, agent, seed, trial) for trial in trials])
            for agent in (linear_agent(environment, weights) for weights in agents)
        ]
        chosen = agents[np.argsort(rewards)[-best:]]
        # A little wider than the best agents are, less and less: else it settles too soon.
        mean, spread = chosen.mean(axis=0), chosen.std(axis=0) + 0.1 * 0.9**generation
        print(f"generation {generation}: mean reward {np.mean(rewards):.1f}")
    return mean


def main():
    """Learn, and compare."""
    made = gymnasium.make("holdfast_env:Problem-v0", problem="peg_in_hole_2d", reward="steps")
    environment = made.unwrapped
    environment.action_space.seed(1)
    agents = {
        "random": lambda _: environment.action_space.sample(),
        "holdfast": lambda _: environment.choose(),
        "learned": linear_agent(environment, learn(environment)),
    }
    rewards = {
        name: np.array([total_reward(environment, agent, 2, trial) for trial in range(100)])
        for name, agent in agents.items()
    }
    for name, values in rewards.items():
        more = values - rewards["random"]
        print(
            f"{name:9} {-values.mean():6.1f} steps, {more.mean():+5.1f} reward against random "
            f"sensing (standard error {more.std(ddof=1) / 10.0:.1f})"
        )
    more = rewards["learned"] - rewards["holdfast"]
    print(f"learned against holdfast: {more.mean():+.1f} ({more.std(ddof=1) / 10.0:.1f})")


if __name__ == "__main__":
    main()
