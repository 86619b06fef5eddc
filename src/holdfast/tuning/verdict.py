"""What a race has found, judged on trials that had no part in it.

Of many candidates the luckiest wins, so its mean in the race is too good to be true (the winner's
curse). It is measured anew, beside the configuration as it was and random sensing, and only these
trials confirm. Their few intervals hold together at 95 % (Bonferroni). If none shows a difference,
what is sensed does not matter as far as these trials tell, and the configuration stays. Otherwise
the least mean cost of these trials wins: not the winner of the race if it was only lucky, and not
one that decides slowly if a much quicker one is as good.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import msgspec
import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.reports.outcome_comparison import bootstrap_interval
from holdfast.tuning.candidates import AS_CONFIGURED, RANDOM, Objective
from holdfast.tuning.kept_trials import TrialRow

FAMILY_LEVEL = 0.95  # confidence of all intervals of the objective together
_WIDE = 0.1  # an interval that reaches so far, as a share of the mean, says little
MUCH_SLOWER = 2.0
GO_ON = "goes on (--resume; in Python the same out)"
_NOTICED_MS = 0.5  # a decision that takes so many times as long, and so much longer, needs a reason


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """How a measure of a candidate differs from another one's, over the same worlds.

    Mean steps have a trial without success at the limit.
    """

    candidate: str
    against: str
    measure: Objective
    value: float
    other: float
    difference: float  # the candidate's mean less the other's
    interval: tuple[float, float]  # for the difference; those of the objective hold together

    @property
    def finding(self) -> int:
        """1 if the candidate is better beyond noise, -1 if it is worse, else 0."""
        low, high = self.interval
        sign = int(low > 0.0) - int(high < 0.0)
        return -sign if self.measure == "steps" else sign


class Verdict(NamedTuple):
    """What to take, why, and what was compared; ``matters`` is whether anything differed."""

    choice: str
    matters: bool
    sentence: str
    comparisons: tuple[Comparison, ...]


_MEASURES: Mapping[Objective, Callable[[TrialRow, int], float | None]] = {
    "steps": lambda row, limit: float(row.steps if row.success else limit),
    "success": lambda row, _: float(row.success),
    "reward": lambda row, _: row.reward,
}


def cost_of(row: TrialRow, objective: Objective, limit: int) -> float:
    """Return what is to be small; NaN for a trial without a reward."""
    value = _MEASURES[objective](row, limit)
    value = float("nan") if value is None else value
    return value if objective == "steps" else -value


def mean_difference(
    differences: FloatArray, level: float = FAMILY_LEVEL
) -> tuple[float, tuple[float, float]]:
    """Return the mean of paired differences, and its interval; of no scatter, none."""
    mean = float(np.mean(differences))
    if np.ptp(differences) == 0.0:
        return mean, (mean, mean)
    return mean, bootstrap_interval([differences], np.mean, paired=True, level=level)


def judge(
    rows: Mapping[str, Sequence[TrialRow]],
    finalists: Sequence[str],
    objective: Objective,
    limit: int,
    barred: Collection[str] = (),
    least: int = 1,
) -> Verdict:
    """Choose among the configuration as it was, the finalists and random sensing.

    ``rows`` have the same fresh trials of each candidate, in the same order. Those of the
    configuration come first; of equals, the first one is chosen. A trial that does not succeed
    counts ``limit`` steps, those ``barred`` must not be chosen, and with fewer trials than
    ``least``, nothing is said.
    """
    names = list(rows)
    configured = names[0]
    admitted = [name for name in names if name not in barred] or names
    choice = next(name for name in (configured, *finalists, *admitted) if name in admitted)
    trials, slower = len(rows[configured]), ""
    if trials < least:
        keep = _advice(choice, configured)
        sentence = (
            f"The budget was too short to judge: {trials} fresh trials of at least {least}. "
            f"A larger one {GO_ON}; until then, {keep[0].lower()}{keep[1:]}."
        )
        return Verdict(choice, False, sentence, ())
    pairs = [
        (one, other)
        for other, one in combinations(names, 2)
        if not {configured, *finalists}.isdisjoint((one, other))
    ]
    level = 1.0 - (1.0 - FAMILY_LEVEL) / max(1, len(pairs))

    def compare(one: str, other: str, measure: Objective) -> Comparison | None:
        values = [[_MEASURES[measure](row, limit) for row in rows[name]] for name in (one, other)]
        if any(None in each for each in values):
            return None
        of_one, of_other = (np.array(each, dtype=np.float64) for each in values)
        difference, interval = mean_difference(of_one - of_other, level)
        return Comparison(
            candidate=one,
            against=other,
            measure=measure,
            value=float(np.mean(of_one)),
            other=float(np.mean(of_other)),
            difference=difference,
            interval=interval,
        )

    decisive = [found for pair in pairs if (found := compare(*pair, objective)) is not None]
    matters = any(each.finding for each in decisive)
    if matters:
        costs = {
            name: np.mean([cost_of(row, objective, limit) for row in rows[name]]) for name in names
        }
        best = choice = min(admitted, key=costs.__getitem__)
        best_ms = _decision_ms(rows[best])
        equals = []
        for name in admitted:
            found, own_ms = compare(best, name, objective), _decision_ms(rows[name])
            if found is None or best_ms <= max(MUCH_SLOWER * own_ms, own_ms + _NOTICED_MS):
                continue
            # About one standard error: what is likely better is worth its time.
            near = abs(found.difference) <= 0.25 * (found.interval[1] - found.interval[0])
            if found.finding < 1 and (near or name == configured):
                equals.append(name)
        if equals:
            choice = min(equals, key=costs.__getitem__)
            slower = (
                f" {best} is no better beyond noise and takes {best_ms:.2g} ms to decide, not "
                f"{_decision_ms(rows[choice]):.2g}."
            )
    against = [name for name in names if name != choice]
    comparisons = [
        found
        for name in against
        for measure in sorted(_MEASURES, key=lambda each: each != objective)
        if (found := compare(choice, name, measure)) is not None
    ]
    sentence = _sentence(choice, configured, matters, objective, comparisons, trials) + slower
    if not any(row.success for each in rows.values() for row in each):
        sentence += " No trial succeeded: ask holdfast check first whether the goal can be reached."
    return Verdict(choice, matters, sentence, tuple(comparisons))


def _decision_ms(rows: Sequence[TrialRow]) -> float:
    return float(np.median([row.decision_ms for row in rows]))


# -- words -----------------------------------------------------------------------------------------


def _advice(choice: str, configured: str) -> str:
    if choice == configured:
        return "Keep your configuration"
    return "Sense at random" if choice == RANDOM else f"Sense by {choice}"


def _sentence(
    choice: str,
    configured: str,
    matters: bool,
    objective: Objective,
    comparisons: Sequence[Comparison],
    trials: int,
) -> str:
    decisive = [each for each in comparisons if each.measure == objective]
    effects = "; ".join(map(_effect, decisive))
    fresh = f"{trials:,} trials that had no part in the choice"
    if not decisive:
        return f"{choice} alone could be judged, in {fresh}."
    if not matters:
        reach = max(abs(end) for each in decisive for end in each.interval)
        wide = reach > _WIDE * abs(decisive[0].value)
        seen, unseen = f"What you sense does not matter here, as far as {fresh} tell", ""
        if wide:
            seen = f"No difference showed in {fresh}"
            unseen = f" One of up to {_amount(reach, objective)} would not have shown: "
            unseen += "a larger budget may find it."
        return f"{seen}: {effects}. {_advice(choice, configured)}.{unseen}"
    value = _amount(decisive[0].value, objective)
    text = f"{_advice(choice, configured)}: {value} on average in {fresh}; {effects}."
    for each in comparisons:
        if each.measure != objective and each.finding < 0:
            text += f" But {each.measure} says otherwise: {_effect(each)}."
    return text


_UNITS = {"success": "points of success", "steps": "steps", "reward": "of reward"}


def _amount(value: float, measure: Objective) -> str:
    number = f"{100.0 * value:.3g}" if measure == "success" else f"{value:.4g}"
    return f"{number} {_UNITS[measure]}"


def _effect(each: Comparison) -> str:
    scale, unit = 100.0 if each.measure == "success" else 1.0, _UNITS[each.measure]
    low, high = (f"{scale * end:+.3g}" for end in each.interval)
    whose = "your configuration" if each.against == AS_CONFIGURED else each.against
    whose = "random sensing" if whose == RANDOM else whose
    noise = "" if each.finding else ", within noise"
    return f"{scale * each.difference:+.3g} [{low}, {high}] {unit} against {whose}{noise}"
