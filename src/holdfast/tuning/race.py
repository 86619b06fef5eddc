"""A race: which of several candidates has the least mean cost, found with few trials.

All candidates meet the same worlds: trial 7 of one is compared with trial 7 of another. The race
begins with a few trials of each and doubles them, and after each round a candidate is dropped that
another one beats. Costs of trials make that hard. They have a heavy tail: a candidate that is a
little quicker and fails one time in twenty is the worse one, and ten trials do not show it. And
each is tested again and again.

So a candidate is beaten if it has lost a bet. Against each other one, a gambler who begins with 1
bets before each trial that it will cost more, by the same share of his capital each time, which
cannot make him bankrupt because a cost has a limit. If it is no worse on average, his capital
exceeds 1 / a with a probability of at most a, ever: so no number of trials is too small, no look at
it costs anything, and the distribution does not matter (Ville's inequality; Waudby-Smith and
Ramdas, "Estimating means of bounded random variables by betting", 2024, with a few constant bets
mixed). The candidate with the least mean cost is dropped in at most ``error_rate`` of all races.

That takes many trials where costs differ little, so time decides, too. A candidate gets no more of
what is left than its share: one whose trials take long has fewer of them. Where less than half of
the candidates could have twice the trials, the worse half is set aside, as in sequential halving
(Karnin, Koren and Somekh, 2013). Which says nothing about them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from holdfast.numerics.arrays import FloatArray

_BETS = np.array([1 / 64, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 9 / 10])
"""Shares of the capital: small ones find small differences, large ones soon find large ones."""

PILOT_TRIALS = 2  # of each candidate, to see how long a trial takes: the first may be slower
_FIRST_TRIALS = 10  # trials of each candidate before any is set aside
_SLOW = 3.0  # times the usual time of a trial
State: TypeAlias = Literal["in the race", "beaten", "set aside", "refused"]


class MeasuredTrial(NamedTuple):
    """A trial of a candidate, what it cost, and the seconds of a processor that it took."""

    candidate: str
    trial: int
    cost: float
    seconds: float


class Standing(NamedTuple):
    """Where a candidate stands after the race.

    The mean of its costs is that of all trials: with fewer of its own than another one has, it
    follows from its differences from the one with most.
    """

    candidate: str
    trials: int
    mean: float
    deviation: float  # standard error of its mean difference from the one with most trials
    seconds: float  # of a processor, per trial
    state: State
    reason: str  # why it is not in the race any more


def beats(differences: FloatArray, limit: float, error_rate: float) -> bool:
    """Return whether the mean of paired differences, in order, is above zero.

    ``limit`` bounds their sizes; what exceeds it counts as this. ``error_rate`` is the probability
    of True for a mean of at most zero, however often this is asked as trials come.
    """
    if limit <= 0.0 or not len(differences):
        return False
    shares = np.clip(differences / limit, -1.0, 1.0)
    capitals = np.exp(np.cumsum(np.log1p(np.outer(_BETS, shares)), axis=1)).mean(axis=0)
    return bool(capitals.max() * error_rate >= 1.0)


def race(
    candidates: Sequence[str],
    run: Callable[[Sequence[tuple[str, int]]], Iterable[MeasuredTrial]],
    *,
    limit: float | None = None,
    most: int = 200,
    budget_s: float = math.inf,
    error_rate: float = 0.05,
    refuse: Callable[[str], str | None] = lambda _: None,
) -> list[Standing]:
    """Run trials of the candidates until it is known, or time is up, which has the least mean cost.

    ``run`` runs trials, each given by candidate and number, and yields them in any order. It may
    leave some out, of candidates that it then refuses, or as time is up. ``refuse`` returns why a
    candidate must not win, None if it may; it is asked after each round. ``limit`` bounds the
    difference of two costs of a trial; None is the range of those seen so far, with which the
    ``error_rate``, at which the best candidate is beaten, holds only about. A candidate has at most
    ``most`` trials; all take ``budget_s`` seconds of a processor, which the first ten of each quick
    one may exceed. The first candidate is never set aside, and of equals it wins.

    The winner comes first: of the candidates still in the race the one with the least sum of mean
    and deviation, so that a few lucky trials do not win. Then the others, by their means.
    """
    costs: dict[str, FloatArray] = {name: np.empty(0) for name in candidates}
    seconds = dict.fromkeys(candidates, 0.0)
    quickest = dict.fromkeys(candidates, math.inf)
    out: dict[str, tuple[State, str]] = {}
    level = error_rate / max(1, len(candidates) - 1)

    def alive() -> list[str]:
        return [name for name in candidates if name not in out]

    def run_up_to(targets: Mapping[str, int]) -> bool:
        jobs = [
            (name, trial)
            for trial in range(max(targets.values(), default=0))
            for name, target in targets.items()
            if len(costs[name]) <= trial < target
        ]
        found: dict[str, dict[int, float]] = {}
        for each in run(jobs):
            found.setdefault(each.candidate, {})[each.trial] = each.cost
            seconds[each.candidate] += each.seconds
            quickest[each.candidate] = min(quickest[each.candidate], each.seconds)
        for name, by_trial in found.items():
            # Only while none is missing: they are compared in pairs.
            numbers = itertools.takewhile(by_trial.__contains__, itertools.count(len(costs[name])))
            costs[name] = np.concatenate([costs[name], [by_trial[trial] for trial in numbers]])
        for name in alive():
            if (reason := refuse(name)) is not None:
                out[name] = ("refused", reason)
            elif not len(costs[name]):
                out[name] = ("set aside", "there was no time for a trial")
        return bool(found)

    def drop_beaten() -> None:
        bound = limit
        if bound is None:
            seen = np.concatenate(list(costs.values()))
            bound = float(np.ptp(seen)) if len(seen) else 0.0
        racing = alive()
        for name in racing:
            for rival in alive():
                trials = min(len(costs[name]), len(costs[rival]))
                if beats(costs[name][:trials] - costs[rival][:trials], bound, level):
                    out[name] = ("beaten", f"by {rival}, within {trials} trials")
                    break

    def drop_slow(left_s: float) -> None:
        """Set the slowest aside until ten trials of each fit: all of the time is for the quick."""
        for limit_s, times in ((left_s, _SLOW), (2.0 * left_s, 0.0)):
            while len(racing := [name for name in alive() if name != candidates[0]]):
                slowest = max(racing, key=quickest.__getitem__)
                usual_s = float(np.median([quickest[name] for name in racing]))
                more = _FIRST_TRIALS - PILOT_TRIALS
                needed_s = more * sum(quickest[name] for name in alive())
                if needed_s <= limit_s or quickest[slowest] < times * usual_s:
                    break
                took = f"{_FIRST_TRIALS} trials take {_FIRST_TRIALS * quickest[slowest]:.3g} s"
                out[slowest] = ("set aside", f"{took}, more than its share of the time")

    def affordable(names: Sequence[str], target: int, left_s: float) -> dict[str, int]:
        """Return up to which trial each can be run; what a quick one leaves is for the others."""
        each_s = {name: seconds[name] / len(costs[name]) for name in names}
        needs = {name: each_s[name] * max(0, target - len(costs[name])) for name in names}
        targets = {}
        for place, name in enumerate(sorted(names, key=needs.__getitem__)):
            share = max(0.0, left_s) / (len(names) - place)
            more = target - len(costs[name])
            if needs[name] > share:
                more = int(share / each_s[name])
            targets[name] = len(costs[name]) + max(0, more)
            left_s -= each_s[name] * max(0, more)
        return targets

    run_up_to(dict.fromkeys(candidates, min(PILOT_TRIALS, most)))
    drop_slow(0.5 * (budget_s - sum(seconds.values())))
    target = min(_FIRST_TRIALS, most)
    has_run = run_up_to(dict.fromkeys(alive(), target))
    while has_run:
        drop_beaten()
        racing = alive()
        if len(racing) <= 1 or min(len(costs[name]) for name in racing) >= most:
            break
        target = min(2 * target, most)
        # Half of the time is for later rounds, if there are any.
        left_s = (budget_s - sum(seconds.values())) / (2.0 if target < most else 1.0)
        targets = affordable(racing, target, left_s)
        if len(racing) > 2 and 2 * sum(each < target for each in targets.values()) > len(racing):
            standings = _standings(candidates, costs, seconds, out)
            ranked = [each.candidate for each in standings if each.candidate in racing]
            for name in ranked[max(2, (len(ranked) + 1) // 2) :]:
                if name != candidates[0]:
                    out[name] = ("set aside", f"time was short after {len(costs[name])} trials")
            targets = affordable(alive(), target, left_s)
        has_run = run_up_to(targets)
    return _standings(candidates, costs, seconds, out)


def _standings(
    candidates: Sequence[str],
    costs: Mapping[str, FloatArray],
    seconds: Mapping[str, float],
    out: Mapping[str, tuple[State, str]],
) -> list[Standing]:
    longest = max(candidates, key=lambda name: len(costs[name]))  # of equals the first
    standings = []
    for name in candidates:
        own, trials = costs[name], len(costs[name])
        mean = deviation = math.inf
        if trials:
            differences = own - costs[longest][:trials]
            mean = float(np.mean(costs[longest]) + np.mean(differences))
        if name == longest:
            deviation = 0.0
        elif trials > 1:
            deviation = float(np.std(differences, ddof=1)) / math.sqrt(trials)
        state, reason = out.get(name, ("in the race", ""))
        each_s = seconds[name] / max(1, trials)
        standings.append(Standing(name, trials, mean, deviation, each_s, state, reason))

    def rank(each: Standing) -> tuple[bool, float]:
        racing = each.state == "in the race"
        return not racing, each.mean + (each.deviation if racing else 0.0)

    return sorted(standings, key=rank)
