"""The study of estimates: what it tries, and that its tasks run."""

from studies.estimates import Estimates
from studies.study import CHOICE, CLAIM, Scale
from studies.tasks import run_task


def test_what_is_judged_was_among_what_was_chosen_from() -> None:
    study, scale = Estimates(), Scale()
    cells, judged = list(study.cells(scale)), list(study.judged_cells(scale))
    assert set(judged) < set(cells)
    assert len(cells) == 8 * 7
    for problem, variant in judged:
        for purpose in (CHOICE, CLAIM):
            settings = study.series((problem, variant), purpose, scale, 20).planning.particle_filter
            assert (settings.estimate, settings.resampling_threshold) == variant


def test_its_tasks_run() -> None:
    first = Estimates().tasks(Scale(quick=True))[0]
    assert len(run_task(first)) == 2
